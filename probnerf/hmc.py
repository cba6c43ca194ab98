"""Hamiltonian Monte Carlo for standard-normal latents, and the paper's annealed HMC.

Symbols: q position [..., D]; v whitened momentum [..., D] ~ N(0, I); l log-likelihood; beta inverse temperature.
Target: N(q; 0, I) exp(beta l(q)). With mass matrix M and Omega = M^(-1/2), v = Omega p, Hamilton's equations are

    dq/dt = Omega v,    dv/dt = -Omega q + beta Omega grad l(q),    H = (|q|^2 + |v|^2) / 2 - beta l(q).

Without the likelihood each eigenvector of Omega is a harmonic oscillator of frequency omega, solved exactly by a turn
of (q, v) by the angle omega t. The split integrator (half kick, turn, half kick; Shahbaba et al. 2014) makes an error
only where the likelihood speaks: its step size does not shrink with the directions that the likelihood leaves alone.

All chains run as one batch. Nothing here compiles per chain, and nothing logs inside jit.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from probnerf.types import Diagnostics, Posterior

# (args, q [p, d]) -> log-likelihood [p]; differentiable, rows independent. It is a static argument of the compiled
# functions: pass the same function object again (not a new lambda) and only `args` may change without compiling.
LogLikelihood = Callable[[Any, Float[Array, "p d"]], Float[Array, "p"]]

MAX_ENERGY_ERROR = 1000.0  # nats; beyond it a trajectory counts as divergent
JITTER = (0.8, 1.2)  # random factor of the step size, so that no trajectory length is a multiple of a period


class Metric(eqx.Module):
    """Omega = M^(-1/2) = I + V^T diag(frequency - 1) V: `frequency` along the orthonormal rows of V, 1 across them.

    A diagonal mass is `basis = eye(d)`. Leading axes are shared with the positions' (one metric per population).
    """

    basis: Float[Array, "... r d"]
    frequency: Float[Array, "... r"]  # square roots of the inverse mass's eigenvalues, in (0, 1]

    def apply(
        self, along: Float[Array, "... p r"], across: Float[Array, "... p 1"], x: Float[Array, "... p d"]
    ) -> Array:
        """The function of Omega with eigenvalues `along` the basis and `across` it, applied to each row of x."""
        # Full precision: the tensor cores' short floats would cost reversibility.
        inner = jnp.einsum("...pd,...rd->...pr", x, self.basis, precision="highest")
        return across * x + jnp.einsum("...pr,...rd->...pd", (along - across) * inner, self.basis, precision="highest")


def gradient_metric(
    gradient: Float[Array, "n d"], log_w: Float[Array, "n"], beta: Float[Array, ""], rank: int
) -> Metric:
    """M = I + Cov(beta grad l) over weighted draws, kept along its `rank` stiffest directions (stiffest first).

    For a Gaussian likelihood of precision K and draws of the target this is I + beta^2 K (I + beta K)^-1 K: about the
    target's precision I + beta K in every stiff direction, and exactly the prior's where the likelihood says nothing.
    It needs no more draws than there are stiff directions, in any dimension.
    """
    weight = jnp.exp(log_w - jax.scipy.special.logsumexp(log_w))
    weight = jnp.where(jnp.isfinite(weight), weight, 0.0)
    # An overflow here would poison a whole population; a slope of 10^12 pins its direction as well as any.
    g = beta * jnp.clip(gradient, -1e12, 1e12)
    g = jnp.sqrt(weight)[:, None] * (g - weight @ g)
    g = jnp.pad(g, ((0, max(0, rank - len(g))), (0, 0)))
    if g.shape[1] > g.shape[0]:  # few draws of many dimensions: in the space that they span
        span, _ = jnp.linalg.qr(g.T)
        g = jnp.matmul(g, span, precision="highest")
    # An eigendecomposition is 30 times faster here than a singular value decomposition. Squaring costs the precision of
    # variances 10^7 below the largest, which costs speed and not correctness: the basis stays orthonormal.
    variance, vectors = jnp.linalg.eigh(jnp.matmul(g.T, g, precision="highest"))
    variance, vectors = jnp.maximum(variance, 0.0)[::-1][:rank], vectors[:, ::-1][:, :rank]
    basis = vectors if g.shape[1] == gradient.shape[1] else jnp.matmul(span, vectors, precision="highest")
    return Metric(basis.T, 1.0 / jnp.sqrt(1.0 + variance))


class Target(eqx.Module):
    """N(q; 0, I) exp(beta l(args, q)), seen through a metric (None: the identity)."""

    log_likelihood: LogLikelihood = eqx.field(static=True)
    args: Any
    beta: Float[Array, "..."]  # broadcasts against the positions' leading axes
    metric: Metric | None = None

    def value(self, position: Float[Array, "... d"]) -> Float[Array, "..."]:
        """The log-likelihood at `position`, without its gradient; where not finite, -inf."""
        value = self.log_likelihood(self.args, position.reshape(-1, position.shape[-1]))
        return jnp.where(jnp.isfinite(value), value, -jnp.inf).reshape(position.shape[:-1])

    def evaluate(self, position: Float[Array, "... d"]) -> "HMCState":
        """Evaluates the likelihood and its gradient at `position`; where not finite, it is -inf with gradient 0."""
        flat = position.reshape(-1, position.shape[-1])
        value, pullback = jax.vjp(lambda q: self.log_likelihood(self.args, q), flat)
        (gradient,) = pullback(jnp.ones_like(value))
        alive = jnp.isfinite(value)
        value = jnp.where(alive, value, -jnp.inf)
        gradient = jnp.where(alive[:, None] & jnp.isfinite(gradient), gradient, 0.0)
        return HMCState(position, value.reshape(position.shape[:-1]), gradient.reshape(position.shape))


class HMCState(eqx.Module):
    """Positions with their untempered log-likelihood and its gradient."""

    position: Float[Array, "... d"]
    log_likelihood: Float[Array, "..."]  # -inf where the likelihood is not finite
    gradient: Float[Array, "... d"]


class HMCInfo(eqx.Module):
    """What one HMC iteration says of each chain."""

    acceptance: Float[Array, "..."]  # Metropolis acceptance probability
    accepted: Bool[Array, "..."]
    divergent: Bool[Array, "..."]
    energy_error: Float[Array, "..."]  # H(end) - H(start), nats


def leapfrog(
    state: HMCState, momentum: Float[Array, "... d"], target: Target, step_size: Float[Array, "..."], steps: int
) -> tuple[HMCState, Float[Array, "... d"]]:
    """`steps` steps of the split integrator: half kick by the likelihood, exact turn under the prior, half kick.

    `step_size` broadcasts against the leading axes; `momentum` is the whitened v. One gradient a step. The map
    preserves volume, and flipping the momentum reverses it.
    """
    epsilon = jnp.broadcast_to(step_size, state.position.shape[:-1])[..., None]
    push = 0.5 * epsilon * jnp.broadcast_to(target.beta, epsilon.shape[:-1])[..., None]
    metric = target.metric

    if metric is None:
        cosine, sine = jnp.cos(epsilon), jnp.sin(epsilon)

        def turn(q, v):
            return cosine * q + sine * v, cosine * v - sine * q

        def kick(v, gradient):
            return v + push * gradient
    else:
        omega = metric.frequency[..., None, :]
        cosines = jnp.cos(omega * epsilon), jnp.cos(epsilon)
        sines = jnp.sin(omega * epsilon), jnp.sin(epsilon)

        def turn(q, v):
            return (
                metric.apply(*cosines, q) + metric.apply(*sines, v),
                metric.apply(*cosines, v) - metric.apply(*sines, q),
            )

        def kick(v, gradient):
            return v + metric.apply(omega * push, push, gradient)

    def step(carry, _):
        state, v = carry
        q, v = turn(state.position, kick(v, state.gradient))
        state = target.evaluate(q)
        return (state, kick(v, state.gradient)), None

    (state, momentum), _ = jax.lax.scan(step, (state, momentum), length=steps)
    return state, momentum


def energy_error(
    start: HMCState, v0: Array, end: HMCState, v1: Array, beta: Float[Array, "..."]
) -> Float[Array, "..."]:
    """H(end) - H(start), summed as differences: H itself can be 10^4 while 10^-2 matters."""
    quadratic = (end.position - start.position) * (end.position + start.position) + (v1 - v0) * (v1 + v0)
    # At beta = 0 the target is the prior, and a likelihood of -inf is no obstacle.
    likelihood = jnp.where(beta > 0, beta * (end.log_likelihood - start.log_likelihood), 0.0)
    return 0.5 * jnp.sum(quadratic, axis=-1) - likelihood


def hmc_step(
    key: PRNGKeyArray, state: HMCState, target: Target, step_size: Float[Array, "..."], steps: int
) -> tuple[HMCState, HMCInfo]:
    """One HMC iteration of every chain: fresh momentum, jittered step size, exact Metropolis test.

    A trajectory whose energy error is not finite or exceeds MAX_ENERGY_ERROR is divergent and rejected.
    """
    momentum_key, uniform_key = jax.random.split(key)
    momentum = jax.random.normal(momentum_key, state.position.shape)
    chains = state.log_likelihood.shape
    uniform = jax.random.uniform(uniform_key, (2, *chains))
    jitter = JITTER[0] + (JITTER[1] - JITTER[0]) * uniform[0]
    end, end_momentum = leapfrog(state, momentum, target, step_size * jitter, steps)

    error = energy_error(state, momentum, end, end_momentum, target.beta)
    divergent = ~jnp.isfinite(error) | (error > MAX_ENERGY_ERROR)
    acceptance = jnp.where(divergent, 0.0, jnp.exp(-jnp.maximum(error, 0.0)))
    accepted = uniform[1] < acceptance
    state = jax.tree.map(
        lambda a, b: jnp.where(accepted.reshape(chains + (1,) * (a.ndim - len(chains))), a, b), end, state
    )
    return state, HMCInfo(acceptance, accepted, divergent, error)


def split_r_hat(draws: Float[np.ndarray, "chains n"]) -> float:
    """Split R-hat (Gelman et al., BDA3 eq. 11.4) of a scalar; NaN where undefined (under 4 draws, all equal)."""
    half = draws.shape[1] // 2
    if half < 2 or not np.all(np.isfinite(draws)):
        return float("nan")
    halves = np.concatenate([draws[:, :half], draws[:, -half:]]).astype(np.float64)
    within = halves.var(axis=1, ddof=1).mean()
    between = halves.mean(axis=1).var(ddof=1)
    return float(np.sqrt((half - 1) / half + between / within)) if within > 0 else float("nan")


@dataclass(frozen=True)
class StageInfo:
    """Progress of a sampler after one stage; tuples have one entry per population (one for all of HMC's chains)."""

    stage: int  # from 0, which is the start
    beta: tuple[float, ...]  # inverse temperature reached; 1 is the posterior
    ess: tuple[float, ...]  # effective sample size of the last importance weights (NaN where there were none)
    acceptance: tuple[float, ...]
    step_size: tuple[float, ...]
    log_evidence: tuple[float, ...]  # of the tempered target at `beta` (NaN for samplers that have none)
    divergences: int  # so far
    seconds: float  # since the start
    samples: Callable[[], Posterior]  # the draws at hand, of the target at `beta`; made when asked for


@dataclass(frozen=True)
class AnnealedHMCConfig:
    """The paper's schedule. It names neither start nor base step: chains start at the prior, the step is tuned."""

    chains: int = 8
    iterations: int = 100
    leapfrog_steps: int = 100
    s_start: float = 5.0  # observation noise scale at the first iteration ...
    s_end: float = 0.1  # ... and at the last: the scale that the log-likelihood was written for
    keep: int = 16  # last states of each chain that become samples
    step_per_scale: float = 0.05  # step size divided by s_t
    tune_iterations: int = 20  # over these, step_per_scale follows the acceptance; then it is fixed (0: never tuned)
    target_acceptance: float = 0.8

    def __post_init__(self) -> None:
        if not (self.chains >= 1 and self.leapfrog_steps >= 1 and self.step_per_scale > 0):
            raise ValueError("AnnealedHMCConfig: chains, leapfrog_steps and step_per_scale must be positive")
        if not 1 <= self.keep <= self.iterations:
            raise ValueError(f"AnnealedHMCConfig: keep {self.keep} must lie between 1 and iterations {self.iterations}")
        if not 0 < self.s_end <= self.s_start:
            raise ValueError(f"AnnealedHMCConfig: need 0 < s_end <= s_start, got {self.s_end} and {self.s_start}")


MAX_ANNEALED_STEP = 1.0  # radians: a turn of the prior beyond it is never useful


@partial(jax.jit, static_argnames=("log_likelihood", "chains", "dim"))
def _annealed_start(key, args, *, log_likelihood: LogLikelihood, chains: int, dim: int) -> HMCState:
    return Target(log_likelihood, args, jnp.zeros(())).evaluate(jax.random.normal(key, (chains, dim)))


@partial(jax.jit, static_argnames=("log_likelihood", "steps"))
def _annealed_step(key, state, args, beta, step_size, *, log_likelihood: LogLikelihood, steps: int):
    return hmc_step(key, state, Target(log_likelihood, args, beta), step_size, steps)


def annealed_hmc(
    key: PRNGKeyArray,
    log_likelihood: LogLikelihood,
    args: Any,
    dim: int,
    config: AnnealedHMCConfig | None = None,
    *,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    deadline: float | None = None,
) -> Posterior:
    """The paper's sampler (section 3.3): independent chains cooled from s_start to s_end, s_t = s_0^(1-t/T) s_T^(t/T).

    Every likelihood term is multiplied by (s_end / s_t)^2 and the step size is proportional to s_t. Kept are the last
    `keep` states of each chain, equally weighted; all but the very last are drawn at s_t > s_end, so this is no sample
    of the posterior, and there is no evidence (NaN). The integrator is the split one with identity mass. `deadline` is
    on time.monotonic()'s clock. result is "stages" when the schedule was completed, else "budget", "stopped" (by
    `on_stage`) or "interrupted", with the states at hand. `point_gradients` counts gradients of whole positions.
    """
    config = config or AnnealedHMCConfig()
    begun = time.monotonic()
    start_key, key = jax.random.split(key)
    state = _annealed_start(start_key, args, log_likelihood=log_likelihood, chains=config.chains, dim=dim)
    kept = [(np.asarray(state.position), np.asarray(state.log_likelihood))]
    acceptances: list[float] = []
    divergences, base, beta, result = 0, config.step_per_scale, 0.0, "stages"
    base = min(base, MAX_ANNEALED_STEP / config.s_start)

    def samples(result: str = "underway") -> Posterior:
        return _annealed_posterior(config, kept, acceptances, divergences, beta, result)

    try:
        for t in range(1, config.iterations + 1):
            # An iteration costs about the mean of those before: none is begun that would overrun the deadline.
            now = time.monotonic()
            if deadline is not None and now + (now - begun) / t > deadline:
                result = "budget"
                break
            scale = config.s_start * (config.s_end / config.s_start) ** (t / config.iterations)
            beta, step = (config.s_end / scale) ** 2, base * scale
            state, info = _annealed_step(
                jax.random.fold_in(key, t), state, args, np.float32(beta), np.float32(step),
                log_likelihood=log_likelihood, steps=config.leapfrog_steps,
            )  # fmt: skip
            acceptances.append(float(np.mean(np.asarray(info.acceptance))))
            divergences += int(np.sum(np.asarray(info.divergent)))
            kept = [*kept, (np.asarray(state.position), np.asarray(state.log_likelihood))][-config.keep :]
            if t <= config.tune_iterations:
                base *= float(np.exp(acceptances[-1] - config.target_acceptance))
                base = min(base, MAX_ANNEALED_STEP / config.s_start)
            if on_stage is not None:
                none, seconds = (float("nan"),), time.monotonic() - begun
                told = StageInfo(t, (beta,), none, (acceptances[-1],), (step,), none, divergences, seconds, samples)
                if on_stage(told):
                    result = "stopped"
                    break
    except KeyboardInterrupt:
        result = "interrupted"
    return samples(result)


def _annealed_posterior(config, kept, acceptances, divergences, beta, result) -> Posterior:
    positions = np.stack([q for q, _ in kept])  # [kept, chains, dim]
    values = np.stack([value for _, value in kept])
    count, dim = values.size, positions.shape[-1]
    done = len(acceptances)
    nan = jnp.asarray(np.float32("nan"))
    return Posterior(
        positions=jnp.asarray(positions.reshape(count, dim)),
        log_weights=jnp.asarray(np.full(count, -np.log(count), np.float32)),
        log_likelihoods=jnp.asarray(values.reshape(count)),
        population=jnp.asarray(np.tile(np.arange(config.chains, dtype=np.int32), len(kept))),
        log_evidence=nan,
        log_evidence_se=nan,
        diagnostics=Diagnostics(
            acceptance=jnp.asarray(np.float32(np.mean(acceptances[-config.keep :]) if done else "nan")),
            divergences=jnp.asarray(np.int32(divergences)),
            r_hat=jnp.asarray(np.float32(split_r_hat(values.T))),
            ess=jnp.asarray(np.float32(count)),
            ancestors=jnp.asarray(np.int32(config.chains)),
            stages=jnp.asarray(np.int32(done)),
            point_gradients=jnp.asarray(np.float32(config.chains * (1 + done * config.leapfrog_steps))),
            beta=jnp.asarray(np.full(config.chains, beta, np.float32)),
            log_evidences=jnp.asarray(np.full(config.chains, np.nan, np.float32)),
        ),
        result=result,
    )
