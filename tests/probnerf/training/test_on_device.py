"""Batches drawn on the device have the law of those that the host draws, and are trained on alike."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.likelihood.settings import Likelihood
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training import elbo, on_device, posterior_flow
from probnerf.training.picture_set import changed
from probnerf.training.settings import PosteriorTrainConfig, TrainConfig
from probnerf.training.shape_set import ShapeSet, batch_of
from probnerf.training.tabletop_shapes import tabletop_shapes
from tests.probnerf.training.test_posterior_flow import CONFIG, SIZES, PosteriorNetwork, toy

RECIPE = TrainConfig(steps=8, solid_steps=8, batch=4, points=32, colours=8, warmup=2, map_batch=4)


@pytest.fixture(scope="module")
def shapes() -> ShapeSet:
    return tabletop_shapes(np.arange(6))


def test_a_batch_holds_what_its_objects_have_at_their_shares(shapes: ShapeSet):
    first, second = shapes[np.arange(2)], shapes[np.arange(2, 6)]
    device = on_device.shapes_on_device([(first, 0.75), (second, 0.25)])
    batch = on_device.drawn_shapes(device, jax.random.key(0), 512, 32, 8)
    whole = batch_of(shapes, np.random.default_rng(0), np.arange(6), 32, 8)
    rows = np.array([np.flatnonzero((d == whole.distance).all(axis=1))[0] for d in np.asarray(batch.distance)])
    assert abs((rows < 2).mean() - 0.75) < 0.06 and set(rows) == set(range(6))
    np.testing.assert_allclose(batch.anchor_rgb, np.asarray(whole.anchor_rgb)[rows], atol=1e-6)
    np.testing.assert_array_equal(batch.appearance, np.asarray(whole.appearance)[rows])
    every = shapes.points.astype(np.float32) * np.float32(1.25 / 32767.0)
    for k in range(0, 512, 97):  # each drawn point is one of its object's, with its own side of the surface
        gap = np.abs(every[rows[k]][None] - np.asarray(batch.points[k])[:, None]).max(axis=2)
        at = gap.argmin(axis=1)
        assert gap.min(axis=1).max() < 1e-5 and (at < 1536).sum() == 24
        np.testing.assert_array_equal(shapes.inside[rows[k], at], batch.inside[k])


@pytest.mark.slow
def test_steps_on_the_device_are_steps_of_the_host(shapes: ShapeSet):
    preset = PRESETS["tiny"]
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    device = on_device.shapes_on_device([(shapes, 1.0)])
    state = elbo.initial_state(ProbNeRF(preset, jax.random.key(0)), RECIPE)
    plain = jax.tree.map(jnp.copy, state)
    for step in range(3):
        key = jax.random.fold_in(jax.random.key(RECIPE.seed + 1), step)
        solids = on_device.drawn_shapes(device, key, RECIPE.batch, RECIPE.points, RECIPE.colours)
        plain, figures = elbo.train_step((likelihood, RECIPE), plain, solids, None)
    many, all_figures = on_device.train_solids((likelihood, RECIPE, device, 3), state)
    np.testing.assert_allclose(all_figures["loss"][-1], figures["loss"], rtol=1e-3)
    for a, b in zip(jax.tree.leaves(many.model), jax.tree.leaves(plain.model), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-2, atol=1e-4)


def test_pictures_are_changed_as_on_the_host():
    pictures, _ = toy(60, 0)
    rows = np.arange(60)
    device = on_device.pictures_on_device(pictures, rows)
    config = replace(CONFIG, without_depth=0.0, known_pose=0.0, occluded=0.0)
    here = on_device.changed_pictures(device, jnp.asarray(rows), jax.random.key(0), config)
    there = changed(pictures, rows, np.random.default_rng(0), config)
    for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
        np.testing.assert_array_equal(a, b)
    config = replace(config, known_pose=1.0)
    here = on_device.changed_pictures(device, jnp.asarray(rows), jax.random.key(0), config)
    there = changed(pictures, rows, np.random.default_rng(0), config)
    assert bool(here.known.all())
    for a, b in zip(jax.tree.leaves(here), jax.tree.leaves(there), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_occluders_hide_their_share():
    seen = jax.random.uniform(jax.random.key(0), (60, 24, 24)) < 0.4
    share = np.random.default_rng(0).uniform(0.1, 0.8, 60)
    share[:5] = 0.0
    hidden = np.asarray(on_device.occluders(jax.random.key(1), seen, jnp.asarray(share)))
    np.testing.assert_allclose((hidden & seen).sum((1, 2)) / seen.sum((1, 2)), share, atol=0.02)
    assert not hidden[:5].any() and (hidden & ~np.asarray(seen))[5:].any((1, 2)).all()


@pytest.mark.slow
def test_a_network_learns_from_pictures_on_the_device():
    pictures, _ = toy(256, 1)
    config = PosteriorTrainConfig(steps=120, batch=64, warmup=10, learning_rate=3e-3)
    device = on_device.pictures_on_device(pictures, np.arange(256))
    state = posterior_flow.initial_state(PosteriorNetwork(SIZES, jax.random.key(0)), config)
    state, figures = on_device.train_pictures((config, None, device, 120), state)
    assert int(state.step) == 120
    assert float(jnp.mean(figures["loss"][-20:])) < float(jnp.mean(figures["loss"][:20])) - 0.25
