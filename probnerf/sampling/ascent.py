"""Gradient ascent from many starts at once: Adam on a batch of positions."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from probnerf.settings import AdamConfig

# (shared arguments, this step's data, positions [p, d]) -> values [p]
Objective = Callable[[Any, Any, Array], Array]


@partial(jax.jit, static_argnames=("objective", "config"))
def ascend(
    objective: Objective, args: Any, start: Float[Array, "p d"], config: AdamConfig, batches: Any = None
) -> tuple[Float[Array, "p d"], Float[Array, "steps p"]]:
    """Maximise `objective` from each start. Returns the final positions and the values before each step.

    `batches` is data with a leading axis of `steps`, one slice per step (for example a new subset of pixels), or None.
    The starts are independent, because Adam works element by element. A gradient entry that is not finite counts as 0.
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
