"""What every change of model or sampler is held against: posteriors of the analytic field, integrated by brute force.

Yaw, handle length and radius are integrated on a grid; the samplers' yaw histograms (12 arcs of 30 degrees) and
evidence must agree with it: handle seen, hidden, or in the picture's unknown half; colour only and with depth.
"""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderModel
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view, log_likelihood_one
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.cylinder_scenes import (
    YAW_OF,
    Args,
    GridPosterior,
    draw_pixels,
    grid_of_rays,
    integrate,
    object_first,
    scene,
    total_variation,
    yaw_histogram,
)
from probnerf.pixel_status import OBJECT
from probnerf.rendering.foam import Lattice
from probnerf.sampling.annealed_hmc import annealed_hmc
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import AnnealedHMCConfig
from probnerf.types import Posterior

CONDITIONS = [(condition, depth) for condition in YAW_OF for depth in (False, True)]


def _each(args, positions):
    model, likelihood, observation, t = args
    return jax.vmap(lambda q: log_likelihood_one(model, likelihood, observation, t, q))(positions)


@cache
def _scene(condition: str, depth: bool) -> tuple[Args, GridPosterior]:
    args = scene(condition, depth)
    return args, integrate(_each, args)


def _yaw(posterior: Posterior) -> np.ndarray:
    positions = np.asarray(posterior.positions, np.float64)
    return yaw_histogram(np.arctan2(positions[:, 3], positions[:, 2]), np.exp(np.asarray(posterior.log_weights)))


# The grid and the pixels, on their own.


def test_the_grid_integrates_what_is_known_in_closed_form():
    def known(args, q):  # von Mises in yaw, Gaussians in z: a narrow one, off centre, and a wide one
        concentration, centre, width = args
        cosine = (q[:, 2] * jnp.cos(1.3) + q[:, 3] * jnp.sin(1.3)) / jnp.hypot(q[:, 2], q[:, 3])
        return concentration * (cosine - 1) - 0.5 * ((q[:, 1] - centre) / width) ** 2 - 0.05 * q[:, 0] ** 2

    concentration, centre, width = 40.0, -0.8, 0.07
    grid = integrate(known, (concentration, centre, width))
    exact = np.log(np.i0(concentration)) - concentration  # the mean of exp(k (cos - 1)) over the circle
    exact += np.log(width) - 0.5 * np.log(1 + width**2) - 0.5 * centre**2 / (1 + width**2) - 0.5 * np.log(1.1)
    assert grid.log_evidence == pytest.approx(exact, abs=0.01)
    fine = (np.arange(120_000) + 0.5) / 120_000 * 2 * np.pi
    density = np.exp(concentration * (np.cos(fine - 1.3) - 1))
    assert total_variation(grid.histogram(), yaw_histogram(fine, density / density.sum())) < 0.005
    mean = grid.probability @ grid.cells
    np.testing.assert_allclose(mean, [1.3, 0.0, centre / (1 + width**2)], atol=2e-3)
    # Along z_0 cells are as wide as the posterior: centres miss its distribution, and draws do not.
    deviation = 1.1**-0.5
    assert grid.widths[0] < 0.2 and grid.widths[1] > deviation
    points, w = grid.draw(np.random.default_rng(0), 4096, known, (concentration, centre, width))
    assert w.sum() == pytest.approx(1.0)
    error = 4.5 * 0.5 * np.sqrt(np.sum(w**2))
    for share, quantile in ((0.6, 0.2533), (0.75, 0.6745), (0.9, 1.2816)):
        assert w[points[:, 1] < quantile * deviation].sum() == pytest.approx(share, abs=error)
    assert abs(grid.probability[grid.cells[:, 1] < 0.2533 * deviation].sum() - 0.6) > 2.0 * error


def test_pixels_are_drawn_from_the_density_that_scores_them():
    # E[p(pixels | q) / p(pixels | truth)] = 1 and E[grad log p(pixels | truth)] = 0, over pixels drawn at the truth.
    model, likelihood = CylinderModel(), Likelihood(Lattice(12, max_crossings=24))
    rays = grid_of_rays(6, 4)
    truth = jnp.array([0.3, 0.1, 0.5, 0.9, 0.0, 0.0, 0.0])
    near = truth + jnp.array([[0.15, 0, 0, 0, 0, 0, 0], [0, -0.1, 0, 0, 0, 0, 0], [0, 0, -0.03, 0.03, 0, 0, 0]])
    known = jnp.arange(24) % 5 > 0

    @eqx.filter_jit
    def ratios_and_scores(keys):
        def one(key):
            observation = draw_pixels(key, model, likelihood, truth, rays, known, jnp.asarray(True))
            t = faces_of_view(observation, likelihood)

            def value(q):
                return log_likelihood_one(model, likelihood, observation, t, q)

            at_truth, score = jax.value_and_grad(value)(truth)
            return jnp.exp(jax.vmap(value)(near) - at_truth), score[:4]

        return jax.lax.map(one, keys, batch_size=64)

    ratios, scores = (np.asarray(a, np.float64) for a in ratios_and_scores(jax.random.split(jax.random.key(0), 1024)))
    assert np.all(ratios.std(axis=0) > 0.1) and np.all(scores.std(axis=0) > 0.1)
    for draws, expected in ((ratios, 1.0), (scores, 0.0)):
        error = draws.std(axis=0) / np.sqrt(len(draws))
        assert np.all(np.abs(draws.mean(axis=0) - expected) < 4 * error)


def test_object_pixels_are_put_first_and_nothing_else_changes():
    model, likelihood, observation, t = scene("half", depth=True)
    is_object = np.asarray(observation.status == OBJECT)
    assert is_object[: is_object.sum()].all() and is_object.sum() <= observation.colour_count < is_object.size
    turned = jax.tree.map(lambda a: a[::-1] if a.ndim and len(a) == is_object.size else a, observation)
    again = object_first(turned, observation.colour_count)
    q = jnp.array([0.3, 0.1, 0.5, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    value = eqx.filter_jit(log_likelihood_one)
    expected = float(value(model, likelihood, observation, t, q))
    faces = faces_of_view(again, likelihood)
    assert float(value(model, likelihood, again, faces, q)) == pytest.approx(expected, rel=1e-5)
    with pytest.raises(ValueError, match="exceed colour_count 3"):
        object_first(observation, 3)


# The samplers.


def _check(posteriors: list[Posterior], grid: GridPosterior) -> None:
    """One run's total variation scatters (0.00 to 0.11, mean 0.04, measured: 128 particles): a few are averaged."""
    assert all(posterior.result == "converged" for posterior in posteriors)
    assert np.mean([total_variation(_yaw(posterior), grid.histogram()) for posterior in posteriors]) <= 0.1
    for posterior in posteriors:
        error = max(0.5, 3.0 * float(posterior.log_evidence_se))
        assert abs(float(posterior.log_evidence) - grid.log_evidence) <= error


@pytest.mark.slow
@pytest.mark.parametrize(("condition", "depth"), CONDITIONS)
def test_tempered_smc_is_the_posterior_in_every_condition(condition, depth):
    args, grid = _scene(condition, depth)
    posteriors = [tempered_smc(jax.random.key(seed), log_likelihood, args, 9) for seed in range(2, 6)]
    _check(posteriors, grid)
    # Estimates of the evidence, not of its logarithm, average to it.
    ratios = np.exp([float(posterior.log_evidence) - grid.log_evidence for posterior in posteriors])
    assert abs(np.log(ratios.mean())) <= 0.3
    # The histogram is of the yaw alone; the sizes agree, too.
    moments = []
    for posterior in posteriors:
        w, z = np.exp(np.asarray(posterior.log_weights, np.float64)), np.asarray(posterior.positions[:, :2])
        moments.append((w @ z, np.sqrt(w @ z**2 - (w @ z) ** 2)))
    mean = grid.probability @ grid.cells[:, 1:]
    spread = np.sqrt(grid.probability @ grid.cells[:, 1:] ** 2 - mean**2)
    np.testing.assert_array_less(np.abs(np.mean([m for m, _ in moments], axis=0) - mean), 0.25 * spread)
    np.testing.assert_allclose(np.mean([s for _, s in moments], axis=0), spread, rtol=0.25)


@pytest.mark.slow
def test_tempered_smc_weighs_modes_that_the_mask_alone_cannot_tell_apart():
    (model, likelihood, observation, t), _ = _scene("hidden", False)
    mask_only = replace(observation, rgb_valid=jnp.zeros_like(observation.rgb_valid))
    args = (model, likelihood, mask_only, t)
    grid = integrate(_each, args)
    front = grid.histogram()[[0, 1, 10, 11]].sum()
    assert 0.02 < front < 0.5  # the handle may point at the camera, too
    posteriors = [tempered_smc(jax.random.key(seed), log_likelihood, args, 9) for seed in range(8)]
    _check(posteriors, grid)  # eight: two far modes scatter more
    together = np.mean([_yaw(posterior) for posterior in posteriors], axis=0)
    assert total_variation(together, grid.histogram()) <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("condition", "depth"), [("seen", False), ("hidden", False), ("half", True)])
def test_annealed_hmc_is_the_posterior_but_for_the_chains_that_annealing_left_behind(condition, depth):
    # The paper's schedule on more and shorter trajectories. It is no posterior sampler: a chain that cooled in a worse
    # mode stays there at full weight. Measured over the six conditions: 4 to 26% of the chains stuck; total variation
    # 0.09 to 0.27 of all chains, 0.03 to 0.13 of those that reached the likelihood of the posterior. The bounds are
    # what it does, not what a posterior sampler must.
    args, grid = _scene(condition, depth)
    config = AnnealedHMCConfig(chains=256, leapfrog_steps=5, keep=4)
    posterior = annealed_hmc(jax.random.key(0), log_likelihood, args, 9, config)
    order = np.argsort(grid.log_likelihood)
    lowest = grid.log_likelihood[order][np.searchsorted(np.cumsum(grid.probability[order]), 0.001)] - 2.0
    last = slice(-config.chains, None)
    yaw = np.arctan2(posterior.positions[last, 3], posterior.positions[last, 2])
    arrived = np.asarray(posterior.log_likelihoods[last]) > lowest
    everyone = yaw_histogram(yaw, np.full(yaw.size, 1.0 / yaw.size))
    those = yaw_histogram(yaw[arrived], np.full(arrived.sum(), 1.0 / arrived.sum()))
    assert total_variation(those, grid.histogram()) <= 0.15
    assert arrived.mean() > 0.6
    assert total_variation(everyone, grid.histogram()) <= 1.0 - arrived.mean() + 0.15
    assert float(posterior.diagnostics.r_hat) > 1.5  # and it says so
    assert not np.isfinite(posterior.log_evidence)
