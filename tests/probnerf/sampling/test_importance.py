"""Importance weights: the shape of their tail, the evidence, and when they are answer enough."""

from dataclasses import replace
from time import monotonic

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.sampling import importance
from probnerf.sampling.defensive_mixture import DefensiveMixture
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.sampling.importance import WeighedDraws, weigh
from probnerf.sampling.pareto_tail import pareto_k
from probnerf.settings import NetworkConfig

DIM, PRECISION = 4, 8.0
CENTRE = jnp.array([1.0, -0.5, 0.0, 0.5])
CONFIG = NetworkConfig(prior_share=0.2)


@pytest.mark.parametrize("k", [0.2, 0.5, 0.9])
def test_the_tail_of_a_pareto_distribution_has_its_shape(k: float) -> None:
    rng = np.random.default_rng(0)
    found = [pareto_k(100.0 - k * np.log(rng.uniform(size=4_000))) for _ in range(40)]
    assert np.mean(found) == pytest.approx(k, abs=0.05) and np.std(found) < 0.15


def test_light_and_bounded_tails_are_told_from_heavy_ones() -> None:
    rng = np.random.default_rng(1)
    exponential = [pareto_k(np.log(rng.exponential(size=4_000))) for _ in range(40)]
    assert abs(np.mean(exponential)) < 0.1
    assert pareto_k(np.log(rng.uniform(size=4_000))) < -0.5
    assert pareto_k(30.0 * rng.normal(size=4_000)) > 5.0  # one weight is nearly all


def test_a_tail_that_cannot_be_fitted_has_no_shape() -> None:
    nothing = np.full(500, -np.inf)
    assert all(np.isnan(pareto_k(w)) for w in (np.zeros(500), nothing, np.append(nothing, 0.0), np.arange(9.0)))


def _likelihood(centre: jax.Array, q: jax.Array) -> jax.Array:
    return -0.5 * PRECISION * jnp.sum((q - centre) ** 2, axis=-1)


def _covering(at: jax.Array, precision: float) -> DefensiveMixture:
    one = GaussianMixture(jnp.zeros(1), at[None], np.sqrt(precision) * jnp.eye(DIM)[None])
    return DefensiveMixture(one, jnp.asarray(CONFIG.prior_share))


def test_weighed_draws_of_a_good_density_are_the_posterior() -> None:
    """Of a Gaussian likelihood: evidence, mean and variance, within four of their own standard errors."""
    total = 1.0 + PRECISION
    exact = -0.5 * DIM * np.log(total) - 0.5 * PRECISION / total * float(CENTRE @ CENTRE)
    mixture = _covering(CENTRE * PRECISION / total, 0.6 * total)
    draws = weigh(jax.random.key(0), _likelihood, CENTRE, mixture, CONFIG)
    assert draws.suffice(CONFIG) and len(draws.log_weights) < CONFIG.most
    found = draws.posterior()
    se = float(found.log_evidence_se)
    assert 0.0 < se < 0.1 and abs(float(found.log_evidence) - exact) < 4 * se
    each = np.asarray(found.diagnostics.log_evidences)
    assert np.logaddexp.reduce(each) - np.log(len(each)) == pytest.approx(float(found.log_evidence), abs=1e-4)
    w, x = np.exp(np.asarray(found.log_weights, np.float64)), np.asarray(found.positions)
    assert w.sum() == pytest.approx(1.0, abs=1e-4) and 1.0 / (w @ w) == pytest.approx(draws.ess, rel=1e-3)
    error = 4 / np.sqrt(draws.ess * total)
    np.testing.assert_allclose(w @ x, CENTRE * PRECISION / total, atol=error)
    np.testing.assert_allclose(np.sqrt(w @ (x - w @ x) ** 2), 1 / np.sqrt(total), atol=error)
    assert found.result == "converged" and np.all(np.asarray(found.diagnostics.beta) == 1.0)
    np.testing.assert_allclose(found.log_density, mixture.log_density(found.positions), atol=1e-4)


def test_draws_of_a_poor_density_do_not_suffice_and_are_soon_given_up() -> None:
    draws = weigh(jax.random.key(0), _likelihood, 2.0 * CENTRE, _covering(-CENTRE, 50.0), CONFIG)
    assert not draws.suffice(CONFIG) and len(draws.log_weights) == CONFIG.chunk


def test_more_draws_are_weighed_while_they_may_suffice_and_time_is_left() -> None:
    mixture, wants = _covering(CENTRE, PRECISION), replace(CONFIG, enough_ess=1_500.0)
    key = jax.random.key(0)
    assert len(weigh(key, _likelihood, CENTRE, mixture, wants).log_weights) > 3 * CONFIG.chunk
    assert len(weigh(key, _likelihood, CENTRE, mixture, wants, monotonic()).log_weights) == CONFIG.chunk
    few = replace(wants, most=CONFIG.chunk)
    assert len(weigh(key, _likelihood, CENTRE, mixture, few).log_weights) == CONFIG.chunk


def _with_weights(log_weights: np.ndarray) -> WeighedDraws:
    nothing = np.zeros(len(log_weights))
    return WeighedDraws(np.zeros((len(log_weights), 1)), nothing, nothing, log_weights)


def test_halves_that_differ_and_weights_that_are_all_zero_do_not_suffice() -> None:
    log_w = np.log(np.random.default_rng(0).uniform(size=1_024))
    assert _with_weights(log_w).suffice(CONFIG)
    odd = log_w + 1.5 * (np.arange(1_024) % 2)
    assert _with_weights(odd).apart == pytest.approx(1.5, abs=0.2) and not _with_weights(odd).suffice(CONFIG)
    none = _with_weights(np.full(1_024, -np.inf))
    assert none.ess == 0.0 and none.apart == np.inf and not none.suffice(CONFIG)
    even = np.where(np.arange(1_024) % 2, -np.inf, 0.0)
    assert _with_weights(even).apart == np.inf
    assert importance._GROUPS % 2 == 0 and CONFIG.chunk % importance._GROUPS == 0


def test_wrong_settings_are_refused() -> None:
    for wrong in ({"chunk": 100}, {"chunk": 0}, {"most": -1}, {"guess": 0}, {"prior_share": 0.0}, {"apart": 0.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            NetworkConfig(**wrong)
