"""Populations of samples: several runs as one posterior, samples as starts of another run, and representatives."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from probnerf.sampling.hmc import HMCState, split_r_hat
from probnerf.types import Diagnostics, Posterior, StopReason

# Nats under the best population's evidence from which on one has failed: it never left a poor mode. Those that found
# different good ones differ by a few nats, which are mostly noise. On validation views no answer got worse by it; under
# 30 nats answers became too sure.
FAILED = 100.0


def shares(
    log_evidences: Float[np.ndarray, "m"], power: float
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, ""] | float]:
    """Each population's share of the weight (its logarithm), by its evidence to a power; log of the mean evidence.

    One that has failed has none. Even shares and NaN where an estimate is missing or none is finite.
    """
    even = np.full(len(log_evidences), -np.log(len(log_evidences)))
    if np.isnan(log_evidences).any():
        return even, float("nan")
    mean = float(np.logaddexp.reduce(log_evidences) - np.log(len(log_evidences)))
    if not np.isfinite(mean):
        return even, mean
    share = np.full(len(log_evidences), -np.inf)
    fit = log_evidences > log_evidences.max() - FAILED
    share[fit] = power * (log_evidences[fit] - mean)
    return share - np.logaddexp.reduce(share), mean


def gathered(
    pools: Sequence[HMCState],
    beta: Float[np.ndarray, "m"],
    log_evidences: Float[np.ndarray, "m"],
    variance: Float[np.ndarray, "m"],
    evidence_power: float,
    others: dict[str, Array],
    result: StopReason,
) -> Posterior:
    """The pools [m, n, ...] of a run's last stages as one posterior; `others` are its further diagnostics.

    `variance` is that of each evidence estimate, were the particles of a population independent.
    """
    # NumPy: the number of pools varies, and nothing may compile for it.
    positions = np.stack([np.asarray(pool.position) for pool in pools])  # [keep, m, n, d]
    values = np.stack([np.asarray(pool.log_likelihood) for pool in pools])
    by_population = values.swapaxes(0, 1).reshape(values.shape[1], -1)
    over = np.stack([np.asarray(pool.over_prior) for pool in pools])
    populations = values.shape[1]
    reached = bool(np.all(beta == 1.0))
    share, log_evidence = shares(log_evidences if reached else np.full(populations, np.nan), evidence_power)
    error = float("nan")
    if np.isfinite(log_evidence):
        ratio = np.exp(log_evidences - log_evidence)
        spread = np.std(ratio, ddof=1) / np.sqrt(populations) if populations > 1 else 0.0
        within = np.sqrt(np.sum(ratio**2 * variance)) / populations
        error = float(max(spread, within))
    log_weights = np.broadcast_to((share - np.log(values.size / populations))[None, :, None], values.shape).ravel()
    population = np.broadcast_to(np.arange(populations, dtype=np.int32)[None, :, None], values.shape).ravel()
    # f of the target r^(1 - beta) (prior x likelihood)^beta = prior x exp(f), over the estimate of its integral
    f = (1.0 - beta[:, None]) * over + np.where(beta[:, None] > 0, beta[:, None] * values, 0.0)
    log_normal = -0.5 * np.sum(positions.astype(np.float64) ** 2 + np.log(2.0 * np.pi), axis=-1)
    with np.errstate(invalid="ignore"):  # no likelihood anywhere
        log_density = log_normal + f - log_evidences[:, None]
    return Posterior(
        positions=jax.device_put(positions.reshape(-1, positions.shape[-1])),
        log_weights=jax.device_put(log_weights.astype(np.float32)),
        log_likelihoods=jax.device_put(values.ravel()),
        log_density=jax.device_put(log_density.astype(np.float32).ravel()),
        population=jax.device_put(population),
        log_evidence=jax.device_put(np.float32(log_evidence)),
        log_evidence_se=jax.device_put(np.float32(error)),
        diagnostics=Diagnostics(
            r_hat=jax.device_put(np.float32(split_r_hat(by_population[share > -np.inf]))),
            ess=jax.device_put(np.float32(1.0 / np.sum(np.exp(2.0 * log_weights)))),
            beta=jax.device_put(np.asarray(beta, np.float32)),
            log_evidences=jax.device_put(np.asarray(log_evidences, np.float32)),
            **others,
        ),
        result=result,
    )


def pooled(posteriors: Sequence[Posterior], evidence_power: float) -> Posterior:
    """Independent runs of tempered SMC at beta = 1, on one target and of one size, as one posterior of all populations.

    Acceptance and `result` are the last run's; counts are added up. The evidence's error is the populations' spread.
    """
    if len(posteriors) == 1:
        return posteriors[0]
    m = len(posteriors[0].diagnostics.log_evidences)
    estimates = np.concatenate([np.asarray(p.diagnostics.log_evidences, np.float64) for p in posteriors])
    share, log_evidence = shares(estimates, evidence_power)
    population = np.concatenate([np.asarray(p.population) + m * i for i, p in enumerate(posteriors)])
    values = np.concatenate([np.asarray(p.log_likelihoods) for p in posteriors])
    log_weights = share[population] - np.log(len(values) / len(estimates))
    spread = np.std(np.exp(estimates - log_evidence), ddof=1) / np.sqrt(len(estimates))
    by_population = values[np.argsort(population, kind="stable")].reshape(len(estimates), -1)
    every = [p.diagnostics for p in posteriors]

    def summed(counts: Sequence[Array]) -> Array:
        return jax.device_put(np.sum(np.stack([np.asarray(c) for c in counts]), axis=0))

    def joined(arrays: Sequence[Array]) -> Array:  # NumPy: the number of runs varies, and nothing may compile for it
        return jax.device_put(np.concatenate([np.asarray(a) for a in arrays]))

    return replace(
        posteriors[-1],
        positions=joined([p.positions for p in posteriors]),
        log_weights=jax.device_put(log_weights.astype(np.float32)),
        log_likelihoods=jax.device_put(values),
        log_density=joined([p.log_density for p in posteriors]),
        population=jax.device_put(population.astype(np.int32)),
        log_evidence=jax.device_put(np.float32(log_evidence)),
        log_evidence_se=jax.device_put(np.float32(spread)),
        diagnostics=replace(
            every[-1],
            divergences=summed([d.divergences for d in every]),
            r_hat=jax.device_put(np.float32(split_r_hat(by_population[share > -np.inf]))),
            ess=jax.device_put(np.float32(1.0 / np.sum(np.exp(2.0 * log_weights)))),
            ancestors=summed([d.ancestors for d in every]),
            stages=summed([d.stages for d in every]),
            point_gradients=summed([d.point_gradients for d in every]),
            beta=joined([d.beta for d in every]),
            log_evidences=jax.device_put(estimates.astype(np.float32)),
        ),
    )


def start_from(before: Posterior, populations: int) -> tuple[Float[Array, "m n d"], Float[Array, "m n"]]:
    """The samples of tempered SMC as starts of another run: positions per population, and log-densities there.

    By each population's own estimate of its evidence, so that the estimates go on from where they were, and populations
    keep their shares. Where there were more than `populations`, several stand together as one. Raises ValueError if
    they do not divide.
    """
    m, size = len(before.diagnostics.beta), before.positions.shape[-1]
    if m % populations:
        raise ValueError(f"{m} populations of samples do not divide into {populations}")
    order = np.argsort(np.asarray(before.population), kind="stable")
    shape = (populations, len(order) // populations)
    positions, log_density = np.asarray(before.positions), np.asarray(before.log_density)  # so that nothing compiles
    starts = positions[order].reshape(*shape, size), log_density[order].reshape(shape)
    return jax.device_put(starts[0]), jax.device_put(starts[1])


def log_prior(q: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Log-density of N(0, I) at q, nats."""
    return -0.5 * jnp.sum(q * q + jnp.log(2 * jnp.pi), axis=-1)


def thin(posterior: Posterior, count: int) -> tuple[Int[np.ndarray, "s"], Float[np.ndarray, "s"], Int[np.ndarray, "s"]]:
    """(indices, weights f64, population) of `count` representative samples, or one a population where those are more.

    Each population that has any weight keeps an equal number of them, or the first ones one more, taken systematically
    by weight, and its own share of the weight: a planner sees each, and their disagreement is the Monte Carlo error.
    """
    log_w = np.asarray(posterior.log_weights, np.float64)
    population = np.asarray(posterior.population)
    names = np.unique(population[log_w > -np.inf])
    count = max(count, len(names))
    kept = count // len(names) + (np.arange(len(names)) < count % len(names))
    indices, weights = [], []
    for name, each in zip(names, kept, strict=True):
        members = np.flatnonzero(population == name)
        w = np.exp(log_w[members] - log_w[members].max())
        share = np.exp(log_w[members]).sum()
        levels = (np.arange(each) + 0.5) / each
        indices.append(np.quantile(members, levels, weights=w, method="inverted_cdf"))
        weights.append(np.full(each, share / each))
    w = np.concatenate(weights)
    w = w / w.sum() if w.sum() > 0 else np.full(len(w), 1.0 / len(w))
    return np.concatenate(indices), w, np.repeat(names, kept)
