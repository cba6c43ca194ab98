"""Populations of samples: several runs as one posterior, samples as starts of another run, and representatives."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from probnerf.sampling.hmc import HMCState, split_r_hat
from probnerf.types import Diagnostics, Posterior, StopReason, on_device

# A population has failed if its log-evidence is more than this below the best one (nats): it never left a poor mode.
# Populations in different good modes differ by a few nats, mostly noise. On validation views this threshold made no
# answer worse. Below 30 nats, answers became overconfident.
FAILED = 100.0


def shares(
    log_evidences: Float[np.ndarray, "m"], power: float
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, ""] | float]:
    """Log of each population's share of the weight, from its evidence to a power; and log of the mean evidence.

    A failed population has no share. Without any finite evidence, the shares are equal. If an estimate is NaN, the
    shares are equal and the mean is NaN.
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
    """The pools [m, n, ...] of a run's last stages as one posterior. `others` holds the remaining diagnostics.

    `variance` is the variance of each log-evidence estimate, assuming that a population's particles are independent.
    """
    # NumPy, because the number of pools varies and must not cause a compilation.
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
    # log-density of the target r^(1 - beta) (prior x likelihood)^beta = prior x exp(f), normalised by its evidence
    f = (1.0 - beta[:, None]) * over + np.where(beta[:, None] > 0, beta[:, None] * values, 0.0)
    log_normal = -0.5 * np.sum(positions.astype(np.float64) ** 2 + np.log(2.0 * np.pi), axis=-1)
    with np.errstate(invalid="ignore"):  # every likelihood is zero
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


def from_draws(
    positions: Float[Array, "n d"],
    log_weights: Float[np.ndarray, "n"],
    log_likelihoods: Float[np.ndarray, "n"] | None = None,
    log_density: Float[np.ndarray, "n"] | None = None,
    groups: int = 1,
    log_evidences: Float[np.ndarray, "m"] | None = None,
    log_evidence: float = float("nan"),
    log_evidence_se: float = float("nan"),
    beta: float = 0.0,
    result: StopReason = StopReason.UNDERWAY,
) -> Posterior:
    """Independent draws of some density with normalised weights as a posterior. What is left out is NaN.

    Every `groups`-th draw is of one population, so that the spread of their answers tells the Monte Carlo error.
    """
    nan, zero, nans = on_device(np.nan), on_device(0, np.int32), np.full(len(log_weights), np.nan)
    evidences = np.full(groups, np.nan) if log_evidences is None else log_evidences
    ess, betas = on_device(1.0 / np.sum(np.exp(2.0 * log_weights))), on_device(np.full(groups, beta))
    return Posterior(
        positions=positions,
        log_weights=on_device(log_weights),
        log_likelihoods=on_device(nans if log_likelihoods is None else log_likelihoods),
        log_density=on_device(nans if log_density is None else log_density),
        population=on_device(np.arange(len(log_weights)) % groups, np.int32),
        log_evidence=on_device(log_evidence),
        log_evidence_se=on_device(log_evidence_se),
        diagnostics=Diagnostics(nan, zero, nan, ess, zero, zero, on_device(0.0), betas, on_device(evidences)),
        result=result,
    )


def with_log_likelihoods(posterior: Posterior, values: Float[np.ndarray, "s"]) -> Posterior:
    """The posterior with these log-likelihoods of its samples, and their R-hat."""
    population = np.asarray(posterior.population)
    r_hat = _r_hat(values, population, np.asarray(posterior.log_weights) > -np.inf)
    return replace(
        posterior,
        log_likelihoods=on_device(values),
        diagnostics=replace(posterior.diagnostics, r_hat=on_device(r_hat)),
    )


def _r_hat(values: Float[np.ndarray, "s"], population: Int[np.ndarray, "s"], weighed: Bool[np.ndarray, "s"]) -> float:
    """Split R-hat over the populations that have weight."""
    names = np.unique(population[weighed])
    return split_r_hat(np.stack([values[population == name] for name in names]))


def pooled(posteriors: Sequence[Posterior], evidence_power: float) -> Posterior:
    """Combine independent tempered SMC runs into one posterior with all their populations.

    All runs have reached beta = 1, on the same target and with the same sizes. Acceptance and `result` come from the
    last run. Counts are summed. The error of the evidence is estimated from the spread of the populations.
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
    every = [p.diagnostics for p in posteriors]

    def summed(counts: Sequence[Array]) -> Array:
        return jax.device_put(np.sum(np.stack([np.asarray(c) for c in counts]), axis=0))

    def joined(arrays: Sequence[Array]) -> Array:  # NumPy, as in `gathered`: the number of runs varies
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
            r_hat=on_device(_r_hat(values, population, log_weights > -np.inf)),
            ess=jax.device_put(np.float32(1.0 / np.sum(np.exp(2.0 * log_weights)))),
            ancestors=summed([d.ancestors for d in every]),
            stages=summed([d.stages for d in every]),
            point_gradients=summed([d.point_gradients for d in every]),
            beta=joined([d.beta for d in every]),
            log_evidences=jax.device_put(estimates.astype(np.float32)),
        ),
    )


def start_from(before: Posterior, populations: int) -> tuple[Float[Array, "m n d"], Float[Array, "m n"]]:
    """Samples of tempered SMC as starts of another run: positions per population, and the log-density at each.

    The log-density uses each population's own evidence estimate. So the new estimates continue the old ones, and the
    populations keep their shares. If there were more than `populations`, they are merged into groups. Raises ValueError
    if their number is not a multiple of `populations`.
    """
    m, size = len(before.diagnostics.beta), before.positions.shape[-1]
    if m % populations:
        raise ValueError(f"{m} populations of samples do not divide into {populations}")
    order = np.argsort(np.asarray(before.population), kind="stable")
    shape = (populations, len(order) // populations)
    positions, log_density = np.asarray(before.positions), np.asarray(before.log_density)  # NumPy: nothing compiles
    starts = positions[order].reshape(*shape, size), log_density[order].reshape(shape)
    return jax.device_put(starts[0]), jax.device_put(starts[1])


def log_prior(q: Float[Array, "... d"]) -> Float[Array, "..."]:
    """Log-density of N(0, I) at q, nats."""
    return -0.5 * jnp.sum(q * q + jnp.log(2 * jnp.pi), axis=-1)


def thin(posterior: Posterior, count: int) -> tuple[Int[np.ndarray, "s"], Float[np.ndarray, "s"], Int[np.ndarray, "s"]]:
    """(indices, weights f64, population) of `count` representative samples, but at least one per population.

    Only populations with non-zero weight count. Each keeps the same number of samples; the first ones keep one more if
    the division leaves a remainder. Samples are chosen systematically by weight. Each population keeps its share of the
    weight. So a planner sees every population, and their disagreement is the Monte Carlo error.
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
