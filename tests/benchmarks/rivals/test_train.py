"""Training of rivals: it ends in time, improves, and the file shows what the model shows."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.rivals.model import Conditioned, DiffusionGenerator, picture_rays, save_rival
from benchmarks.rivals.picture_set import PictureSet
from benchmarks.rivals.registry import RIVALS, load
from benchmarks.rivals.train import Options, advance, main, on_device
from probnerf.geometry import look_at, pinhole_rays

SIZE, VIEWS, TAN = 16, 6, 0.5


@pytest.fixture(scope="module")
def balls() -> PictureSet:
    """Balls about the middle, each of its own size and colour, as seen from all around."""
    rng = np.random.default_rng(0)
    count = 8
    rgb = np.full((count, VIEWS, SIZE, SIZE, 3), 255, np.uint8)
    distance = np.zeros((count, VIEWS, SIZE, SIZE), np.float16)
    poses = np.zeros((count, VIEWS, 4, 4), np.float32)
    for i in range(count):
        radius, colour = rng.uniform(0.3, 0.7), rng.integers(0, 200, 3)
        for v in range(VIEWS):
            direction = rng.normal(size=3)
            poses[i, v] = look_at(2.0 * direction / np.linalg.norm(direction), np.zeros(3))
            origins, rays = pinhole_rays(poses[i, v], 0.5 * SIZE / TAN, SIZE)
            along = -np.sum(origins * rays, axis=1)
            inside = radius**2 - 4.0 + along**2
            hit = (inside > 0).reshape(SIZE, SIZE)
            distance[i, v][hit] = (along - np.sqrt(np.maximum(inside, 0.0))).reshape(SIZE, SIZE)[hit]
            rgb[i, v][hit] = colour
    return PictureSet(rgb, distance, poses, np.asarray(TAN, np.float32), np.arange(count))


def functa(balls):
    pictures, box = on_device(balls)
    entry = RIVALS["functa"]
    config = entry.config(box=box, tan_half_fov=TAN, **entry.tiny)
    return pictures, config, entry


@pytest.mark.nightly
def test_the_field_learns_to_fit_objects_in_three_steps(balls):
    pictures, config, entry = functa(balls)
    recipe = entry.recipe(config)
    state = jax.jit(recipe.start)(jax.random.key(0))
    run = partial(advance, recipe.phases[0])
    figures = []
    for key in jax.random.split(jax.random.key(1), 3):
        state, sums = run(state, pictures, jnp.array(0.1), key, jnp.array(20))
        figures.append({name: float(value) / 20 for name, value in sums.items()})
    assert figures[-1]["psnr"] > figures[0]["psnr"] + 1.0
    assert figures[-1]["mse"] < 0.8 * figures[-1]["mse_before"]


def test_a_file_gives_back_what_shows_the_same(balls, tmp_path):
    pictures, config, entry = functa(balls)
    model = entry.model(config, jax.random.key(0))
    save_rival(tmp_path / "functa.safetensors", "functa", model, {"seconds": 1.0})
    found, story = load(tmp_path / "functa.safetensors")
    assert found.config == config and story["seconds"] == 1.0
    latent = jax.random.normal(jax.random.key(1), (config.latent,))
    T = pictures.T_object_camera[0, :2]
    np.testing.assert_allclose(found.render(latent, T, 8), model.render(latent, T, 8), atol=5e-3)


@pytest.mark.parametrize("content", [b"", b"not weights"])
def test_another_file_is_refused(content, tmp_path):
    (tmp_path / "functa.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="not a readable rival"):
        load(tmp_path / "functa.safetensors")


def test_rays_pass_through_pixel_centres():
    T = look_at(np.array([1.0, 2.0, 0.5]), np.zeros(3))
    for found, expected in zip(picture_rays(jnp.asarray(T), TAN, 6), pinhole_rays(T, 3.0 / TAN, 6), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.nightly
def test_a_run_ends_in_time_and_its_file_is_a_rival(balls, tmp_path):
    balls.save(tmp_path / "balls.npz")
    options = Options("functa", tmp_path / "balls.npz", tmp_path / "out", seconds=60.0, sizes="tiny")
    main(options)
    rows = [json.loads(line) for line in (options.out / "functa.history.jsonl").read_text().splitlines()]
    last = {row["phase"]: row for row in rows if "phase" in row}
    assert last["priors"]["seconds"] < options.seconds + 5.0
    assert {"psnr_given_learnt", "psnr_others_new"} <= rows[-1].keys()
    assert (options.out / "functa.png").read_bytes().startswith(b"\x89PNG")
    model, story = load(options.out / "functa.safetensors")
    assert isinstance(model, Conditioned) and isinstance(model, DiffusionGenerator)
    assert story["finished"] and story["steps"]["field"] == last["field"]["steps"]
    T = jnp.asarray(balls.T_object_camera[0])
    for states in (model.sample(jax.random.key(0), 2), model.condition(balls.rgb[0, 0], T[0], jax.random.key(0), 2)):
        rgb = np.asarray(model.render(states[1], T[:2], SIZE))
        assert rgb.shape == (2, SIZE, SIZE, 3) and rgb.min() >= 0.0 and rgb.max() <= 1.0
