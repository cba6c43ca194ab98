"""One best shape: maximum a posteriori (MAP) by Adam from several starts.

A point estimate has no weights and no doubt: beside the posterior it shows what uncertainty is worth.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.base import Model
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.sampling.ascent import ascend
from probnerf.sampling.modes import log_posterior
from probnerf.settings import AdamConfig
from probnerf.types import Observation


@dataclass(frozen=True)
class MAPConfig(AdamConfig):
    """A short climb from every start, and a whole one of the best."""

    screen_steps: int = 50  # every start climbs so far,
    survivors: int = 4  # and the best so many go on for `steps`


@partial(jax.jit, static_argnames="config")
def map_estimate(
    model: Model,
    likelihood: Likelihood,
    observation: Observation,
    starts: Float[Array, "p d"],
    config: MAPConfig,
) -> tuple[Float[Array, "d"], Float[Array, "survivors"]]:
    """The best position that Adam reaches from the starts, and the log posterior of each survivor, best first."""
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))

    def climb(q: Float[Array, "p d"], steps: int) -> tuple[Array, Array]:
        q, _ = ascend(log_posterior, args, q, replace(config, steps=steps))
        values = log_posterior(args, None, q)
        order = jnp.argsort(-jnp.where(jnp.isfinite(values), values, -jnp.inf))[: config.survivors]
        return q[order], values[order]

    q, values = climb(climb(starts, config.screen_steps)[0], config.steps)
    return q[0], values
