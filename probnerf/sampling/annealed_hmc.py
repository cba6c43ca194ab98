"""The paper's sampler: independent, annealed Hamiltonian Monte Carlo chains."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from probnerf.sampling.hmc import HMCState, LogLikelihood, StageInfo, Target, hmc_step, split_r_hat
from probnerf.settings import AnnealedHMCConfig
from probnerf.types import Diagnostics, Posterior, StopReason

MAX_ANNEALED_STEP = 1.0  # radians; larger rotations under the prior are never useful


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
    """The paper's sampler (section 3.3): independent chains, annealed by the scale s_t = s_start^(1-t/T) s_end^(t/T).

    The log-likelihood is multiplied by (s_end / s_t)^2. The step size is proportional to s_t. The result holds the last
    `keep` states of each chain with equal weights. All but the last one are drawn at s_t > s_end, so they are not
    samples of the posterior. There is no evidence estimate (NaN). The integrator is the split one with identity mass.
    `deadline` is on time.monotonic()'s clock. `result` is "stages" if the schedule was completed, else "budget",
    "stopped" (by `on_stage`) or "interrupted", with the states so far. `point_gradients` counts gradient evaluations of
    whole positions.
    """
    config = config or AnnealedHMCConfig()
    begun = time.monotonic()
    start_key, key = jax.random.split(key)
    state = _annealed_start(start_key, args, log_likelihood=log_likelihood, chains=config.chains, dim=dim)
    kept = [(np.asarray(state.position), np.asarray(state.log_likelihood))]
    acceptances: list[float] = []
    divergences, base, beta, result = 0, config.step_per_scale, 0.0, StopReason.STAGES
    base = min(base, MAX_ANNEALED_STEP / config.s_start)

    def samples(result: StopReason = StopReason.UNDERWAY) -> Posterior:
        return _annealed_posterior(config, kept, acceptances, divergences, beta, result)

    try:
        for t in range(1, config.iterations + 1):
            # Expect an iteration to take the mean time of those before. Start none that would pass the deadline.
            now = time.monotonic()
            if deadline is not None and now + (now - begun) / t > deadline:
                result = StopReason.BUDGET
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
                progress = StageInfo(t, (beta,), none, (acceptances[-1],), (step,), none, divergences, seconds, samples)
                if on_stage(progress):
                    result = StopReason.STOPPED
                    break
    except KeyboardInterrupt:
        result = StopReason.INTERRUPTED
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
        log_density=jnp.asarray(np.full(count, np.nan, np.float32)),
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
