"""One best shape: maximum a posteriori (MAP) by Adam from several starts.

A point estimate has no weights and no doubt: beside the posterior it shows what uncertainty is worth. The same ascent
reconstructs an object of known pose when a prior is judged.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from probnerf.model import Likelihood, Model, faces_of_view, log_likelihood
from probnerf.types import Observation

# (shared arguments, this step's data, positions [p, d]) -> values [p]
Objective = Callable[[Any, Any, Array], Array]


@dataclass(frozen=True)
class MAPConfig:
    """Adam with a cosine schedule; rates are in units of the latents' prior standard deviation."""

    steps: int = 300
    learning_rate: float = 0.05
    final_learning_rate: float = 0.002
    screen_steps: int = 50  # of `map_estimate`: every start climbs so far,
    survivors: int = 4  # and the best so many go on for `steps`


@partial(jax.jit, static_argnames=("objective", "config"))
def ascend(
    objective: Objective, args: Any, start: Float[Array, "p d"], config: MAPConfig, batches: Any = None
) -> tuple[Float[Array, "p d"], Float[Array, "steps p"]]:
    """Maximise `objective` from each start; also its values before every step.

    `batches` is data with a leading axis of `steps`, one slice a step (a fresh subset of pixels, say), or None.
    Starts do not touch: Adam works entry by entry. A gradient that is not finite counts as 0.
    """
    schedule = optax.cosine_decay_schedule(
        config.learning_rate, config.steps, config.final_learning_rate / config.learning_rate
    )
    adam = optax.adam(schedule)

    def step(carry, batch):
        q, moments = carry

        def loss(q):
            values = objective(args, batch, q)
            return -jnp.sum(values), values

        gradient, values = jax.grad(loss, has_aux=True)(q)
        update, moments = adam.update(jnp.where(jnp.isfinite(gradient), gradient, 0.0), moments, q)
        return (optax.apply_updates(q, update), moments), values

    (q, _), values = jax.lax.scan(step, (start, adam.init(start)), batches, length=config.steps)
    return q, values


def log_posterior(args: tuple, _: None, positions: Float[Array, "p d"]) -> Float[Array, "p"]:
    """Log-likelihood plus log prior, up to a constant, in which the yaw is uniform.

    `args` are those of `model.log_likelihood`. The yaw's latents (a, b) are left out of the prior: only their angle
    means anything, and the density of N(0, I) over them would pull the best yaw into the origin, where it has none.
    """
    model, likelihood = args[:2]
    weigh = jnp.ones(positions.shape[-1])
    if likelihood.sample_pose:
        weigh = weigh.at[model.latent : model.latent + 2].set(0.0)
    return log_likelihood(args, positions) - 0.5 * jnp.sum(weigh * positions**2, axis=-1)


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
