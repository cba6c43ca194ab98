"""Tempered sequential Monte Carlo: weighted samples and an evidence estimate for standard-normal latents.

Independent populations of particles go from the prior (beta = 0) to the posterior (beta = 1). A *round* is one HMC iteration
of every particle; a *stage* is some rounds at the present beta, then a step of beta that keeps the conditional effective
sample size (Zhou, Johansen, Aston 2016), the particles' incremental weights L^(step of beta), and systematic resampling.
The product of the mean incremental weights estimates the evidence (Del Moral, Doucet, Jasra 2006).

Everything that tunes one population's moves (metric, step size) is read off its neighbour population, never off the states that
are about to move. The metric is M = I + Cov(beta grad l) over the neighbour's particles: for a Gaussian likelihood of precision K the
covariance is K (beta^-1 + K)^-1 K beta ~ beta K in every stiff direction, and exactly 0 in the directions that the likelihood leaves to the
prior. It needs no more particles than there are stiff directions, whatever the dimension.
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
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from probnerf.hmc import HMCState, LogLikelihood, Metric, StageInfo, Target, hmc_step, split_r_hat
from probnerf.types import Diagnostics, Posterior


@dataclass(frozen=True)
class TemperedSMCConfig:
    """Sizes and targets. All but the counts of rounds that the host keeps are compiled in."""

    populations: int = 2  # independent runs: their spread is the Monte Carlo error
    particles: int = 64  # per population
    start_particles: int = 256  # drawn from the prior per population for the first importance step (at least `particles`)
    ess_target: float = 0.5  # conditional effective sample size after each step of beta, as a fraction of `particles`
    moves: int = 2  # HMC iterations a stage
    leapfrog_steps: int = 8
    target_acceptance: float = 0.8
    final_rounds: int = 4  # stages at beta = 1
    keep: int = 4  # the last of them whose states become samples
    max_stages: int = 200

    def __post_init__(self) -> None:
        if min(self.populations, self.moves, self.leapfrog_steps, self.max_stages) < 1 or self.particles < 2:
            raise ValueError("TemperedSMCConfig: counts must be positive, and particles at least 2")
        if self.start_particles < self.particles:
            raise ValueError(
                f"TemperedSMCConfig: start_particles {self.start_particles} must be at least particles {self.particles}"
            )
        if not 0 < self.ess_target < 1:
            raise ValueError(f"TemperedSMCConfig: ess_target {self.ess_target} must lie between 0 and 1")
        if not 1 <= self.keep <= self.final_rounds:
            raise ValueError(f"TemperedSMCConfig: keep {self.keep} must lie between 1 and final_rounds {self.final_rounds}")

    @property
    def longest_step(self) -> float:
        """A quarter turn a trajectory: where the metric is right every direction has period 2 pi, and more undoes itself."""
        return 0.5 * np.pi / self.leapfrog_steps


class _State(eqx.Module):
    chain: HMCState  # [populations, particles, ...]
    beta: Float[Array, "m"]
    log_evidence: Float[Array, "m"]  # of the target at beta
    ancestor: Int[Array, "m p"]  # index of the initial particle
    step_size: Float[Array, "m"]


class _Info(eqx.Module):
    ess: Float[Array, "m"]
    acceptance: Float[Array, "m"]
    step_size: Float[Array, "m"]  # the one used last
    divergences: Int[Array, ""]


def log_prior(q: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Log-density of N(0, I) at q."""
    return -0.5 * jnp.sum(q * q + jnp.log(2 * jnp.pi), axis=-1)


def _ess(log_w: Float[Array, "... n"]) -> Float[Array, "..."]:
    """Effective sample size of unnormalised weights, 0 if all are 0."""
    top = jnp.max(log_w, axis=-1, keepdims=True)
    w = jnp.exp(log_w - jnp.where(jnp.isfinite(top), top, 0.0))
    return jnp.sum(w, axis=-1) ** 2 / jnp.maximum(jnp.sum(w * w, axis=-1), 1e-30)


# Fractions of the remaining way to beta = 1, 40 a decade. A grid, as the ESS need not fall with beta under proposals.
_FRACTIONS = np.geomspace(1e-9, 1.0, 361).astype(np.float32)


def _next_beta(beta, log_w, log_likelihood, target):
    """The largest beta of the grid at which the weights exp(log_w) L^(step) keep the ESS, and those weights' logarithms.

    Where none keeps it (dead particles, poor proposals) the one of the largest ESS; without any live particle beta becomes 1.
    """

    def weights(step):
        return jnp.where(jnp.isfinite(log_likelihood), log_w + step * log_likelihood, -jnp.inf)

    steps = (1.0 - beta) * _FRACTIONS
    ess = jax.vmap(lambda step: _ess(weights(step)))(steps)
    enough = ess >= target
    index = jnp.where(jnp.any(enough), ess.size - 1 - jnp.argmax(enough[::-1]), jnp.argmax(ess))
    index = jnp.where(jnp.any(jnp.isfinite(log_likelihood)), index, ess.size - 1)
    new = jnp.where(index == ess.size - 1, 1.0, beta + steps[index])  # beta + (1 - beta) need not be 1 in float32
    return new, weights(new - beta), ess[index]


def _resample(key, log_w, count: int):
    """Systematic resampling: indices of `count` particles, each drawn count * w_i times up to rounding."""
    top = jnp.max(log_w)
    total = jnp.cumsum(jnp.where(jnp.isfinite(top), jnp.exp(log_w - top), 1.0))
    u = (jnp.arange(count) + jax.random.uniform(key)) / count
    u = jnp.minimum(u, 1.0 - 2.0**-24)  # rounding up to 1 would pass the last particle of positive weight
    return jnp.searchsorted(total / total[-1], u, side="right")


def _metric(gradient: Float[Array, "p d"], beta: Float[Array, ""]) -> Metric:
    """Omega = (I + Cov(beta grad l))^(-1/2), from the thin singular value decomposition of the particles' gradients."""
    # An overflow here would poison a whole population; a slope of 10^12 pins its direction as well as any.
    g = beta * jnp.clip(gradient, -1e12, 1e12)
    _, s, basis = jnp.linalg.svd((g - jnp.mean(g, axis=0)) / np.sqrt(g.shape[0]), full_matrices=False)
    return Metric(basis, 1.0 / jnp.sqrt(1.0 + s * s))


@partial(jax.jit, static_argnames=("log_likelihood", "config"))
def _start(key, args, q0, log_w0, *, log_likelihood: LogLikelihood, config: TemperedSMCConfig):
    """Importance step from q0 [m, p0, d] with weights exp(log_w0) = prior / proposal to the first beta > 0."""
    populations, count, dim = q0.shape
    chunks = -(-count // config.particles)
    padded = jnp.concatenate([q0, jnp.zeros((populations, chunks * config.particles - count, dim))], axis=1)
    padded = padded.reshape(populations, chunks, config.particles, dim).swapaxes(0, 1)
    pool = jax.lax.map(Target(log_likelihood, args, jnp.zeros(())).evaluate, padded)  # as wide as any later evaluation
    pool = jax.tree.map(lambda a: a.swapaxes(0, 1).reshape(populations, -1, *a.shape[3:])[:, :count], pool)

    log_w0 = jnp.where(jnp.isfinite(log_w0), log_w0, -jnp.inf)
    value = jnp.where(jnp.isfinite(log_w0), pool.log_likelihood, -jnp.inf)
    target = config.ess_target * config.particles
    beta, log_w, ess = jax.vmap(lambda w, value: _next_beta(jnp.zeros(()), w, value, target))(log_w0, value)
    index = jax.vmap(lambda k, w: _resample(k, w, config.particles))(jax.random.split(key, populations), log_w)
    state = _State(
        chain=jax.vmap(lambda tree, i: jax.tree.map(lambda a: a[i], tree))(pool, index),
        beta=beta,
        log_evidence=logsumexp(log_w, axis=1) - np.log(count),
        ancestor=index,
        step_size=jnp.full(populations, config.longest_step),
    )
    unmoved = jnp.full(populations, jnp.nan)
    return state, _Info(ess, unmoved, state.step_size, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames=("log_likelihood", "config"))
def _stage(key, state: _State, args, *, log_likelihood: LogLikelihood, config: TemperedSMCConfig):
    """`moves` rounds at the present beta, then the step to the next beta (none at 1) and resampling."""
    beta = state.beta

    def round_(carry, key):
        chain, step = carry
        metric = jax.vmap(_metric)(jnp.roll(chain.gradient, 1, axis=0), beta)
        target = Target(log_likelihood, args, beta[:, None], metric)
        chain, info = hmc_step(key, chain, target, step[:, None], config.leapfrog_steps)
        acceptance = jnp.mean(info.acceptance, axis=1)
        tuned = jnp.minimum(step * jnp.exp(2.0 * (acceptance - config.target_acceptance)), config.longest_step)
        return (chain, jnp.roll(tuned, 1)), (acceptance, step, jnp.sum(info.divergent))

    move_key, resample_key = jax.random.split(key)
    (chain, step), (acceptance, used, divergences) = jax.lax.scan(
        round_, (state.chain, state.step_size), jax.random.split(move_key, config.moves)
    )

    flat = jnp.zeros(config.particles)
    target = config.ess_target * config.particles
    new_beta, log_w, ess = jax.vmap(lambda b, value: _next_beta(b, flat, value, target))(beta, chain.log_likelihood)
    index = jax.vmap(lambda k, w: _resample(k, w, config.particles))(jax.random.split(resample_key, beta.size), log_w)
    moving = beta < 1
    index = jnp.where(moving[:, None], index, jnp.arange(config.particles))  # equal weights: nothing to resample
    chain, ancestor = jax.vmap(lambda tree, i: jax.tree.map(lambda a: a[i], tree))((chain, state.ancestor), index)
    gain = jnp.where(moving, logsumexp(log_w, axis=1) - np.log(config.particles), 0.0)
    state = _State(chain, jnp.where(moving, new_beta, 1.0), state.log_evidence + gain, ancestor, step)
    ess = jnp.where(moving, ess, jnp.nan)
    return state, _Info(ess, jnp.mean(acceptance, axis=0), used[-1], jnp.sum(divergences))


@partial(jax.jit, static_argnames=("shape",))
def _prior_start(key, *, shape: tuple[int, int, int]):
    return jax.random.normal(key, shape), jnp.zeros(shape[:2])


@jax.jit
def _proposal_start(q0, log_q0):
    return q0, log_prior(q0) - log_q0


def tempered_smc(
    key: PRNGKeyArray,
    log_likelihood: LogLikelihood,
    args: Any,
    dim: int,
    config: TemperedSMCConfig | None = None,
    *,
    initial: tuple[Float[Array, "m p0 d"], Float[Array, "m p0"]] | None = None,
    on_stage: Callable[[StageInfo], None] | None = None,
    deadline: float | None = None,
    stages: int | None = None,
) -> Posterior:
    """Samples N(q; 0, I) L(q) by adaptive tempered SMC, with an evidence estimate.

    `initial` are positions drawn from any density that covers the prior (a defensive mixture of prior and encoder, say) and their
    log-density; None draws `start_particles` from the prior. `deadline` is on time.monotonic()'s clock, no stage is begun that would
    overrun it by the shortest stage so far; `stages` caps their number, and without a deadline the answer depends on key and
    stages alone. A start is always made.

    The samples are all particles of the last `keep` rounds; a population's share of the weight is its evidence estimate, which
    makes weighted averages consistent when populations found different modes. log_evidence is the log of the mean estimate, its error the
    relative standard error of that mean (NaN for one population). Populations touch only through tuning.

    result: "converged" (beta = 1 and all final rounds), else "budget", "stages" or "interrupted" (Ctrl-C). Stopped before beta = 1 the particles
    are equally weighted draws of the *tempered* target (too wide, never falsely certain) and log_evidence is NaN.
    `point_gradients` counts gradient evaluations of whole positions.
    """
    config = config or TemperedSMCConfig()
    begun = time.monotonic()
    start_key, prior_key, key = jax.random.split(key, 3)
    if initial is None:
        q0, log_w0 = _prior_start(prior_key, shape=(config.populations, config.start_particles, dim))
    else:
        q0, log_w0 = _proposal_start(*_checked(initial, config, dim))
    state, info = _start(start_key, args, q0, log_w0, log_likelihood=log_likelihood, config=config)

    gradients = float(q0.shape[0] * q0.shape[1])
    kept: list[HMCState] = []  # states after each final round
    cap, done, divergences, shortest, acceptance, result = stages, 0, 0, 0.0, float("nan"), "converged"
    cap = config.max_stages if stages is None else min(stages, config.max_stages)
    try:
        while True:
            divergences += int(info.divergences)
            if on_stage is not None:
                on_stage(_progress(done, state, info, divergences, time.monotonic() - begun))
            if len(kept) == config.final_rounds:
                break
            now = time.monotonic()
            if done >= cap or (deadline is not None and now + shortest > deadline):
                result = "stages" if done >= cap else "budget"
                break
            final = bool(np.all(np.asarray(state.beta) == 1.0))
            state, info = _stage(
                jax.random.fold_in(key, done), state, args, log_likelihood=log_likelihood, config=config
            )
            acceptance = float(np.mean(np.asarray(info.acceptance)))  # waits for the device
            if final:
                kept = [*kept, state.chain]
            done += 1
            seconds = time.monotonic() - now
            shortest = seconds if done == 1 else min(shortest, seconds)
            gradients += config.populations * config.particles * config.moves * config.leapfrog_steps
    except KeyboardInterrupt:
        result = "interrupted"
    return _posterior(state, kept[-config.keep :] or [state.chain], acceptance, divergences, done, gradients, result)


def _checked(initial, config: TemperedSMCConfig, dim: int):
    q0, log_q0 = (jnp.asarray(a, jnp.float32) for a in initial)
    if q0.ndim != 3 or q0.shape[0] != config.populations or q0.shape[1] < config.particles or q0.shape[2] != dim:
        raise ValueError(
            f"initial positions have shape {q0.shape}; they must be "
            f"[{config.populations} populations, at least {config.particles} particles, {dim}]"
        )
    if log_q0.shape != q0.shape[:2]:
        raise ValueError(f"initial log-densities have shape {log_q0.shape}; positions want {q0.shape[:2]}")
    return q0, log_q0


def _progress(stage: int, state: _State, info: _Info, divergences: int, seconds: float) -> StageInfo:
    def row(a):
        return tuple(np.asarray(a).tolist())

    return StageInfo(
        stage, row(state.beta), row(info.ess), row(info.acceptance), row(info.step_size), row(state.log_evidence),
        divergences, seconds,
    )  # fmt: skip


def _posterior(state: _State, kept: list[HMCState], acceptance, divergences, stages, gradients, result) -> Posterior:
    # NumPy: the number of kept rounds varies, and nothing may compile for it.
    positions = np.stack([np.asarray(chain.position) for chain in kept])  # [rounds, m, p, d]
    values = np.stack([np.asarray(chain.log_likelihood) for chain in kept])
    rounds, populations, particles = values.shape
    complete = bool(np.all(np.asarray(state.beta) == 1.0))
    estimates = np.asarray(state.log_evidence, np.float64)
    log_evidence = error = float("nan")
    share = np.full(populations, -np.log(populations))
    if complete:
        log_evidence = float(np.logaddexp.reduce(estimates) - np.log(populations))
    if np.isfinite(log_evidence):
        share = estimates - np.logaddexp.reduce(estimates)
        if populations > 1:
            error = float(np.std(np.exp(estimates - log_evidence), ddof=1) / np.sqrt(populations))
    log_weights = np.broadcast_to((share - np.log(rounds * particles))[None, :, None], values.shape).ravel()
    return Posterior(
        positions=jnp.asarray(positions.reshape(-1, positions.shape[-1])),
        log_weights=jnp.asarray(log_weights.astype(np.float32)),
        log_likelihoods=jnp.asarray(values.ravel()),
        population=jnp.asarray(np.broadcast_to(np.arange(populations, dtype=np.int32)[None, :, None], values.shape).ravel()),
        log_evidence=jnp.asarray(np.float32(log_evidence)),
        log_evidence_se=jnp.asarray(np.float32(error)),
        diagnostics=Diagnostics(
            acceptance=jnp.asarray(np.float32(acceptance)),
            divergences=jnp.asarray(np.int32(divergences)),
            r_hat=jnp.asarray(np.float32(split_r_hat(values.swapaxes(0, 1).reshape(populations, -1)))),
            ess=jnp.asarray(np.float32(1.0 / np.sum(np.exp(2.0 * log_weights)))),
            ancestors=jnp.asarray(np.int32(sum(len(np.unique(row)) for row in np.asarray(state.ancestor)))),
            stages=jnp.asarray(np.int32(stages)),
            point_gradients=jnp.asarray(np.float32(gradients)),
        ),
        result=result,
    )
