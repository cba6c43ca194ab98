"""Importance sampling of the posterior from a density that covers it, and whether its weights are answer enough.

They are if the effective sample size is large, the weights' tail is light (`pareto_tail`), and the even and the odd
draws estimate the same evidence. Where few weights count, tempering from the same density goes on instead.
"""

from dataclasses import dataclass
from functools import cached_property
from time import monotonic
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.compile_cache import program
from probnerf.sampling.hmc import LogLikelihood, Reference, Target
from probnerf.sampling.pareto_tail import pareto_k
from probnerf.sampling.populations import from_draws
from probnerf.settings import NetworkConfig
from probnerf.types import Posterior, StopReason

_WIDTH = 64  # draws evaluated at a time: as many as tempering evaluates, so no more memory
_GROUPS = 8  # of draws, as populations of the answer


class Covering(Reference, Protocol):
    """A density that covers the posterior."""

    def log_density(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log-density, nats."""
        ...


@dataclass(frozen=True, eq=False)
class WeighedDraws:
    """Draws of a density q, each with the weight prior x likelihood / q."""

    positions: Float[np.ndarray, "n d"]
    log_likelihoods: Float[np.ndarray, "n"]  # -inf where the likelihood is not finite
    log_density: Float[np.ndarray, "n"]  # log q
    log_weights: Float[np.ndarray, "n"]  # not normalised: their mean estimates the evidence

    @cached_property
    def ess(self) -> float:
        """Effective sample size of the weights, (sum w)^2 / sum w^2; 0 if all are 0."""
        top = self.log_weights.max()
        if not np.isfinite(top):
            return 0.0
        w = np.exp(self.log_weights - top)
        return float(w.sum() ** 2 / (w @ w))

    @cached_property
    def k(self) -> float:
        """Shape of the weights' tail (NaN: not defined)."""
        return pareto_k(self.log_weights)

    @property
    def apart(self) -> float:
        """Difference between the log-evidences that the even and the odd draws estimate, nats; inf if one has none."""
        even, odd = self._log_evidences(2)
        return float(abs(even - odd)) if np.isfinite(even) and np.isfinite(odd) else float("inf")

    def suffice(self, config: NetworkConfig) -> bool:
        """Whether the weights are answer enough. A tail that cannot be fitted is not."""
        return self.ess >= config.enough_ess and self.k < config.largest_k and self.apart <= config.apart

    def posterior(self) -> Posterior:
        """The weighted draws as an answer at beta = 1."""
        log_evidence, count = self._log_evidences(1)[0], len(self.log_weights)
        return from_draws(
            jax.device_put(self.positions),
            self.log_weights - log_evidence - np.log(count),
            self.log_likelihoods,
            self.log_density,
            _GROUPS,
            self._log_evidences(_GROUPS),
            float(log_evidence),
            float(np.sqrt(max(1.0 / self.ess - 1.0 / count, 0.0))),
            beta=1.0,
            result=StopReason.CONVERGED,
        )

    def _log_evidences(self, groups: int) -> Float[np.ndarray, "m"]:
        """Log of the mean weight of every `groups`-th draw."""
        each = self.log_weights.reshape(-1, groups)
        return np.logaddexp.reduce(each, axis=0) - np.log(len(each))


@program("log_likelihood", "count")
def _chunk(key, args, density, *, log_likelihood: LogLikelihood, count: int):
    """Draws of a density, log-likelihood, log q and log of q over the prior at each."""
    position = density.draw(key, count)
    target = Target(log_likelihood, args, jnp.zeros(()))
    value = jax.lax.map(target.value, position.reshape(-1, _WIDTH, position.shape[1])).reshape(-1)
    return position, value, density.log_density(position), density.over_prior(position)


def weigh(
    key: PRNGKeyArray,
    log_likelihood: LogLikelihood,
    args: Any,
    density: Covering,
    config: NetworkConfig,
    deadline: float | None = None,
) -> WeighedDraws:
    """Weigh draws of `density`, a chunk at a time, until they suffice, or cannot with as many as are allowed.

    The effective sample size grows with the number of draws. So it ends where at this rate `config.most` draws do not
    have enough, or where the next chunk would pass the deadline, on the clock of time.monotonic().
    """
    chunks: list[list[np.ndarray]] = []
    while True:
        begun = monotonic()
        number = jax.random.fold_in(key, len(chunks))
        chunk = _chunk(number, args, density, log_likelihood=log_likelihood, count=config.chunk)
        chunks.append([np.asarray(a) for a in chunk])
        positions, values, log_q, over = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        log_w = np.asarray(values, np.float64) - over
        draws = WeighedDraws(positions, values, log_q, log_w)
        ends = monotonic()
        late = deadline is not None and ends + (ends - begun) > deadline
        full = len(log_w) + config.chunk > config.most
        if draws.suffice(config) or draws.ess * config.most < config.enough_ess * len(log_w) or full or late:
            return draws
