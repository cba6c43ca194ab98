"""Training's laws: a killed run resumes as if nothing had happened, strata are unbiased, trouble is named."""

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.kernel import library
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.tabletop import sample_objects, signed_distance
from probnerf.prior.checkpoint import load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training.batches import draw_batch, strata_of
from probnerf.training.elbo import TrainState, initial_state, loss, train
from probnerf.training.pictures import ViewSet, draw_views
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import ShapeSet, batch_of, in_cube, points_of_others
from probnerf.training.solid_terms import at_points_of_others, colour_samples
from probnerf.training.tabletop_shapes import tabletop_shapes

CONFIG = TrainConfig(
    steps=8, solid_steps=4, batch=4, ray_batch=2, views=2, object_rays=8, near_rays=4, far_rays=4,
    points=24, colours=8, warmup=2, checkpoint_every=3, log_every=1,
)  # fmt: skip
_distances = jax.jit(jax.vmap(signed_distance))
Solids = list[tuple[ShapeSet, float]]
LIKELIHOOD = Likelihood(lattice=foam.Lattice(8, 1.0))


@pytest.fixture(scope="module")
def views() -> ViewSet:
    return draw_views(np.arange(6), 3, PRESETS["tiny"].image_size)


@pytest.fixture(scope="module")
def solids() -> Solids:
    return [(tabletop_shapes(np.arange(8)), 1.0)]


def model() -> ProbNeRF:
    return ProbNeRF(PRESETS["tiny"], jax.random.key(0))


def run(solids: Solids, views: ViewSet, folder: Path, steps: int | None = None) -> TrainState:
    *_, (state, _) = islice(train(model(), solids, views, LIKELIHOOD, CONFIG, folder), steps)
    return state


@pytest.mark.slow
def test_a_killed_run_resumes_with_identical_results(solids: Solids, views: ViewSet, tmp_path: Path) -> None:
    whole = run(solids, views, tmp_path / "whole")
    run(solids, views, tmp_path / "killed", steps=5)  # the last checkpoint is of step 3: steps 4 and 5 are lost
    resumed = run(solids, views, tmp_path / "killed")
    assert int(resumed.step) == CONFIG.steps
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    lines = (tmp_path / "killed" / "history.jsonl").read_text().splitlines()
    assert lines == (tmp_path / "whole" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["rays"] for line in lines] == [False] * 4 + [True] * 4


@pytest.mark.slow
def test_a_frozen_decoder_waits_for_recognition(solids: Solids, views: ViewSet, tmp_path: Path) -> None:
    steps = train(model(), solids, views, LIKELIHOOD, replace(CONFIG, frozen_steps=2), tmp_path)
    frozen, moved = [jax.tree.map(np.asarray, state) for state, _ in islice(steps, 4)][1::2]
    for part in ("hyper", "flow"):
        start = jax.tree.leaves(getattr(model(), part))
        assert all(map(np.array_equal, jax.tree.leaves(getattr(frozen.model, part)), start))
        assert not all(map(np.array_equal, jax.tree.leaves(getattr(moved.model, part)), start))
    assert np.any(frozen.recognition.output.weight != moved.recognition.output.weight)


@pytest.mark.slow
def test_the_same_latents_stay_while_the_decoder_learns(solids: Solids, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=4, same_latents=True)
    *_, (state, _) = train(model(), solids, None, LIKELIHOOD, config, tmp_path)
    begun = initial_state(model(), config)
    for part in (lambda s: s.model.flow, lambda s: s.recognition, lambda s: s.model.encoder):
        assert all(map(np.array_equal, jax.tree.leaves(part(state)), jax.tree.leaves(part(begun))))
    moved = zip(jax.tree.leaves(state.model.hyper), jax.tree.leaves(begun.model.hyper), strict=True)
    assert not any(np.array_equal(now, then) for now, then in moved if np.ndim(now) == 2)


@pytest.mark.slow
def test_another_recipe_does_not_continue_a_run(solids: Solids, views: ViewSet, tmp_path: Path) -> None:
    run(solids, views, tmp_path, steps=4)
    other = train(model(), solids, views, LIKELIHOOD, replace(CONFIG, learning_rate=1.0), tmp_path)
    with pytest.raises(ValueError, match="another recipe"):
        next(other)


def test_a_loss_that_is_no_number_is_named_with_its_step(solids: Solids, views: ViewSet, tmp_path: Path) -> None:
    broken = eqx.tree_at(lambda m: m.hyper.bias, model(), jnp.full_like(model().hyper.bias, jnp.nan))
    with pytest.raises(FloatingPointError, match="step 1"):
        next(train(broken, solids, views, LIKELIHOOD, CONFIG, tmp_path))


def test_weighted_rays_estimate_the_mean_over_all_pixels(views: ViewSet) -> None:
    """E[sum of weight x value] is the mean of a value over every pixel of every view, whatever the strata."""
    config = replace(CONFIG, object_rays=64, near_rays=32, far_rays=32)
    strata = strata_of(views)
    estimates = []
    for step in range(60):
        chosen = np.random.default_rng([config.seed, step, 3]).choice(len(views.seeds), 4, replace=False)
        batch = draw_batch(views, strata, config, step, 4)
        value = np.asarray(batch.ray_rgb).sum(-1) + 2.0 * (np.asarray(batch.ray_range) > 0)
        totals = (np.asarray(batch.ray_weight) * value).sum(1)
        truth = (views.rgb[chosen] / 255.0).sum(-1).mean((1, 2, 3)) + 2.0 * (views.range[chosen] > 0).mean((1, 2, 3))
        estimates.append(totals - truth)
    error = np.concatenate(estimates)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size)
    assert error.std() < 0.2


@pytest.mark.slow
def test_the_kernel_trains_as_plain_jax_does(solids: Solids, views: ViewSet, monkeypatch: pytest.MonkeyPatch) -> None:
    if not library.available():
        pytest.skip("the kernel is not built: there was no C++ compiler")
    state = initial_state(model(), CONFIG)
    batch = draw_batch(views, strata_of(views), CONFIG, 0, CONFIG.ray_batch)
    shapes = batch_of(solids[0][0], np.random.default_rng(0), np.asarray(batch.rows), CONFIG.points, CONFIG.colours)
    found = []
    for available in (True, False):
        monkeypatch.setattr(library, "available", lambda available=available: available)
        one = jax.jit(jax.value_and_grad(lambda networks: loss(
            networks, shapes, batch, jax.random.key(1), jnp.ones(()), LIKELIHOOD, CONFIG
        )[0]))  # fmt: skip
        found.append(one((state.model, state.recognition)))
    (a, g), (b, h) = found
    assert float(a) == pytest.approx(float(b), rel=1e-5)
    for x, y in zip(jax.tree.leaves(g), jax.tree.leaves(h), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-4 * float(np.abs(y).max()) + 1e-12)


def test_solid_samples_are_what_the_objects_are(solids: Solids) -> None:
    """Surface points lie on the surface, normals have length 1, labels are the distance's sign, colours lie behind."""
    shapes, objects = solids[0][0], sample_objects(range(8))
    distance = np.asarray(_distances(objects, jnp.asarray(in_cube(shapes.surface))))
    assert np.mean(shapes.valid) > 0.99
    assert np.abs(distance[shapes.valid]).max() < 2.2e-3
    again = tabletop_shapes(np.arange(3, 11))  # a function of its own seed alone
    np.testing.assert_array_equal(again.points[0], shapes.points[3])

    batch = batch_of(shapes, np.random.default_rng(0), np.arange(8), 400, 100)
    assert batch.points.shape == (8, 400, 3)
    inside = np.asarray(_distances(objects, jnp.asarray(batch.points))) <= 0.0
    assert np.mean(inside == batch.inside) > 0.999
    assert 0.1 < np.mean(inside) < 0.6
    place, view = colour_samples(batch, jax.random.key(1))
    depth = -np.asarray(_distances(objects, place))[batch.valid]
    assert np.mean((depth > -3e-3) & (depth < 0.043)) > 0.98
    np.testing.assert_allclose(np.linalg.norm(view, axis=-1), 1.0, atol=1e-5)
    assert np.asarray(batch.rgb).min() >= 0.0 and np.asarray(batch.rgb).max() <= 1.0


def test_a_prior_survives_its_file(tmp_path: Path) -> None:
    saved = model()
    save_prior(tmp_path / "p.safetensors", saved, {"family": "tabletop"})
    loaded = load_prior(tmp_path / "p.safetensors", preset="tiny")
    assert loaded.metadata["family"] == "tabletop"
    for a, b in zip(jax.tree.leaves(saved), jax.tree.leaves(loaded.model), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    save_prior(tmp_path / "half.safetensors", saved, {}, half=True)
    for a, b in zip(
        jax.tree.leaves(saved), jax.tree.leaves(load_prior(tmp_path / "half.safetensors").model), strict=True
    ):
        assert b.dtype == a.dtype
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-3, atol=1e-6)
    with pytest.raises(ValueError, match="holds preset 'tiny', not 'small'"):
        load_prior(tmp_path / "p.safetensors", preset="small")
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "p.safetensors").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"cut\.safetensors is not a readable prior"):
        load_prior(tmp_path / "cut.safetensors")


def test_what_is_sure_of_the_points_of_others_is_true(solids: Solids) -> None:
    size = 8
    batch = batch_of(solids[0][0], np.random.default_rng(0), np.arange(size), 64, 8)
    points, inside, sure = map(np.asarray, points_of_others(batch, jax.random.key(0), 256))
    objects = sample_objects(range(size))
    distance = np.asarray(jax.vmap(signed_distance)(objects, jnp.asarray(points)))
    assert np.array_equal(inside[sure], distance[sure] < 0.0)
    assert np.all(sure[np.abs(distance) > 0.1]), "what is far from the surface is known"
    assert np.mean(sure & (distance > 0.1)) > 0.3, "and others' points are often far"


def test_what_is_opaque_in_free_space_is_pulled_down_however_opaque_it_is() -> None:
    class Uniform:
        def density(self, weights: jax.Array, points: jax.Array) -> jax.Array:
            return jnp.broadcast_to(weights[0], points.shape[:-1])

    points, sides = jnp.zeros((2, 3)), jnp.array([False, True])
    config, factors = TrainConfig(), jnp.array([[0.1], [10.0], [1e4]])

    def told(sure: list[bool]) -> np.ndarray:
        shared, item = (Uniform(), LIKELIHOOD, config), (points, sides, jnp.array(sure))
        slope = jax.vmap(jax.grad(lambda weights: at_points_of_others(shared, item, weights)))(factors)
        return np.asarray(slope * factors)  # a relative change's

    assert np.all(told([True, False]) < -0.01) and np.all(told([False, True]) >= 0.0)
    assert np.all(told([False, False]) == 0.0)
