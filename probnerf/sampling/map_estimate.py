"""Maximum a posteriori (MAP) estimate of the shape, by Adam from several starts.

A point estimate expresses no uncertainty. It is a baseline that shows what the full posterior adds.
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
    """A short ascent from every start, then a full ascent from the best ones."""

    screen_steps: int = 50  # Adam steps from every start
    survivors: int = 4  # number of best starts that continue for `steps`


@partial(jax.jit, static_argnames="config")
def map_estimate(
    model: Model,
    likelihood: Likelihood,
    observation: Observation,
    starts: Float[Array, "p d"],
    config: MAPConfig,
) -> tuple[Float[Array, "d"], Float[Array, "survivors"]]:
    """The best position that Adam reaches from the starts, and the survivors' log posteriors, best first."""
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))

    def climb(q: Float[Array, "p d"], steps: int) -> tuple[Array, Array]:
        q, _ = ascend(log_posterior, args, q, replace(config, steps=steps))
        values = log_posterior(args, None, q)
        order = jnp.argsort(-jnp.where(jnp.isfinite(values), values, -jnp.inf))[: config.survivors]
        return q[order], values[order]

    q, values = climb(climb(starts, config.screen_steps)[0], config.steps)
    return q[0], values
