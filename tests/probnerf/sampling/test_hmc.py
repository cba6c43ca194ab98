"""Laws of the Hamiltonian sampler. Monte Carlo bounds are multiples of the standard error over chains, seeds fixed."""

import time
from functools import partial

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.sampling.annealed_hmc import annealed_hmc
from probnerf.sampling.hmc import (
    HMCState,
    Metric,
    StageInfo,
    Target,
    energy_error,
    gradient_metric,
    hmc_step,
    leapfrog,
    split_r_hat,
)
from probnerf.settings import AnnealedHMCConfig


def silent(args, q):
    return jnp.zeros(q.shape[0])


def linear(args, q):
    """y ~ N(A q, I)."""
    A, y = args
    return -0.5 * jnp.sum((q @ A.T - y) ** 2, axis=1)


def banana(args, q):
    """y ~ N(q_0^2 + q_1, 0.25): curved, not log-concave."""
    return -2.0 * (q[:, 0] ** 2 + q[:, 1] - args) ** 2


def walled(args, q):
    """No finite likelihood beyond q_0 = args."""
    return jnp.where(q[:, 0] > args, jnp.nan, 0.0)


def observed(dim: int, precisions: list[float], seed: int = 0):
    """A linear-Gaussian problem with these likelihood precisions along random directions: (A, y), mean, covariance."""
    rng = np.random.default_rng(seed)
    A = np.sqrt(precisions)[:, None] * np.linalg.qr(rng.normal(size=(dim, dim)))[0][: len(precisions)]
    y = A @ rng.normal(size=dim) + rng.normal(size=len(precisions))
    covariance = np.linalg.inv(np.eye(dim) + A.T @ A)
    return (jnp.asarray(A, jnp.float32), jnp.asarray(y, jnp.float32)), covariance @ A.T @ y, covariance


def a_metric(dim: int, rank: int, seed: int = 0) -> Metric:
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(dim, dim)))[0][:rank]
    return Metric(jnp.asarray(basis, jnp.float32), jnp.asarray(rng.uniform(0.1, 0.9, rank), jnp.float32))


def normal(seed: int, *shape: int):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@partial(jax.jit, static_argnames=("log_likelihood", "steps"))
def flow(q, v, args, metric, step_size, beta=1.0, *, log_likelihood, steps: int):
    """(end position, end momentum, energy error) of one trajectory from each row of q."""
    target = Target(log_likelihood, args, jnp.asarray(beta), metric)
    start = target.evaluate(q)
    end, end_v = leapfrog(start, v, target, step_size, steps)
    return end.position, end_v, energy_error(start, v, end, end_v, target.beta)


@partial(jax.jit, static_argnames=("log_likelihood", "steps", "iterations"))
def run(key, q, args, metric, step_size, *, log_likelihood, steps: int, iterations: int):
    """States [iterations, chains, d] and infos of plain HMC at beta = 1."""
    target = Target(log_likelihood, args, jnp.ones(()), metric)

    def body(state, key):
        state, info = hmc_step(key, state, target, step_size, steps)
        return state, (state.position, info)

    return jax.lax.scan(body, target.evaluate(q), jax.random.split(key, iterations))[1]


def assert_mean(draws, expected, sigmas: float = 4.5):
    """Means over [iterations, chains, ...] agree within `sigmas` standard errors over independent chains."""
    chains = np.asarray(draws, np.float64).mean(axis=0)
    error = chains.std(axis=0, ddof=1) / np.sqrt(len(chains))
    assert np.all(np.abs(chains.mean(axis=0) - expected) <= sigmas * error + 1e-6)


@partial(jax.jit, static_argnames=("log_likelihood", "steps"))
def plain_flow(q, v, args, step_size, beta, *, log_likelihood, steps: int):
    """The same by velocity Verlet on the whole target, which is what the split integrator is measured against."""
    target = Target(log_likelihood, args, jnp.asarray(beta))
    start = end = target.evaluate(q)
    end_v = v
    for _ in range(steps):
        end_v = end_v + 0.5 * step_size * (beta * end.gradient - end.position)
        end = target.evaluate(end.position + step_size * end_v)
        end_v = end_v + 0.5 * step_size * (beta * end.gradient - end.position)
    return end.position, end_v, energy_error(start, v, end, end_v, target.beta)


@pytest.mark.parametrize("metric", [None, a_metric(6, 4)])
def test_a_trajectory_run_backwards_returns(metric):
    q0, v0 = normal(1, 32, 6), normal(2, 32, 6)
    q1, v1, _ = flow(q0, v0, 1.0, metric, 0.1, log_likelihood=banana, steps=20)
    q2, v2, _ = flow(q1, -v1, 1.0, metric, 0.1, log_likelihood=banana, steps=20)
    assert np.abs(q1 - q0).max() > 0.5
    np.testing.assert_allclose(q2, q0, atol=1e-4)
    np.testing.assert_allclose(-v2, v0, atol=1e-4)


def test_the_map_preserves_volume():
    metric = a_metric(3, 2)

    def phase(x):
        q, v, _ = flow(x[None, :3], x[None, 3:], 1.0, metric, 0.2, 0.2, log_likelihood=banana, steps=5)
        return jnp.concatenate([q[0], v[0]])

    jacobians = np.asarray(jax.jit(jax.vmap(jax.jacfwd(phase)))(normal(3, 16, 6)), np.float64)
    assert np.abs(jacobians).max() > 1.5
    np.testing.assert_allclose(np.linalg.det(jacobians), 1.0, rtol=1e-3)


@pytest.mark.parametrize("metric", [None, a_metric(6, 4)])
def test_energy_error_falls_as_the_square_of_the_step(metric):
    q0, v0 = 0.7 * normal(4, 256, 6), normal(5, 256, 6)
    steps = np.array([0.1, 0.025])
    errors = []
    for step in steps:
        error = flow(q0, v0, 1.0, metric, step, log_likelihood=banana, steps=round(1.0 / step))[2]
        errors.append(np.median(np.abs(error)))
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("step", [0.1, 1.0, 3.7, 50.0])
@pytest.mark.parametrize("metric", [None, a_metric(300, 40)])
def test_the_prior_alone_is_turned_exactly_at_any_step(step, metric):
    q0, v0 = normal(6, 8, 300), normal(7, 8, 300)
    q1, _, error = flow(q0, v0, None, metric, step, log_likelihood=silent, steps=10)
    assert np.abs(q1 - q0).max() > 0.5
    assert np.abs(error).max() < 5e-3  # of 300 nats, in float32


def test_silent_directions_cost_no_accuracy():
    """Energy error of a likelihood on two coordinates: split, as in two dimensions; plain, growing with the others."""
    q, v = normal(8, 64, 2000), normal(9, 64, 2000)
    arguments = dict(log_likelihood=banana, steps=7)
    few = np.asarray(flow(q[:, :2], v[:, :2], 1.0, None, 0.2, 0.05, **arguments)[2])
    many = np.asarray(flow(q, v, 1.0, None, 0.2, 0.05, **arguments)[2])
    plain = np.asarray(plain_flow(q, v, 1.0, 0.2, 0.05, **arguments)[2])
    np.testing.assert_allclose(many, few, atol=0.02)
    assert np.median(np.abs(plain)) > 10 * np.median(np.abs(many))


def test_a_metric_is_the_function_of_a_matrix():
    metric = a_metric(5, 3)
    V, omega = np.asarray(metric.basis, np.float64), np.asarray(metric.frequency, np.float64)
    Omega = np.eye(5) + V.T @ np.diag(omega - 1) @ V
    x = normal(12, 4, 5)
    values, vectors = np.linalg.eigh(Omega)
    cosine = vectors @ np.diag(np.cos(0.7 * values)) @ vectors.T
    got = metric.apply(jnp.cos(0.7 * metric.frequency)[None], jnp.full((1, 1), np.cos(0.7), jnp.float32), x)
    np.testing.assert_allclose(got, np.asarray(x) @ cosine, atol=1e-5)


def test_gradients_of_draws_tell_the_stiff_directions_and_no_others():
    precisions = [10000.0, 400.0, 25.0]
    (A, y), mean, covariance = observed(200, precisions)
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, size=64)  # fewer draws than dimensions
    state = Target(linear, (A, y), jnp.ones(())).evaluate(jnp.asarray(draws, jnp.float32))
    metric = gradient_metric(state.gradient, jnp.zeros(64), 64)
    # Relative standard error of a variance from 64 draws: sqrt(2 / 64) = 0.18; 4 of them, and half on a square root.
    expected = 1 / np.sqrt(1 + np.array([k**2 / (1 + k) for k in precisions]))
    np.testing.assert_allclose(metric.frequency[:3], expected, rtol=0.36)
    np.testing.assert_allclose(metric.frequency[3:], 1.0, atol=1e-3)
    np.testing.assert_allclose(metric.basis @ metric.basis.T, np.eye(64), atol=1e-5)


@pytest.mark.parametrize(("dim", "precisions"), [(8, [100.0, 9.0, 1.0]), (64, [2500.0, 400.0, 60.0, 10.0, 2.0])])
def test_moments_of_a_gaussian_of_unequal_scales(dim, precisions):
    args, mean, covariance = observed(dim, precisions)
    draws = np.random.default_rng(1).multivariate_normal(mean, covariance, size=64)
    metric = gradient_metric(
        Target(linear, args, jnp.ones(())).evaluate(jnp.asarray(draws, jnp.float32)).gradient,
        jnp.zeros(64), min(dim, 64),
    )  # fmt: skip
    q, info = run(
        jax.random.key(0), normal(13, 32, dim), args, metric, 0.35, log_likelihood=linear, steps=4, iterations=500
    )
    whitened = (np.asarray(q[100:], np.float64) - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert float(info.acceptance.mean()) > 0.9
    assert int(info.divergent[100:].sum()) == 0
    assert_mean(whitened, 0.0)
    assert_mean(whitened**2, 1.0)
    assert_mean(whitened[..., :-1] * whitened[..., 1:], 0.0)


def test_a_wall_of_nan_is_never_crossed_and_truncates_exactly():
    wall = 1.0
    start = -jnp.abs(normal(14, 64, 2))
    q, info = run(jax.random.key(1), start, wall, None, 0.7, log_likelihood=walled, steps=2, iterations=400)
    assert float(q[..., 0].max()) <= wall
    assert 0.0 < float(info.divergent.mean()) < 0.5
    density, mass = np.exp(-0.5) / np.sqrt(2 * np.pi), 0.8413447
    assert_mean(q[20:, :, 0], -density / mass)
    assert_mean(q[20:, :, 0] ** 2, 1 - density / mass)


def test_a_dead_chain_does_not_poison_the_others():
    start = -jnp.abs(normal(15, 4, 2))
    arguments = dict(log_likelihood=walled, steps=2, iterations=20)
    healthy, _ = run(jax.random.key(2), start, 1.0, None, 0.3, **arguments)
    q, _ = run(jax.random.key(2), start.at[0, 0].set(5.0), 1.0, None, 0.3, **arguments)
    np.testing.assert_array_equal(q[:, 1:], healthy[:, 1:])
    assert np.all(np.isfinite(q))


def test_at_beta_zero_the_likelihood_is_not_heard():
    state = HMCState(jnp.zeros((1, 2)), jnp.array([-jnp.inf]), jnp.zeros((1, 2)), jnp.zeros(1), jnp.zeros((1, 2)))
    v = jnp.ones((1, 2))
    assert float(energy_error(state, v, state, v, jnp.zeros(()))[0]) == 0.0


def test_agrees_with_blackjax_on_a_curved_target():
    y, chains, iterations = jnp.float32(2.0), 32, 600
    q, info = run(
        jax.random.key(3), normal(16, chains, 3), y, None, 0.25, log_likelihood=banana, steps=6, iterations=iterations
    )
    kernel = blackjax.hmc(lambda q: banana(y, q[None])[0] - 0.5 * q @ q, 0.2, jnp.ones(3), 8)

    @jax.jit
    def reference(key, start):
        def one(key, start):
            def body(state, key):
                state, _ = kernel.step(key, state)
                return state, state.position

            return jax.lax.scan(body, kernel.init(start), jax.random.split(key, iterations))[1]

        return jax.vmap(one, out_axes=1)(jax.random.split(key, chains), start)

    theirs = np.asarray(reference(jax.random.key(4), normal(17, chains, 3)))[100:]
    ours = np.asarray(q)[100:]
    assert float(info.acceptance.mean()) > 0.7
    for moment in (lambda x: x[..., 1:], lambda x: x**2, lambda x: x[..., 0] ** 2 * x[..., 1], lambda x: x**4):
        a, b = moment(ours).mean(axis=0), moment(theirs).mean(axis=0)  # per chain
        error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / chains)
        assert np.all(np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4 * error)


def test_split_r_hat():
    draws = np.random.default_rng(0).normal(size=(4, 1000))
    assert split_r_hat(draws) == pytest.approx(1.0, abs=0.01)
    assert split_r_hat(draws + np.arange(4)[:, None]) > 1.3
    assert split_r_hat(draws + np.linspace(0, 3, 1000)) > 1.2  # a drift common to all chains
    assert np.isnan(split_r_hat(np.zeros((4, 100))))
    assert np.isnan(split_r_hat(draws[:, :3]))


ANNEALED = AnnealedHMCConfig(chains=16, iterations=40, leapfrog_steps=20, keep=16, tune_iterations=10)


def test_annealed_hmc_hands_back_the_tempered_draws_it_says():
    """Kept means and variances are those of the tempered targets at s_t, which are known for a linear likelihood."""
    args, _, _ = observed(4, [400.0, 16.0])
    A, y = (np.asarray(a, np.float64) for a in args)
    stages: list[StageInfo] = []
    posterior = annealed_hmc(jax.random.key(0), linear, args, 4, ANNEALED, on_stage=stages.append)
    assert posterior.result == "stages"
    betas = [stage.beta[0] for stage in stages]
    np.testing.assert_allclose(betas, [(0.1 / (5 * 0.02 ** (t / 40))) ** 2 for t in range(1, 41)], rtol=1e-5)
    assert betas[-1] == pytest.approx(1.0)
    steps = np.array([stage.step_size[0] for stage in stages]) * np.sqrt(betas)
    np.testing.assert_allclose(steps[10:], steps[10], rtol=1e-5)  # proportional to s_t once tuned

    covariances = [np.linalg.inv(np.eye(4) + beta * A.T @ A) for beta in betas[-16:]]
    means = [beta * covariance @ A.T @ y for beta, covariance in zip(betas[-16:], covariances, strict=True)]
    q = np.asarray(posterior.positions).reshape(16, 16, 4)
    assert_mean(q - np.stack(means)[:, None], 0.0)
    whitened = np.stack([
        (q[t] - means[t]) @ np.linalg.cholesky(np.linalg.inv(covariances[t])) for t in range(16)
    ])  # fmt: skip
    assert_mean(whitened**2, 1.0)
    np.testing.assert_allclose(posterior.log_likelihoods, linear(args, posterior.positions), atol=1e-3)
    np.testing.assert_array_equal(posterior.population[:16], np.arange(16))
    assert float(jax.scipy.special.logsumexp(posterior.log_weights)) == pytest.approx(0.0, abs=1e-5)
    assert np.isnan(posterior.log_evidence)
    assert float(posterior.diagnostics.acceptance) > 0.5
    assert float(posterior.diagnostics.point_gradients) == 16 * (1 + 40 * 20)


def test_annealed_hmc_repeats_compiles_once_and_keeps_to_its_budget():
    traces = []

    def counted(args, q):
        traces.append(1)
        return linear(args, q)

    args, _, _ = observed(4, [400.0, 16.0])
    other, _, _ = observed(4, [400.0, 16.0], seed=1)
    first = annealed_hmc(jax.random.key(0), counted, args, 4, ANNEALED)
    compiled = len(traces)
    again = annealed_hmc(jax.random.key(0), counted, args, 4, ANNEALED)
    elsewhere = annealed_hmc(jax.random.key(0), counted, other, 4, ANNEALED)
    stopped = annealed_hmc(jax.random.key(0), counted, args, 4, ANNEALED, deadline=time.monotonic())
    assert len(traces) == compiled
    np.testing.assert_array_equal(first.positions, again.positions)
    assert np.abs(np.asarray(first.positions) - np.asarray(elsewhere.positions)).max() > 0.1
    assert stopped.result == "budget"
    assert stopped.positions.shape == (16, 4)

    def interrupt(info: StageInfo) -> None:
        if info.stage == 5:
            raise KeyboardInterrupt

    interrupted = annealed_hmc(jax.random.key(0), counted, args, 4, ANNEALED, on_stage=interrupt)
    assert interrupted.result == "interrupted"
    assert int(interrupted.diagnostics.stages) == 5


@pytest.mark.parametrize("wrong", [dict(keep=0), dict(keep=101), dict(s_end=6.0), dict(chains=0)])
def test_wrong_settings_of_annealed_hmc(wrong):
    with pytest.raises(ValueError, match="AnnealedHMCConfig"):
        AnnealedHMCConfig(**wrong)
