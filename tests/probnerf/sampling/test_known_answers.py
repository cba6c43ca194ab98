"""Samplers against answers found another way: a grid in two dimensions, algebra in 256, another library's sampler."""

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blackjax.smc import extend_params, resampling
from jaxtyping import Array, Float

from probnerf.sampling.annealed_hmc import annealed_hmc
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import AnnealedHMCConfig, TemperedSMCConfig

SIGMAS = 4.0
Y = jnp.float32(2.0)


def banana(y: Array, q: Float[Array, "p 2"]) -> Float[Array, "p"]:
    """y = q0^2 + q1 / 2, and q1 near 1 - q0: a ridge of two arms, one longer than the other."""
    return -4.0 * (q[:, 0] ** 2 + 0.5 * q[:, 1] - y) ** 2 - 0.5 * (q[:, 1] - 1.0 + q[:, 0]) ** 2


MOMENTS = {
    "q0": lambda q: q[..., 0],
    "q1": lambda q: q[..., 1],
    "q0^2": lambda q: q[..., 0] ** 2,
    "q1^2": lambda q: q[..., 1] ** 2,
    "arm": lambda q: 1.0 * (q[..., 0] > 0),
    "q0 q1": lambda q: q[..., 0] * q[..., 1],
}


def on_a_grid(beta: float = 1.0) -> tuple[float, dict[str, float]]:
    """Log-evidence and moments of the tempered banana by the trapezoid rule on [-6, 6]^2 (exact to 1e-9)."""
    axis = np.linspace(-6.0, 6.0, 1201)
    q = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    log_likelihood = -4.0 * (q[:, 0] ** 2 + 0.5 * q[:, 1] - float(Y)) ** 2 - 0.5 * (q[:, 1] - 1.0 + q[:, 0]) ** 2
    mass = np.exp(beta * log_likelihood - 0.5 * np.sum(q**2, axis=1)) / (2 * np.pi) * (axis[1] - axis[0]) ** 2
    return float(np.log(mass.sum())), {name: float(mass @ f(q) / mass.sum()) for name, f in MOMENTS.items()}


def assert_agrees(found: list[float] | np.ndarray, expected: float) -> None:
    """The mean of independent values is the expected one, within their own error."""
    values = np.asarray(found, np.float64)
    error = values.std(ddof=1) / np.sqrt(len(values))
    assert abs(values.mean() - expected) < SIGMAS * error, (values.mean(), error, expected)


def test_tempered_smc_agrees_with_a_grid():
    """Evidence, moments and the arms' weights; self-normalised averages are off by 1 / particles, so there are many."""
    evidence, moments = on_a_grid()
    config = TemperedSMCConfig(populations=32, particles=256, start_particles=1024, evidence_power=0.0)
    posterior = tempered_smc(jax.random.key(0), banana, Y, 2, config)
    assert_agrees(np.exp(np.asarray(posterior.diagnostics.log_evidences, np.float64) - evidence), 1.0)
    groups = [np.asarray(posterior.positions)[np.asarray(posterior.population) == p] for p in range(32)]
    for name, moment in MOMENTS.items():
        assert_agrees([moment(g).mean() for g in groups], moments[name])


def test_annealed_hmc_agrees_with_a_grid():
    """The paper's sampler ends at its last temperature: slowly cooled, its chains are draws of that target."""
    config = AnnealedHMCConfig(
        chains=2048, iterations=200, leapfrog_steps=5, s_start=1.0, s_end=0.5, keep=1, tune_iterations=0,
        step_per_scale=0.2,
    )  # fmt: skip
    posterior = annealed_hmc(jax.random.key(0), banana, Y, 2, config)
    _, moments = on_a_grid()
    q = np.asarray(posterior.positions)
    for name in ("q0^2", "q1", "q1^2"):  # cooled chains keep to the arm they are on: the arms' weights are not exact
        values = MOMENTS[name](q)
        assert values.mean() == pytest.approx(moments[name], abs=SIGMAS * values.std() / np.sqrt(len(q)) + 0.03)


def test_tempered_smc_agrees_with_blackjax():
    """The same density through blackjax's adaptive tempered SMC: the same evidence and moments."""
    kernel = blackjax.hmc.build_kernel()
    parameters = {"step_size": 0.15, "inverse_mass_matrix": jnp.ones(2), "num_integration_steps": 8}
    smc = blackjax.adaptive_tempered_smc(
        lambda q: -0.5 * jnp.sum(q * q + jnp.log(2 * jnp.pi)),
        lambda q: banana(Y, q[None])[0],
        kernel,
        blackjax.hmc.init,
        extend_params(parameters),
        resampling.systematic,
        0.5,
        num_mcmc_steps=8,
    )
    step = jax.jit(smc.step)
    theirs: dict[str, list[float]] = {name: [] for name in ("evidence", *MOMENTS)}
    for seed in range(12):
        start, key = jax.random.split(jax.random.key(100 + seed))
        state, log_evidence = smc.init(jax.random.normal(start, (512, 2))), 0.0
        while float(state.tempering_param) < 1.0:
            key, at = jax.random.split(key)
            state, info = step(at, state)
            log_evidence += float(info.log_likelihood_increment)
        theirs["evidence"].append(np.exp(log_evidence))
        weights = np.asarray(state.weights, np.float64)
        for name, moment in MOMENTS.items():
            theirs[name].append(float(weights @ moment(np.asarray(state.particles, np.float64))))

    config = TemperedSMCConfig(populations=12, particles=128, start_particles=512, evidence_power=0.0)
    posterior = tempered_smc(jax.random.key(1), banana, Y, 2, config)
    positions, population = np.asarray(posterior.positions), np.asarray(posterior.population)
    ours = {name: [moment(positions[population == p]).mean() for p in range(12)] for name, moment in MOMENTS.items()}
    ours["evidence"] = list(np.exp(np.asarray(posterior.diagnostics.log_evidences, np.float64)))
    for name, values in theirs.items():
        a, b = np.array(ours[name]), np.array(values)
        error = np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 12)
        assert abs(a.mean() - b.mean()) < SIGMAS * error, (name, a.mean(), b.mean(), error)


@pytest.mark.slow
def test_a_gaussian_in_256_dimensions():
    """16 constrained directions of 256, condition number 2000: evidence, mean and variance by algebra."""
    dim, rng = 256, np.random.default_rng(0)
    precisions = np.geomspace(2000.0, 1.0, 16)
    A = np.sqrt(precisions)[:, None] * np.linalg.qr(rng.normal(size=(dim, dim)))[0][:16]
    y = A @ rng.normal(size=dim) + rng.normal(size=16)
    covariance = np.linalg.inv(np.eye(dim) + A.T @ A)
    marginal = np.eye(16) + A @ A.T
    evidence = -0.5 * y @ np.linalg.solve(marginal, y) - 0.5 * np.linalg.slogdet(marginal)[1]

    def linear(args, q):
        A, y = args
        return -0.5 * jnp.sum((q @ A.T - y) ** 2, axis=1)

    config = TemperedSMCConfig(populations=8, particles=128, start_particles=512)
    args = (jnp.asarray(A, jnp.float32), jnp.asarray(y, jnp.float32))
    posterior = tempered_smc(jax.random.key(0), linear, args, dim, config)
    assert abs(float(posterior.log_evidence) - evidence) < 3 * float(posterior.log_evidence_se)
    assert float(posterior.log_evidence_se) < 0.5
    w = np.exp(np.asarray(posterior.log_weights, np.float64))
    z = (np.asarray(posterior.positions, np.float64) - covariance @ A.T @ y) @ np.linalg.cholesky(
        np.linalg.inv(covariance)
    )
    assert np.sqrt(np.mean((w @ z) ** 2)) < 0.06
    assert np.mean(w @ z**2) == pytest.approx(1.0, abs=0.03)
