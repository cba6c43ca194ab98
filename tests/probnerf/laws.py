"""Laws of samplers, as functions of the sampler: tests call them with the real one, and with careless edits of it.

Each raises AssertionError where its law is broken. Bounds are multiples of the Monte Carlo error, seeds fixed.
"""

import importlib
import math
import sys
import types
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np

from probnerf.sampling import hmc, tempered_smc
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.settings import AnnealedHMCConfig, TemperedSMCConfig

DIM = 6
SIGMAS = 4.5


def mutant(name: str, *edits: tuple[str, str]) -> ModuleType:
    """Module `name` with pieces of its source replaced, each of which must be there exactly once."""
    path = Path(importlib.import_module(name).__file__ or "")
    source = path.read_text()
    for old, new in edits:
        assert source.count(old) == 1, f"{path.name} holds {old!r} {source.count(old)} times: the mutation is stale"
        source = source.replace(old, new)
    made = types.ModuleType(f"{name}_mutant")
    made.__file__ = str(path)
    sys.modules[made.__name__] = made  # dataclasses look their module up
    exec(compile(source, str(path), "exec"), made.__dict__)
    return made


def linear(args, q):
    """y ~ N(A q, I)."""
    A, y = args
    return -0.5 * jnp.sum((q @ A.T - y) ** 2, axis=1)


def problem(precisions: tuple[float, ...] = (60.0, 9.0, 1.0), beta: float = 1.0):
    """A linear-Gaussian problem: (A, y); mean and covariance at `beta`; log-evidence at beta = 1."""
    rng = np.random.default_rng(0)
    A = np.sqrt(precisions)[:, None] * np.linalg.qr(rng.normal(size=(DIM, DIM)))[0][: len(precisions)]
    y = A @ rng.normal(size=DIM) + rng.normal(size=len(precisions))
    covariance = np.linalg.inv(np.eye(DIM) + beta * A.T @ A)
    marginal = np.eye(len(y)) + A @ A.T
    evidence = -0.5 * y @ np.linalg.solve(marginal, y) - 0.5 * np.linalg.slogdet(marginal)[1]
    args = (jnp.asarray(A, jnp.float32), jnp.asarray(y, jnp.float32))
    return args, beta * covariance @ A.T @ y, covariance, evidence


def assert_zero(values) -> None:
    """The mean over the first axis, of independent values, is 0."""
    values = np.asarray(values, np.float64)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    assert np.all(np.abs(values.mean(axis=0)) <= SIGMAS * error + 1e-6)


def hmc_leaves_its_target_alone(hmc: ModuleType) -> None:
    """Exact draws of a tempered Gaussian are still its draws after twenty iterations of large steps."""
    args, mean, covariance, _ = problem(beta=0.3)
    start = np.random.default_rng(1).multivariate_normal(mean, covariance, size=8192)
    target = hmc.Target(linear, args, jnp.asarray(0.3))

    @jax.jit
    def moved(q):
        def body(state, key):
            state, info = hmc.hmc_step(key, state, target, 0.4, 3)
            return state, info.acceptance.mean()

        return jax.lax.scan(body, target.evaluate(q), jax.random.split(jax.random.key(0), 20))

    state, acceptance = moved(jnp.asarray(start, jnp.float32))
    if not 0.1 < float(acceptance.mean()) < 0.95:  # or the accept test is not needed
        raise RuntimeError(f"the law asks nothing of this sampler: acceptance {float(acceptance.mean()):.2f}")
    z = (np.asarray(state.position, np.float64) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert_zero(z)
    assert_zero(z**2 - 1.0)


def smc_finds_evidence_and_moments(smc: ModuleType) -> None:
    """Evidence ratios of independent runs average 1 (SMC is unbiased), and their means are the posterior's."""
    args, mean, covariance, evidence = problem()
    whiten = np.linalg.cholesky(np.linalg.inv(covariance))
    config = smc.TemperedSMCConfig(populations=16, particles=48, start_particles=96, evidence_power=0.0)
    posterior = smc.tempered_smc(jax.random.key(0), linear, args, DIM, config)
    assert_zero(np.exp(np.asarray(posterior.diagnostics.log_evidences, np.float64) - evidence) - 1.0)
    z = (np.asarray(posterior.positions, np.float64) - mean) @ whiten
    groups = np.stack([z[np.asarray(posterior.population) == p] for p in range(16)])
    assert_zero(groups.mean(axis=1))
    assert np.abs((groups**2).mean(axis=(0, 1)) - 1.0).max() < 0.2


def smc_takes_proposals_for_what_they_are(smc: ModuleType) -> None:
    """Starts from a density that is off leave the evidence unbiased."""
    args, mean, _, evidence = problem()
    config = smc.TemperedSMCConfig(populations=16, particles=48, start_particles=192, evidence_power=0.0)
    shape = (16, 192, DIM)
    a, b = jax.random.split(jax.random.key(3))
    x = jax.random.normal(a, shape)
    centre = jnp.asarray(mean, jnp.float32) + 0.4
    q = jnp.where(jax.random.uniform(b, (*shape[:2], 1)) < 0.5, centre + 0.8 * x, x)

    def log_normal(x):
        return -0.5 * jnp.sum(x**2 + jnp.log(2 * jnp.pi), axis=-1)

    log_q = jnp.logaddexp(log_normal(q), log_normal((q - centre) / 0.8) - DIM * np.log(0.8)) + np.log(0.5)
    posterior = smc.tempered_smc(jax.random.key(0), linear, args, DIM, config, initial=(q, log_q))
    assert_zero(np.exp(np.asarray(posterior.diagnostics.log_evidences, np.float64) - evidence) - 1.0)


def reference_for(mean: np.ndarray, covariance: np.ndarray) -> GaussianMixture:
    """Two Gaussians four deviations beside the posterior's, as wide, and the prior."""
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    shift = 4.0 * np.linalg.inv(root).T[:, 0]
    return GaussianMixture(
        jnp.log(jnp.array([0.3, 0.5, 0.2])),
        jnp.asarray(np.stack([mean + shift, mean - shift, 0 * mean]), jnp.float32),
        jnp.asarray(np.stack([root, root, np.eye(DIM)]), jnp.float32),
    )


def hmc_leaves_a_target_between_reference_and_posterior_alone(hmc: ModuleType) -> None:
    """Exact draws of r^(1 - beta) (prior x likelihood)^beta, Gaussian where r is, are still its draws."""
    args, *_ = problem()
    A, y = (np.asarray(a, np.float64) for a in args)
    beta, precision, centre = 0.4, np.diag([4.0, 2.0, 9.0, 1.0, 0.5, 3.0]), np.linspace(-1.0, 1.0, DIM)
    reference = GaussianMixture(
        jnp.zeros(1), jnp.asarray(centre, jnp.float32)[None], jnp.asarray(np.sqrt(precision), jnp.float32)[None]
    )
    between = (1 - beta) * precision + beta * (np.eye(DIM) + A.T @ A)
    middle = np.linalg.solve(between, (1 - beta) * precision @ centre + beta * A.T @ y)
    start = np.random.default_rng(1).multivariate_normal(middle, np.linalg.inv(between), size=8192)
    target = hmc.Target(linear, args, jnp.asarray(beta), None, reference)

    @jax.jit
    def moved(q):
        def body(state, key):
            state, info = hmc.hmc_step(key, state, target, 0.3, 3)
            return state, info.acceptance.mean()

        return jax.lax.scan(body, target.evaluate(q), jax.random.split(jax.random.key(0), 20))

    state, acceptance = moved(jnp.asarray(start, jnp.float32))
    if not 0.1 < float(acceptance.mean()) < 0.95:  # or the accept test is not needed
        raise RuntimeError(f"the law asks nothing of this sampler: acceptance {float(acceptance.mean()):.2f}")
    z = (np.asarray(state.position, np.float64) - middle) @ np.linalg.cholesky(between)
    assert_zero(z)
    assert_zero(z**2 - 1.0)


def smc_finds_the_same_from_any_reference(smc: ModuleType) -> None:
    """From a mixture that is off the evidence is unbiased, and the means are the posterior's."""
    args, mean, covariance, evidence = problem()
    config = smc.TemperedSMCConfig(populations=16, particles=48, start_particles=96, evidence_power=0.0)
    reference = reference_for(mean, covariance)
    posterior = smc.tempered_smc(jax.random.key(0), linear, args, DIM, config, reference=reference)
    if int(posterior.diagnostics.stages) < config.final_stages + 2:  # or no stage's weights are needed
        raise RuntimeError("the law asks nothing of this sampler: the first step reached the posterior")
    assert_zero(np.exp(np.asarray(posterior.diagnostics.log_evidences, np.float64) - evidence) - 1.0)
    z = (np.asarray(posterior.positions, np.float64) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    groups = np.stack([z[np.asarray(posterior.population) == p] for p in range(16)])
    assert_zero(groups.mean(axis=1))
    assert np.abs((groups**2).mean(axis=(0, 1)) - 1.0).max() < 0.2


def a_cut_run_goes_on_from_the_density_that_it_reached(populations: ModuleType) -> None:
    """Cut between its reference and the posterior, and gone on with from the prior's side, evidence stays unbiased."""
    args, mean, covariance, evidence = problem()
    config = TemperedSMCConfig(populations=16, particles=48, start_particles=96, evidence_power=0.0)
    reference = reference_for(mean, covariance)
    cut = tempered_smc.tempered_smc(jax.random.key(0), linear, args, DIM, config, reference=reference, stages=0)
    if not 0.0 < float(cut.diagnostics.beta.max()) < 1.0:
        raise RuntimeError("the law asks nothing: nothing was cut")
    beta = np.asarray(cut.diagnostics.beta, np.float64)[np.asarray(cut.population)]
    log_z = np.asarray(cut.diagnostics.log_evidences, np.float64)[np.asarray(cut.population)]
    remade = populations.gathered(
        [hmc.Target(linear, args, jnp.zeros(()), None, reference).evaluate(cut.positions.reshape(16, -1, DIM))],
        np.asarray(cut.diagnostics.beta, np.float64), np.asarray(cut.diagnostics.log_evidences, np.float64),
        np.zeros(16), 0.0, dict.fromkeys(("acceptance", "divergences", "ancestors", "stages", "point_gradients")), "",
    )  # fmt: skip
    prior = -0.5 * np.sum(np.asarray(cut.positions, np.float64) ** 2 + np.log(2 * np.pi), axis=1)
    between = (1 - beta) * np.asarray(reference.log_density(cut.positions), np.float64)
    between += beta * (prior + np.asarray(linear(args, cut.positions), np.float64))
    np.testing.assert_allclose(remade.log_density, between - log_z, atol=2e-3)
    start = populations.start_from(cut, 16)
    after = tempered_smc.tempered_smc(jax.random.key(1), linear, args, DIM, config, initial=start)
    assert_zero(np.exp(np.asarray(after.diagnostics.log_evidences, np.float64) - evidence) - 1.0)


def a_mixture_has_the_density_that_it_draws_from(mixture: ModuleType) -> None:
    """E_r[p / r] = 1 and E_r[q p / r] = 0 over the mixture's own draws, p the prior."""
    rng = np.random.default_rng(2)
    roots = np.stack([np.linalg.cholesky(a @ a.T + np.eye(3)) for a in 1.2 * rng.normal(size=(2, 3, 3))])
    made = mixture.GaussianMixture(
        jnp.log(jnp.array([0.2, 0.3, 0.5])),
        jnp.asarray(np.concatenate([0.7 * rng.normal(size=(2, 3)), np.zeros((1, 3))]), jnp.float32),
        jnp.asarray(np.concatenate([roots, 0.8 * np.eye(3)[None]]), jnp.float32),
    )
    q = made.draw(jax.random.key(0), 65536)
    ratio = np.exp(-np.asarray(made.over_prior(q), np.float64))
    assert_zero(ratio - 1.0)
    assert_zero(ratio[:, None] * np.asarray(q, np.float64))
    assert_zero(ratio[:, None] * (np.asarray(q, np.float64) ** 2 - 1.0))


def smc_moves_each_half_by_what_the_other_says(smc: ModuleType) -> None:
    """After two moves, the second by a tuned step size, exact draws of the posterior are still its draws.

    It has a narrow part and a wide one, where very different steps are accepted: by step sizes that followed their own
    particles the narrow part would gain. (Two moves: at the third a step size knows of its own half again, through what
    the other half's owed to it.)
    """
    root = jnp.array([5.0, 1.0])
    reference = GaussianMixture(jnp.log(jnp.full(2, 0.5)), jnp.zeros((2, 1)), root[:, None, None])
    config = smc.TemperedSMCConfig(
        populations=32768, particles=2, start_particles=2, moves=2, leapfrog_steps=1, final_stages=1, keep=1,
        evidence_power=0.0, metric=False,
    )  # fmt: skip
    posterior = smc.tempered_smc(jax.random.key(0), _as_the_mixture, reference, 1, config, reference=reference)
    q = np.asarray(posterior.positions, np.float64).reshape(config.populations, config.moves, config.particles)[:, -1]
    for width in (0.1, 0.3, 1.0):
        inside = 0.5 * math.erf(5.0 * width / math.sqrt(2.0)) + 0.5 * math.erf(width / math.sqrt(2.0))
        assert_zero((np.abs(q) < width).mean(axis=1) - inside)


def _as_the_mixture(mixture, q):
    """The likelihood that makes `mixture` the posterior."""
    return mixture.over_prior(q)


def resampling_gives_each_its_due(resampling: ModuleType) -> None:
    """Each particle is copied count x weight times, up to rounding, and a dead one never."""
    rng = np.random.default_rng(0)
    for seed in range(10):
        log_w = np.where(rng.random(100) < 0.3, -np.inf, 3 * rng.normal(size=100))
        w = np.exp(log_w) / np.exp(log_w).sum()
        index = resampling.resample(jax.random.key(seed), jnp.asarray(log_w, jnp.float32), 64)
        counts = np.bincount(index, minlength=100)
        assert counts.sum() == 64 and len(counts) == 100
        assert np.all(np.abs(counts - 64 * w) < 1 + 1e-4) and np.all(counts[w == 0] == 0)


def annealing_keeps_draws_of_its_last_temperatures(annealed: ModuleType) -> None:
    """The last state of many short chains of the paper's sampler is a draw of the target that it ended at."""
    args, mean, covariance, _ = problem((30.0, 4.0), beta=1.0)
    config = AnnealedHMCConfig(
        chains=4096, iterations=40, leapfrog_steps=4, s_start=1.0, s_end=0.5, keep=1, tune_iterations=0,
        step_per_scale=0.5,
    )  # fmt: skip
    posterior = annealed.annealed_hmc(jax.random.key(0), linear, args, DIM, config)
    z = (np.asarray(posterior.positions, np.float64) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert_zero(z)
    assert_zero(z**2 - 1.0)


def vi_s_bound_is_the_evidence_at_the_posterior(vi: ModuleType) -> None:
    """log p(z) + l(z) - log q(z) is the log-evidence of every draw where q is the posterior."""
    precision, peak = jnp.array([9.0, 4.0, 0.5]), jnp.array([1.0, -0.5, 2.0])

    def likelihood(_, q):
        return -0.5 * jnp.sum(precision * (q - peak) ** 2, axis=-1)

    best = vi.Gaussian(precision * peak / (1 + precision), -0.5 * jnp.log1p(precision))
    noise = jax.random.normal(jax.random.key(0), (64, 3))
    evidence = jnp.sum(-0.5 * jnp.log1p(precision) - 0.5 * precision / (1 + precision) * peak**2)
    np.testing.assert_allclose(vi.elbo_terms(best, likelihood, None, noise), evidence, atol=1e-4)
