"""Laws of tempered SMC. Bounds are multiples of the Monte Carlo error over runs or populations, seeds fixed."""

import time
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.sampling.hmc import StageInfo
from probnerf.sampling.populations import log_prior
from probnerf.sampling.resampling import ess as effective_size
from probnerf.sampling.resampling import next_beta
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import TemperedSMCConfig
from probnerf.types import Posterior

CONFIG = TemperedSMCConfig(populations=4, particles=32, start_particles=128)
DIM = 8


def mixture(args, q):
    """log sum_k exp(log_w_k) exp(-|A_k q - y_k|^2 / 2) + shift; NaN where q_0 > wall."""
    A, y, log_w, shift, wall = args
    fit = -0.5 * jnp.sum((jnp.einsum("knd,pd->pkn", A, q) - y) ** 2, axis=2)
    return jnp.where(q[:, 0] > wall, jnp.nan, jax.scipy.special.logsumexp(log_w + fit, axis=1) + shift)


def arguments(A, y, log_w, shift=0.0, wall=np.inf):
    """Arguments of `mixture`, always with 8 rows: every problem of a dimension runs the same program."""
    rows = 8 - np.shape(A)[1]
    A, y = np.pad(A, ((0, 0), (0, rows), (0, 0))), np.pad(y, ((0, 0), (0, rows)))
    return tuple(jnp.asarray(a, jnp.float32) for a in (A, y, log_w, shift, wall))


def gaussian(dim: int, precisions: list[float], seed: int = 0, shift: float = 0.0):
    """A linear-Gaussian problem along random directions, as a mixture of two equal halves.

    Returns the arguments, and the posterior's mean, covariance and log-evidence.
    """
    rng = np.random.default_rng(seed)
    A = np.sqrt(precisions)[:, None] * np.linalg.qr(rng.normal(size=(dim, dim)))[0][: len(precisions)]
    y = A @ rng.normal(size=dim) + rng.normal(size=len(precisions))
    covariance = np.linalg.inv(np.eye(dim) + A.T @ A)
    marginal = np.eye(len(y)) + A @ A.T
    evidence = -0.5 * y @ np.linalg.solve(marginal, y) - 0.5 * np.linalg.slogdet(marginal)[1] + shift
    return arguments([A, A], [y, y], np.log([0.5, 0.5]), shift), covariance @ A.T @ y, covariance, evidence


def two_modes(share: float):
    """Two modes 9 standard deviations apart along q_0, the first with `share` of the mass; and the log-evidence."""
    precision, centre = 10.0, 1.5
    A = np.sqrt(precision) * np.eye(DIM)[:2]
    y = np.sqrt(precision) * np.array([[centre, 0.0], [-centre, 0.0]])
    evidence = -np.log1p(precision) - 0.5 * centre**2 * precision / (1 + precision)
    return arguments([A, A], y, np.log([share, 1 - share])), evidence


def weighted(posterior: Posterior, values) -> np.ndarray:
    return np.exp(np.asarray(posterior.log_weights, np.float64)) @ np.asarray(values, np.float64)


def test_moments_and_evidence_of_a_gaussian_in_8_dimensions():
    args, mean, covariance, evidence = gaussian(DIM, [2000.0, 100.0, 9.0, 1.0])
    stages: list[StageInfo] = []
    posterior = tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, on_stage=stages.append)
    assert posterior.result == "converged"
    assert float(posterior.log_evidence_se) < 0.25
    assert abs(float(posterior.log_evidence) - evidence) < 3 * float(posterior.log_evidence_se)
    z = (np.asarray(posterior.positions) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    # 1,024 draws; were they independent the errors would be 0.031 and 0.044 (about 1.5 times that is measured).
    assert np.abs(weighted(posterior, z)).max() < 0.2
    assert np.abs(weighted(posterior, z**2) - 1).max() < 0.3
    np.testing.assert_allclose(posterior.log_likelihoods, mixture(args, posterior.positions), atol=1e-2)

    assert [stage.stage for stage in stages] == list(range(len(stages)))
    assert all(np.diff([stage.beta for stage in stages], axis=0).ravel() >= 0)
    assert stages[-1].beta == (1.0,) * 4
    tempering = [e for stage in stages[1:] for e, b in zip(stage.ess, stage.beta, strict=True) if b < 1 and e > 0]
    np.testing.assert_allclose(tempering, 0.5 * 4 * 32, rtol=0.1)  # the ESS asked for, to the grid's resolution
    assert np.mean([stage.acceptance for stage in stages[1:]]) > 0.8
    shares = [
        float(np.exp(np.asarray(posterior.log_weights))[np.asarray(posterior.population) == p].sum()) for p in range(4)
    ]
    expected = np.exp(np.array(stages[-1].log_evidence) - np.logaddexp.reduce(stages[-1].log_evidence))
    np.testing.assert_allclose(shares, expected, rtol=1e-4)
    diagnostics = posterior.diagnostics
    assert float(diagnostics.r_hat) < 1.05
    assert float(diagnostics.ess) == pytest.approx(1024 / np.sum(4 * np.array(shares) ** 2), rel=1e-3)
    assert 4 <= int(diagnostics.ancestors) <= 128
    assert int(diagnostics.stages) == len(stages) - 1
    assert float(diagnostics.point_gradients) == 4 * 32 + (len(stages) - 1) * 4 * 32 * 16


def test_a_scale_ratio_of_200_in_unknown_directions_of_64():
    args, mean, covariance, evidence = gaussian(64, [40000.0, 9000.0, 1500.0, 300.0, 60.0, 12.0, 3.0])
    posterior = tempered_smc(jax.random.key(1), mixture, args, 64, CONFIG)
    z = (np.asarray(posterior.positions) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert abs(float(posterior.log_evidence) - evidence) < 3 * float(posterior.log_evidence_se)
    assert float(posterior.log_evidence_se) < 0.4
    assert float(posterior.diagnostics.acceptance) > 0.9
    assert float(posterior.diagnostics.r_hat) < 1.05
    assert np.sqrt(np.mean(weighted(posterior, z) ** 2)) < 0.08
    assert np.mean(weighted(posterior, z**2)) == pytest.approx(1.0, abs=0.03)
    assert np.abs(weighted(posterior, z**2) - 1).max() < 0.4


def test_two_separate_modes_get_their_weights():
    args, evidence = two_modes(0.7)
    runs = [tempered_smc(jax.random.key(seed), mixture, args, DIM, CONFIG) for seed in range(16)]
    shares = np.array([weighted(run, run.positions[:, 0] > 0) for run in runs])
    error = shares.std(ddof=1) / 4
    assert error < 0.03
    assert abs(shares.mean() - 0.7) < 3 * error
    within = np.array(
        [weighted(run, np.abs(np.abs(run.positions[:, 0]) - 1.5 * 10 / 11) < 3 / np.sqrt(11)) for run in runs]
    )
    assert np.all(within > 0.98)
    ratios = np.exp([float(run.log_evidence) - evidence for run in runs])
    assert abs(ratios.mean() - 1) < 3 * ratios.std(ddof=1) / 4


def defensive(key, mean, scale: float, count: int):
    """Half from the prior, half from a proposal that is off by 0.5 everywhere and too narrow in some directions."""
    a, b = jax.random.split(key)
    shape = (CONFIG.populations, count, DIM)
    centre = jnp.asarray(mean, jnp.float32) + 0.5
    x = jax.random.normal(a, shape)
    proposed = jax.random.uniform(b, (*shape[:2], 1)) < 0.5
    q = jnp.where(proposed, centre + scale * x, x)
    log_q = log_prior((q - centre) / scale) - DIM * np.log(scale)
    return q, jnp.logaddexp(log_prior(q), log_q) + np.log(0.5)


def test_proposals_in_a_defensive_mixture_leave_the_answer_unbiased():
    args, mean, covariance, evidence = gaussian(DIM, [100.0, 9.0, 1.0])
    inverse = np.linalg.cholesky(np.linalg.inv(covariance))
    ratios, means = [], []
    for seed in range(16):
        stages: list[StageInfo] = []
        posterior = tempered_smc(
            jax.random.key(seed), mixture, args, DIM, CONFIG,
            initial=defensive(jax.random.key(100 + seed), mean, 0.7, 128), on_stage=stages.append,
        )  # fmt: skip
        ratios.append(np.exp(float(posterior.log_evidence) - evidence))
        means.append(weighted(posterior, (np.asarray(posterior.positions) - mean) @ inverse))
    assert abs(np.mean(ratios) - 1) < 3 * np.std(ratios, ddof=1) / 4
    assert np.std(ratios) < 0.3
    assert np.all(np.abs(np.mean(means, axis=0)) < 4 * np.std(means, axis=0, ddof=1) / 4)
    assert min(stages[0].beta) > 0.01  # the proposals took the first steps (the prior alone gets to 0.004)


def test_a_likelihood_that_is_nan_on_half_the_prior():
    flat = arguments(np.zeros((2, 1, DIM)), np.zeros((2, 1)), np.log([0.5, 0.5]), wall=0.0)
    posterior = tempered_smc(jax.random.key(2), mixture, flat, DIM, CONFIG)
    assert posterior.result == "converged"
    assert np.all(np.isfinite(posterior.positions)) and np.all(np.isfinite(posterior.log_likelihoods))
    assert float(posterior.positions[:, 0].max()) <= 0.0
    # 4 x 128 prior draws decide the evidence: relative error 1 / sqrt(512).
    assert float(posterior.log_evidence) == pytest.approx(np.log(0.5), abs=3 / np.sqrt(512))
    assert weighted(posterior, posterior.positions[:, 0]) == pytest.approx(-np.sqrt(2 / np.pi), abs=0.12)


def test_no_likelihood_anywhere_still_ends_with_an_answer():
    args, *_ = gaussian(DIM, [4.0])
    posterior = tempered_smc(jax.random.key(3), mixture, (*args[:4], jnp.float32(-jnp.inf)), DIM, CONFIG)
    assert posterior.result == "converged"
    assert np.isneginf(posterior.log_evidence)
    assert np.all(np.isfinite(posterior.positions))
    assert float(jax.scipy.special.logsumexp(posterior.log_weights)) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("shift", [-10000.0, 10000.0])
def test_large_log_likelihoods_only_shift_the_evidence(shift):
    args, mean, covariance, evidence = gaussian(DIM, [2000.0, 100.0, 9.0, 1.0], shift=shift)
    posterior = tempered_smc(jax.random.key(4), mixture, args, DIM, CONFIG)
    assert float(posterior.log_evidence) == pytest.approx(evidence, abs=0.5)
    z = (np.asarray(posterior.positions) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert np.abs(weighted(posterior, z)).max() < 0.25


def test_whatever_stops_it_there_is_an_answer():
    args, mean, *_ = gaussian(DIM, [2000.0, 100.0, 9.0, 1.0])

    def interrupt(info: StageInfo) -> None:
        if info.stage == 3:
            raise KeyboardInterrupt

    answers = {
        "budget": tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, deadline=time.monotonic()),
        "stages": tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, stages=3),
        "interrupted": tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, on_stage=interrupt),
    }
    for result, posterior in answers.items():
        assert posterior.result == result
        assert posterior.positions.shape == (128, DIM)
        assert np.all(np.isfinite(posterior.positions))
        assert float(jax.scipy.special.logsumexp(posterior.log_weights)) == pytest.approx(0.0, abs=1e-4)
        assert np.isnan(posterior.log_evidence)  # beta = 1 was not reached
    np.testing.assert_array_equal(answers["stages"].positions, answers["interrupted"].positions)
    error = {name: np.linalg.norm(weighted(answers[name], answers[name].positions) - mean) for name in answers}
    assert error["stages"] < error["budget"] < np.linalg.norm(mean)  # every stage improves on the last


def test_repeats_exactly_and_compiles_once():
    traces = []

    def counted(args, q):
        traces.append(1)
        return mixture(args, q)

    args, *_ = gaussian(DIM, [100.0, 9.0, 1.0])
    other, *_ = gaussian(DIM, [100.0, 9.0, 1.0], seed=1)
    tempered_smc(jax.random.key(0), counted, args, DIM, CONFIG, stages=1)
    compiled = len(traces)  # the likelihood is called by tracing alone
    first = tempered_smc(jax.random.key(0), counted, args, DIM, CONFIG)
    again = tempered_smc(jax.random.key(0), counted, args, DIM, CONFIG)
    elsewhere = tempered_smc(jax.random.key(0), counted, other, DIM, CONFIG)
    fresh = tempered_smc(jax.random.key(1), counted, args, DIM, CONFIG, stages=4)
    assert len(traces) == compiled
    np.testing.assert_array_equal(first.positions, again.positions)
    assert np.abs(np.asarray(first.positions) - np.asarray(elsewhere.positions)).max() > 0.1
    assert not np.array_equal(first.positions[:128], fresh.positions[:128])


def recorded(args, config: TemperedSMCConfig, **how) -> tuple[Posterior, list[StageInfo]]:
    told: list[StageInfo] = []
    return tempered_smc(jax.random.key(0), mixture, args, DIM, config, on_stage=told.append, **how), told


def test_beta_waits_until_a_population_has_moved():
    args, *_ = gaussian(DIM, [3e5, 1e5, 1e5])
    config = replace(CONFIG, moves=1, least_moved=1.0)
    posterior, told = recorded(args, config)
    assert posterior.result == "converged"
    moved, raised = np.zeros(4), 0
    for before, after in pairwise(told):
        moved += after.acceptance
        grew = np.array(after.beta) > np.array(before.beta)
        np.testing.assert_array_equal(grew, (moved >= 1.0 - 1e-6) & (np.array(before.beta) < 1.0))
        raised += grew.sum()
        moved[grew] = 0.0
    assert raised >= 4 * 3
    hasty = recorded(args, replace(config, least_moved=0.0))[1]
    assert len(hasty) < len(told)


def test_a_population_in_a_narrow_mode_moves_beside_one_in_a_wide_mode():
    A = np.sqrt([[[1e5] * 2], [[4.0] * 2]]).swapaxes(1, 2) * np.eye(DIM)[None, :2]
    args = arguments(A, [A[0][:, 0] * 1.5, A[1][:, 0] * -1.5], [np.log(1e8), 0.0])  # the narrow mode has the mass
    start = jax.random.normal(jax.random.key(1), (2, 256, DIM))
    start = start.at[0, :, :2].multiply(0.05).at[0, :, 0].add(1.5)  # one population in each
    start = start.at[1, :, 0].set(-jnp.abs(start[1, :, 0]))
    _, told = recorded(args, replace(CONFIG, populations=2), initial=(start, log_prior(start)))
    assert min(told[-1].acceptance) > 0.4
    narrow, wide = told[-1].step_size
    assert narrow < 0.2 * wide


def test_evidence_power_flattens_the_populations_shares():
    args, *_ = gaussian(DIM, [100.0, 9.0, 1.0])
    runs = [
        tempered_smc(jax.random.key(0), mixture, args, DIM, replace(CONFIG, evidence_power=power))
        for power in (1.0, 0.5, 0.0)
    ]
    shares = np.array(
        [np.exp(run.log_weights).reshape(-1)[run.population == p].sum() for run in runs for p in range(4)]
    )
    whole, root, even = shares.reshape(3, 4)
    np.testing.assert_allclose(root, np.sqrt(whole) / np.sqrt(whole).sum(), rtol=1e-4)
    np.testing.assert_allclose(even, 0.25, rtol=1e-4)
    assert np.ptp(whole) > 1e-3
    assert float(runs[0].log_evidence) == float(runs[2].log_evidence)


def test_the_step_of_beta():
    value = jnp.asarray(np.random.default_rng(1).normal(size=256) * 100, jnp.float32)
    flat = jnp.zeros(256)
    beta, log_w, ess = next_beta(jnp.float32(0.2), flat, value, 128.0)
    assert 128 <= float(ess) < 140
    np.testing.assert_allclose(log_w, (beta - 0.2) * value, rtol=1e-3)
    assert float(next_beta(jnp.float32(0.2), flat, value / 1e4, 128.0)[0]) == 1.0
    # Most particles dead: the live ones are kept, and beta moves as little as it can.
    dead = jnp.where(jnp.arange(256) < 200, -jnp.inf, value)
    beta, log_w, ess = next_beta(jnp.float32(0.0), flat, dead, 128.0)
    assert 0 < float(beta) < 1e-6
    assert float(ess) == pytest.approx(56.0)
    assert np.all(np.isneginf(log_w[:200]))


def test_no_effective_sample_size_is_above_the_number_of_particles() -> None:
    nearly = 1e-7 * jax.random.normal(jax.random.key(0), (500, 384))  # rounding took most of these over it
    assert float(jnp.max(jax.vmap(effective_size)(nearly))) <= 384
    assert float(jnp.min(jax.vmap(effective_size)(nearly))) > 383.9


def test_wrong_input_is_named():
    args, *_ = gaussian(DIM, [4.0])
    q = jnp.zeros((4, 0, DIM))
    with pytest.raises(ValueError, match="at least 1 particle"):
        tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, initial=(q, q[..., 0]))
    with pytest.raises(ValueError, match="log-densities"):
        q = jnp.zeros((4, 64, DIM))
        tempered_smc(jax.random.key(0), mixture, args, DIM, CONFIG, initial=(q, q[:, :3, 0]))
    for wrong in (dict(particles=1), dict(start_particles=8), dict(ess_target=1.0), dict(keep=0), dict(keep=3)):
        with pytest.raises(ValueError, match="TemperedSMCConfig"):
            TemperedSMCConfig(**wrong)


def curved(args, q):
    """Three residuals of a small network of q, standard deviation 0.1."""
    y, B, C = args
    return -50.0 * jnp.sum((jnp.tanh(q @ B) @ C - y) ** 2, axis=1)


@pytest.mark.slow
def test_simulation_based_calibration_and_unbiased_evidence_on_a_curved_target():
    """Ranks of the truth among the posterior's draws are uniform (Talts et al. 2018), and 1 / L averages as it must."""
    config = TemperedSMCConfig(particles=32, start_particles=128)
    rng = np.random.default_rng(0)
    B, C = rng.normal(size=(4, 6)).astype(np.float32), rng.normal(size=(6, 3)).astype(np.float32) / 2
    ranks = []
    for seed in range(300):
        truth = rng.normal(size=4).astype(np.float32)
        y = np.tanh(truth @ B) @ C + 0.1 * rng.normal(size=3).astype(np.float32)
        args = (jnp.asarray(y, jnp.float32), jnp.asarray(B), jnp.asarray(C))
        posterior = tempered_smc(jax.random.key(seed), curved, args, 4, config)
        assert posterior.result == "converged"
        below = [posterior.positions[:, i] < truth[i] for i in range(4)]
        below.append(posterior.log_likelihoods < curved(args, jnp.asarray(truth)[None])[0])
        ranks.append([weighted(posterior, b) for b in below])
    for column in np.array(ranks).T:
        counts = np.histogram(column, bins=10, range=(0, 1))[0]
        assert np.sum((counts - 30.0) ** 2 / 30.0) < 27.9  # 0.1% point of chi-squared with 9 degrees of freedom
