"""pixelNeRF, NeRF-VAE and pi-GAN: what their parts do whatever they have learnt, and that all of them learn."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.rivals.discriminator import Discriminator, halved
from benchmarks.rivals.model import save_rival
from benchmarks.rivals.nerf_vae import NeRFVAE
from benchmarks.rivals.pixel_nerf import bilinear
from benchmarks.rivals.registry import RIVALS, load
from benchmarks.rivals.volume import Pictures, directions, projected
from probnerf.geometry import look_at

BOX = (-0.7, -0.4, -0.8, 0.7, 0.4, 0.0)
TAN = 0.5
SIZE = 16


@pytest.fixture(scope="module")
def pictures():
    rng = np.random.default_rng(0)
    places = rng.normal(size=(2, 3, 3))
    places *= 1.7 / np.linalg.norm(places, axis=-1, keepdims=True)
    T = np.array([[look_at(place, np.array([0.0, 0.0, -0.4])) for place in each] for each in places], np.float32)
    rgb = rng.integers(0, 256, (2, 3, SIZE, SIZE, 3), np.uint8)
    frame = np.broadcast_to([4, 4, 12, 12], (2, 3, 4))
    return Pictures(jnp.asarray(rgb), jnp.asarray(T), jnp.asarray(TAN), jnp.asarray(frame))


def tiny(name):
    entry = RIVALS[name]
    changes = {"nerf_vae": {"size": SIZE}}.get(name, {})
    return entry.config(box=BOX, tan_half_fov=TAN, **entry.tiny | changes)


def test_a_point_appears_where_its_ray_left(pictures):
    T = pictures.T_object_camera[0, 0]
    pixel = jax.random.uniform(jax.random.key(0), (20, 2), maxval=SIZE)
    points = T[:3, 3] + 1.3 * directions(T, jnp.asarray(TAN), pixel, SIZE)
    place, camera = projected(T, jnp.asarray(TAN), points, SIZE)
    np.testing.assert_allclose(place, pixel, atol=1e-4)
    np.testing.assert_allclose(jnp.linalg.norm(camera, axis=-1), 1.3, rtol=1e-5)


def test_features_are_those_of_a_pixel_at_its_centre_and_means_between(pictures):
    picture = jax.random.normal(jax.random.key(0), (8, 8, 4))
    row, column = np.meshgrid(np.arange(8), np.arange(8), indexing="ij")
    centres = jnp.stack([column, row], axis=-1).reshape(-1, 2) + 0.5
    np.testing.assert_allclose(bilinear(picture, centres), picture.reshape(-1, 4), atol=1e-6)
    between = bilinear(picture, jnp.array([[3.0, 2.5], [-9.0, 0.5], [99.0, 99.0]]))
    np.testing.assert_allclose(between, [picture[2, 2:4].mean(axis=0), picture[0, 0], picture[7, 7]], atol=1e-6)


@pytest.mark.nightly
def test_an_encoder_ignores_unused_pictures_and_their_order(pictures):
    model = NeRFVAE(tiny("nerf_vae"), jax.random.key(0))
    rgb, T = pictures.rgb[0], pictures.T_object_camera[0]
    answer = jnp.stack(model.encoder(rgb, T, TAN, jnp.array([1.0, 1.0, 0.0])))
    turned = jnp.array([1, 0, 2])
    other = jnp.stack(model.encoder(rgb[turned].at[2].set(7), T[turned], TAN, jnp.array([1.0, 1.0, 0.0])))
    np.testing.assert_allclose(answer, other, atol=1e-5)
    fewer = jnp.stack(model.encoder(rgb, T, TAN, jnp.array([1.0, 0.0, 0.0])))
    assert not np.allclose(answer, fewer, atol=1e-4)


@pytest.mark.nightly
def test_a_discriminator_does_not_see_detail_before_it_fades_in(pictures):
    judge = Discriminator(8, 2, (8, 8, 16), jax.random.key(0))
    rgb = jnp.moveaxis(pictures.rgb[0] / 127.5 - 1.0, 3, 1)
    row, column = np.indices((SIZE, SIZE))
    detailed = rgb + 0.5 * (-1.0) ** (row + column)
    np.testing.assert_allclose(halved(detailed), halved(rgb), atol=1e-6)
    T = pictures.T_object_camera[0]
    before, after = (np.array([judge(x, T, jnp.asarray(new)) for x in (rgb, detailed)]) for new in (0.0, 1.0))
    np.testing.assert_allclose(before[0], before[1], atol=1e-5)
    assert not np.allclose(after[0], after[1], atol=1e-3)
    assert not np.allclose(judge(rgb, T[::-1], jnp.asarray(1.0)), after[0], atol=1e-3)  # it is told the camera


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["pixel_nerf", "nerf_vae", "pi_gan"])
def test_everything_learns_and_a_file_gives_it_back(name, pictures, tmp_path: Path):
    config = tiny(name)
    recipe = RIVALS[name].recipe(config)
    before = jax.jit(recipe.start)(jax.random.key(0))
    state = before
    for phase in recipe.phases:
        state, metrics = jax.jit(phase.step)(state, pictures, jnp.asarray(0.3), jax.random.key(1))
        assert all(np.isfinite(value) for value in metrics.values())
    model = recipe.model(state)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    moved = jax.tree.map(lambda old, new: bool((old != new).any()), recipe.model(before), model)
    still = [jax.tree_util.keystr(path) for path, moves in jax.tree_util.tree_flatten_with_path(moved)[0] if not moves]
    assert not still

    save_rival(tmp_path / "rival.safetensors", name, model, {})
    found, _ = load(tmp_path / "rival.safetensors")
    halves = jax.tree.map(lambda leaf: leaf.astype(jnp.float16).astype(jnp.float32), model)

    def shown(rival):
        key = jax.random.key(2)
        given = pictures.rgb[0, 0], pictures.T_object_camera[0, 0]
        states = rival.condition(*given, key, 2) if name != "pi_gan" else rival.sample(key, 2)
        return rival.render(jax.tree.map(lambda leaf: leaf[1], states), pictures.T_object_camera[0, 1:], 8)

    rgb = shown(found)
    assert rgb.shape == (2, 8, 8, 3) and rgb.min() >= 0.0 and rgb.max() <= 1.0 + 1e-5
    np.testing.assert_allclose(rgb, shown(halves), atol=1e-6)
