"""A decoder that goes on learning leaves a prior and its recognition, and is judged where space is surely free."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.household.decoder import Options, ghosts, main
from probnerf.prior.checkpoint import (
    load_prior,
    load_recognition,
    network_path,
    recognition_path,
    save_posterior_network,
    save_prior,
    save_recognition,
)
from probnerf.prior.networks import PRESETS, ProbNeRF, Recognition
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork
from probnerf.training.shape_set import (
    ANYWHERE,
    CLIP,
    DESCRIPTION,
    GRID,
    NEAR,
    PAINT_NUMBERS,
    SURFACE,
    TABLETOP_NUMBERS,
    ShapeSet,
    as_units,
    centres,
    in_cube,
    nearest,
)

TINY = PRESETS["tiny"]
MODEL = ProbNeRF(TINY, jax.random.key(0))
RECOGNITION = Recognition(DESCRIPTION, TINY.latent, TINY.hyper_hidden, jax.random.key(1))


@pytest.fixture(scope="module")
def shapes() -> ShapeSet:
    """Balls."""
    rng, count = np.random.default_rng(0), 8
    radius = rng.uniform(0.3, 0.8, count)[:, None]
    normal = rng.standard_normal((count, NEAR + ANYWHERE, 3))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    away = rng.uniform(0.0, 1.0, (count, NEAR + ANYWHERE))
    surface = as_units(radius[..., None] * normal[:, :SURFACE])
    distance = np.linalg.norm(centres(GRID), axis=1) - radius
    return ShapeSet(
        distance=np.clip(distance, -CLIP, CLIP).astype(np.float16),
        points=as_units(away[..., None] * normal),
        inside=away < radius,
        surface=surface,
        normal=(127 * normal[:, :SURFACE]).astype(np.int8),
        valid=np.ones((count, SURFACE), bool),
        anchor=np.stack([nearest(in_cube(each)) for each in surface]),
        rgb=rng.integers(0, 256, (count, 1, SURFACE, 3), np.uint8),
        appearance=np.zeros((count, 1, PAINT_NUMBERS + TABLETOP_NUMBERS), np.float16),
        kind=np.zeros(count, np.uint8),
    )


def test_all_is_extra_where_nothing_is_and_nothing_where_all_is_solid(shapes: ShapeSet) -> None:
    def told(distance: float) -> dict[str, float]:
        return ghosts(MODEL, RECOGNITION, replace(shapes, distance=np.full_like(shapes.distance, distance)))

    empty, full = told(CLIP), told(-CLIP)
    assert (empty["lost"], full["extra"], full["objects"]) == (0.0, 0.0, 0.0)
    made = 1.0 - full["lost"]  # share of the cube that these shapes fill
    assert (empty["extra"] > 0.0) == (made > 0.0)


@pytest.mark.nightly
def test_a_run_leaves_a_prior_and_goes_on_from_where_it_ended(shapes: ShapeSet, tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    save_prior(path, MODEL, {}, half=True)
    first = load_prior(path).hash
    save_recognition(recognition_path(path), RECOGNITION, first)
    sizes = NetworkSizes(latent=TINY.latent, image_size=TINY.image_size, channels=4, context=4, trunk=4, condition=4)
    network = PosteriorNetwork(sizes, jax.random.key(2))
    save_posterior_network(network_path(path), network, first, {})
    shapes.save(tmp_path / "tabletop-000000.shapes")
    options = Options(prior=path, work=tmp_path, out=tmp_path / "out", held_out=2)
    recipe = replace(options.train, steps=2, solid_steps=2, batch=4, points=24, colours=8)
    options = replace(options, train=replace(recipe, same_latents=True, checkpoint_every=1))
    main(options)
    learnt = tmp_path / "out" / "prior.safetensors"
    weights, prior = learnt.read_bytes(), load_prior(learnt)
    kept, given = jax.tree.leaves(prior.network), jax.tree.leaves(load_prior(path).network)
    assert kept and all(map(np.array_equal, kept, given)), "the network stays right"
    load_recognition(recognition_path(learnt), prior)
    assert prior.metadata["decoder_trained_on"]["steps"] == 2 and prior.hash != first
    main(options)  # nothing is left to do
    assert learnt.read_bytes() == weights


def test_a_folder_without_shapes_is_named(tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    save_prior(path, MODEL, {}, half=True)
    save_recognition(recognition_path(path), RECOGNITION, load_prior(path).hash)
    with pytest.raises(ValueError, match="no shapes"):
        main(Options(prior=path, work=tmp_path))
