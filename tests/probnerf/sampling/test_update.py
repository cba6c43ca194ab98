"""A further view, and a run that goes on: the posterior of all views, by brute force."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view, log_likelihood_one
from probnerf.objects.cylinder_scenes import Args, integrate, scene, total_variation, yaw_histogram
from probnerf.sampling.modes import mixture_of_modes
from probnerf.sampling.populations import start_from
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import ModesConfig, TemperedSMCConfig
from probnerf.types import Posterior, joined

CONFIG = TemperedSMCConfig(populations=4, particles=64)


@eqx.filter_jit
def _each(args, positions):
    model, likelihood, observation, t = args
    return jax.vmap(lambda q: log_likelihood_one(model, likelihood, observation, t, q))(positions)


def _start(before: Posterior):
    return start_from(before, CONFIG.populations)


def _yaw(posterior: Posterior) -> np.ndarray:
    positions = np.asarray(posterior.positions, np.float64)
    return yaw_histogram(np.arctan2(positions[:, 3], positions[:, 2]), np.exp(np.asarray(posterior.log_weights)))


def _spread(posterior: Posterior) -> float:
    """Standard deviation of the yaw about the truth, 180 degrees (radians)."""
    w, q = np.exp(np.asarray(posterior.log_weights)), np.asarray(posterior.positions)
    return float(np.sqrt(w @ np.arctan2(-q[:, 3], -q[:, 2]) ** 2))


def _both(first: Args, second: Args) -> Args:
    model, _, observation, _ = first
    likelihood = max(first[1], second[1], key=lambda each: each.lattice.max_crossings)
    together = joined([observation, second[2]])
    return model, likelihood, together, faces_of_view(together, likelihood)


@cache
def _first() -> tuple[Args, Posterior]:
    args = scene("hidden", True)
    return args, tempered_smc(jax.random.key(0), log_likelihood, args, 9, CONFIG)


def test_joined_views_are_of_one_object_whose_place_is_as_uncertain_as_the_first_view_says() -> None:
    """Its pose's latents are scaled by the first's widths, whatever the widths a later view was given."""
    sizes = {"columns": 6, "rows": 4, "cubes": 8}
    first, second = scene("hidden", True, **sizes), scene("hidden", True, azimuth=110.0, seed=1, **sizes)
    first = (*first[:2], replace(first[2], pose_sigma=jnp.array([0.1, 0.05, 0.2, 0.03, 0.02])), first[3])
    wider = replace(second[2], pose_sigma=10.0 * first[2].pose_sigma)
    q = jax.random.normal(jax.random.key(1), (3, 9))
    as_first = (*second[:2], replace(second[2], pose_sigma=first[2].pose_sigma), second[3])
    together = _each(_both(first, (*second[:2], wider, second[3])), q)
    np.testing.assert_allclose(together, _each(first, q) + _each(as_first, q), rtol=1e-5)
    assert not np.allclose(_each((*second[:2], wider, second[3]), q), _each(as_first, q), rtol=0.01)  # so they tell


@pytest.mark.slow
def test_views_that_are_joined_multiply_their_likelihoods() -> None:
    first, second = scene("hidden", True), scene("hidden", True, azimuth=110.0, seed=1)
    q = jax.random.normal(jax.random.key(1), (5, 9))
    expected = _each(first, q) + _each(second, q)
    np.testing.assert_allclose(_each(_both(first, second), q), expected, rtol=1e-5)


@pytest.mark.slow
def test_a_second_view_that_shows_the_handle_collapses_the_yaw_to_the_truth() -> None:
    first, before = _first()
    args = _both(first, scene("hidden", True, azimuth=110.0, seed=1))
    grid = integrate(_each, args)
    yaw = jnp.arange(12) * (2 * jnp.pi / 12)
    starts = jnp.zeros((12, 9)).at[:, 2].set(jnp.cos(yaw)).at[:, 3].set(jnp.sin(yaw))
    reference = mixture_of_modes(args, starts, ModesConfig())
    after = tempered_smc(jax.random.key(1), log_likelihood, args, 9, CONFIG, reference=reference)
    assert after.result == "converged"
    assert total_variation(_yaw(after), grid.histogram()) <= 0.1
    assert abs(float(after.log_evidence) - grid.log_evidence) <= max(0.5, 3 * float(after.log_evidence_se))
    assert _spread(after) < 0.4 * _spread(before)


@pytest.mark.slow
def test_the_same_view_again_asked_of_its_own_posterior_changes_nothing_and_takes_no_tempering() -> None:
    args, before = _first()
    after = tempered_smc(jax.random.key(2), log_likelihood, args, 9, CONFIG, initial=_start(before))
    assert int(after.diagnostics.stages) == CONFIG.final_stages
    assert float(after.log_evidence) == pytest.approx(float(before.log_evidence), abs=1e-3)
    assert total_variation(_yaw(after), _yaw(before)) <= 0.15


@pytest.mark.slow
def test_an_unfinished_posterior_goes_on_from_its_temperature() -> None:
    args, done = _first()
    cut = tempered_smc(jax.random.key(3), log_likelihood, args, 9, CONFIG, stages=1)
    assert cut.result == "stages" and float(cut.diagnostics.beta.min()) < 1
    after = tempered_smc(jax.random.key(4), log_likelihood, args, 9, CONFIG, initial=_start(cut))
    assert after.result == "converged"
    assert total_variation(_yaw(after), _yaw(done)) <= 0.15
    assert abs(float(after.log_evidence) - float(done.log_evidence)) <= 1.0


@pytest.mark.slow
def test_starts_are_weighed_by_the_law_that_they_were_drawn_from() -> None:
    _, before = _first()
    positions, log_q = _start(before)
    assert positions.shape[:2] == log_q.shape == (4, len(before.log_weights) // 4)
    log_prior = -0.5 * jnp.sum(positions**2 + jnp.log(2 * jnp.pi), axis=-1)
    order = np.argsort(np.asarray(before.population), kind="stable")
    value = np.asarray(before.log_likelihoods, np.float64)[order].reshape(log_q.shape)
    log_z = np.broadcast_to(np.asarray(before.diagnostics.log_evidences)[:, None], log_q.shape)
    np.testing.assert_allclose(np.asarray(log_q) - np.asarray(log_prior), value - log_z, atol=1e-3)
