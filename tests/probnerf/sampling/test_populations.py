"""Populations side by side: shares by evidence, runs that are pooled, samples as starts in fewer populations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.inference import sampler_of
from probnerf.sampling.populations import FAILED, log_prior, pooled, shares, start_from, thin
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import InferConfig, TemperedSMCConfig, quick_smc
from probnerf.types import Posterior

CONFIG = TemperedSMCConfig(populations=2, particles=64)
PRECISION, AT = 8.0, 0.7


def _log_likelihood(_: None, q: jax.Array) -> jax.Array:
    return -0.5 * PRECISION * (q[:, 0] - AT) ** 2


def _run(seed: int) -> Posterior:
    return tempered_smc(jax.random.key(seed), _log_likelihood, None, 3, CONFIG)


def test_shares_follow_the_evidence_to_a_power() -> None:
    estimates = np.array([0.0, np.log(3.0), -np.inf])
    share, mean = shares(estimates, 1.0)
    np.testing.assert_allclose(np.exp(share), [0.25, 0.75, 0.0], atol=1e-12)
    assert mean == pytest.approx(np.log(4.0 / 3.0))
    np.testing.assert_allclose(np.exp(shares(estimates[:2], 0.0)[0]), [0.5, 0.5])
    for missing in (np.array([0.0, np.nan]), np.full(2, -np.inf)):
        np.testing.assert_allclose(np.exp(shares(missing, 1.0)[0]), [0.5, 0.5])


def test_a_population_far_below_the_best_has_no_share_and_a_few_nats_change_nothing() -> None:
    estimates = np.array([-1000.0, -1000.0 - 2.0 * FAILED, -1004.0, -np.inf])
    np.testing.assert_allclose(np.exp(shares(estimates, 0.0)[0]), [0.5, 0.0, 0.5, 0.0])
    whole, mean = shares(estimates, 1.0)  # which it had none of anyway
    np.testing.assert_allclose(np.exp(whole), np.exp(estimates - mean) / 4.0, atol=1e-12)
    even = shares(np.array([0.0, -0.9 * FAILED]), 0.0)[0]
    np.testing.assert_allclose(np.exp(even), [0.5, 0.5])


def test_a_failed_population_is_neither_weighed_nor_published_nor_a_disagreement() -> None:
    good, poor = _run(0), _run(1)
    lost = np.array([0.0, 2.0 * FAILED], np.float32)  # its second population is in another, poorer mode
    poor = replace(
        poor,
        log_likelihoods=poor.log_likelihoods - lost[np.asarray(poor.population)],
        diagnostics=replace(poor.diagnostics, log_evidences=poor.diagnostics.log_evidences - lost),
    )
    whole = pooled([good, poor], 0.0)
    total = np.bincount(np.asarray(whole.population), weights=np.exp(np.asarray(whole.log_weights, np.float64)))
    np.testing.assert_allclose(total, [1 / 3, 1 / 3, 1 / 3, 0.0], atol=1e-6)
    assert float(whole.diagnostics.ess) == pytest.approx(0.75 * len(whole.positions), rel=1e-4)
    assert float(whole.diagnostics.r_hat) < 1.1
    _, weights, population = thin(whole, 12)
    assert np.bincount(population).tolist() == [4, 4, 4] and weights == pytest.approx(np.full(12, 1 / 12))


def test_pooled_runs_are_the_posterior_with_the_known_mean_and_evidence() -> None:
    runs = [_run(seed) for seed in range(4)]
    whole = pooled(runs, CONFIG.evidence_power)
    w = np.exp(np.asarray(whole.log_weights, np.float64))
    assert w.sum() == pytest.approx(1.0, abs=1e-5)
    # N(0, 1) times exp(-P (q - a)^2 / 2): mean P a / (1 + P), evidence exp(-P a^2 / 2 (1 + P)) / sqrt(1 + P)
    assert w @ np.asarray(whole.positions)[:, 0] == pytest.approx(PRECISION * AT / (1 + PRECISION), abs=0.05)
    log_z = -0.5 * PRECISION * AT**2 / (1 + PRECISION) - 0.5 * np.log(1 + PRECISION)
    assert float(whole.log_evidence) == pytest.approx(log_z, abs=4 * float(whole.log_evidence_se) + 1e-3)
    assert len(np.unique(whole.population)) == 8 and whole.positions.shape[0] == 4 * runs[0].positions.shape[0]
    assert float(whole.diagnostics.point_gradients) == sum(float(r.diagnostics.point_gradients) for r in runs)
    assert pooled(runs[:1], 1.0) is runs[0]


def test_a_population_weighs_by_its_evidence_among_all_runs() -> None:
    runs = [_run(0), _run(1)]
    whole = pooled(runs, 1.0)
    population, w = np.asarray(whole.population), np.exp(np.asarray(whole.log_weights, np.float64))
    total = np.bincount(population, weights=w)
    estimates = np.concatenate([np.asarray(r.diagnostics.log_evidences, np.float64) for r in runs])
    np.testing.assert_allclose(total, np.exp(estimates) / np.exp(estimates).sum(), rtol=1e-4)


def test_pooled_samples_start_fewer_populations_at_their_own_densities() -> None:
    runs = [_run(0), _run(1)]
    whole = pooled(runs, 1.0)
    q, log_q = start_from(whole, 2)
    assert q.shape == (2, whole.positions.shape[0] // 2, 3)
    estimates = np.asarray(whole.diagnostics.log_evidences)
    value = log_prior(q) + _log_likelihood(None, q.reshape(-1, 3)).reshape(2, -1)
    np.testing.assert_allclose(
        np.asarray(value - log_q).reshape(4, -1), np.repeat(estimates[:, None], q.shape[1] // 2, 1), atol=1e-4
    )
    again = tempered_smc(jax.random.key(9), _log_likelihood, None, 3, CONFIG, initial=(q, log_q))
    assert again.result == "converged" and float(again.log_evidence) == pytest.approx(
        float(whole.log_evidence), abs=0.3
    )
    with pytest.raises(ValueError, match="do not divide"):
        start_from(whole, 3)
    assert jnp.isfinite(log_q).all()


@pytest.mark.parametrize(("count", "kept"), [(8, [2, 2, 2, 2]), (10, [3, 3, 2, 2]), (4, [1] * 4), (2, [1] * 4)])
def test_so_many_samples_stand_for_all_and_every_population_keeps_its_weight(count: int, kept: list[int]) -> None:
    whole = pooled([_run(0), _run(1)], 1.0)
    indices, weights, population = thin(whole, count)
    assert np.bincount(population).tolist() == kept and len(indices) == max(count, 4)
    np.testing.assert_array_equal(np.asarray(whole.population)[indices], population)
    share = np.bincount(np.asarray(whole.population), weights=np.exp(np.asarray(whole.log_weights, np.float64)))
    np.testing.assert_allclose(np.bincount(population, weights=weights), share / share.sum(), rtol=1e-6)


@pytest.mark.parametrize("count", [4, 10, 64])
def test_samples_are_taken_where_the_cumulated_weight_first_reaches_even_levels(count: int) -> None:
    whole = _run(0)
    log_w = np.random.default_rng(1).normal(size=len(whole.log_weights)).astype(np.float32)
    for weights in (log_w, np.zeros_like(log_w)):  # where all weigh the same a level may be met exactly
        indices, _, population = thin(replace(whole, log_weights=jnp.asarray(weights)), count)
        for name in np.unique(population):
            members, kept = np.flatnonzero(np.asarray(whole.population) == name), np.sum(population == name)
            w = np.exp(weights[members].astype(np.float64) - weights[members].max())
            at = np.searchsorted(np.cumsum(w) / w.sum(), (np.arange(kept) + 0.5) / kept)
            np.testing.assert_array_equal(indices[population == name], members[at])


def test_what_goes_on_keeps_to_the_populations_that_made_it() -> None:
    """Two runs of two populations are as many as one of four."""
    config = InferConfig(smc=quick_smc(4, 4), smc_from_prior=quick_smc(2, 16))

    def made_by(smc: TemperedSMCConfig, runs: int) -> Posterior:
        return pooled([tempered_smc(jax.random.key(k), _log_likelihood, None, 3, smc) for k in range(runs)], 0.0)

    for smc, runs in ((config.smc, 1), (config.smc, 2), (config.smc_from_prior, 1), (config.smc_from_prior, 2)):
        assert sampler_of(config, None, made_by(smc, runs)) is smc
