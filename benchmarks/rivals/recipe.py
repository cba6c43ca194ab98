"""How a rival is trained: phases, each with a step that runs inside `jit`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from benchmarks.rivals.volume import Pictures

State = Any  # a tree of arrays: the model, its optimisers' states
Metrics = dict[str, Array]  # scalars
M = TypeVar("M")

WARM_UP = 0.02  # of a phase's time


def _as_it_is(given: Any, *_: Any) -> Any:
    return given


@dataclass(frozen=True)
class Phase:
    """A part of a training run."""

    name: str
    step: Callable[[State, Pictures, Float[Array, ""], PRNGKeyArray], tuple[State, Metrics]]
    """Given the state, the pictures, the share of the phase's time that is over (0 to 1), and a key."""
    share: float = 1.0
    """Of the run's time."""
    prepare: Callable[[State, Pictures], State] = _as_it_is
    """What happens once, before the first step."""


@dataclass(frozen=True)
class Recipe:
    """A training run."""

    start: Callable[[PRNGKeyArray], State]
    """The state before the first phase."""
    phases: tuple[Phase, ...]
    """One after the other; their shares add up to 1."""
    model: Callable[[State], Any]
    """What is kept of a state, at any time."""
    quick: Callable[[Any], Any] = _as_it_is
    """The model, made to answer in less time when it is examined at the end of training."""


def optimiser() -> optax.GradientTransformation:
    """Adam on gradients of norm 1 at most, without a step size."""
    return optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam())


def rate(progress: Float[Array, ""], peak: float) -> Float[Array, ""]:
    """A step size that grows for `WARM_UP`, then falls as a cosine to zero."""
    return peak * jnp.minimum(1.0, (progress + 1e-3) / WARM_UP) * 0.5 * (1.0 + jnp.cos(jnp.pi * progress))


def descend(model: M, gradient: M, state: Any, size: Float[Array, ""]) -> tuple[M, Any]:
    """One step of `optimiser` of this size: the model and the optimiser's state after it."""
    updates, state = optimiser().update(gradient, state)
    return optax.apply_updates(model, jax.tree.map(lambda update: -size * update, updates)), state
