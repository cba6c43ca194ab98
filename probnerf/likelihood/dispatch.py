"""log p(observation | position) for a batch of positions: by the kernel if it was built, else in plain JAX."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from probnerf.fields.base import Field, Model
from probnerf.fields.mlp import MLPField
from probnerf.kernel import library
from probnerf.likelihood import kernel_call
from probnerf.likelihood.pixel_terms import log_likelihood_one, pixel_terms
from probnerf.likelihood.position import range_offset_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.rendering import foam
from probnerf.types import Observation, Pose


def density_at(
    field: Field, weights: Float[Array, "w"], pose: Pose | None, points: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """Window x density at points of the view frame. If the kernel was built, it is used, and there is no gradient."""
    if isinstance(field, MLPField) and library.available():
        row = _row(pose, jnp.zeros(()))
        return kernel_call.density(field, weights[None], row[None], points.reshape(-1, 3)).reshape(points.shape[:-1])
    moved = points if pose is None else pose.to_object(points)
    return field.density(weights, moved) * foam.window(moved)


def weighted_terms(
    field: Field,
    weights: Float[Array, "w"],
    pose: Pose,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "n m"],
    pixel_weight: Float[Array, "n"],
) -> Float[Array, ""]:
    """Sum of `pixel_weight` x `pixel_terms`, differentiable in `weights` only. Uses the kernel if built."""
    if isinstance(field, MLPField) and library.available():
        row = _row(pose, jnp.zeros(()))
        return kernel_call.view_terms(field, likelihood, observation, t, weights[None], row[None], pixel_weight)[0]
    return jnp.sum(pixel_weight * pixel_terms(field, weights, pose, likelihood, observation, t))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def map_with_gradient(
    function: Callable, batch_size: int | None, shared: Any, each: Any, x: PyTree[Array]
) -> Float[Array, "p"]:
    """[function(shared, each_p, x_p) for p], differentiable in `x` only.

    Value and gradient of an element are computed together, `batch_size` elements at a time (None: one by one). So
    memory does not grow with the batch, and the rays of one element fit in a CPU's caches.
    """
    return jax.lax.map(lambda item: function(shared, *item), (each, x), batch_size=batch_size)


def _map_forward(function, batch_size, shared, each, x):
    def one(item):
        return jax.value_and_grad(lambda v: function(shared, item[0], v))(item[1])

    values, gradients = jax.lax.map(one, (each, x), batch_size=batch_size)
    return values, gradients


def _map_backward(function, batch_size, gradients, cotangent):
    return None, None, jax.tree.map(lambda g: g * cotangent.reshape(-1, *([1] * (g.ndim - 1))), gradients)


map_with_gradient.defvjp(_map_forward, _map_backward)


def log_likelihood(
    args: tuple[Model, Likelihood, Observation, Float[Array, "... n m"]], positions: Float[Array, "p d"]
) -> Float[Array, "p"]:
    """Batched log-likelihood for the samplers; differentiable in `positions` only.

    Where the observation has k choices of pixels, each p / k positions in a row are given another choice, in order.

    If the kernel was built, it evaluates an `MLPField`, with the particles distributed over threads. Otherwise they are
    distributed over JAX's devices if their number is divisible. JAX evaluates one particle at a time per device, so a
    CPU should count as several devices (`JAX_NUM_CPU_DEVICES`).
    """
    if isinstance(args[0].field, MLPField) and library.available():
        return _fused(args, positions)
    return plain_log_likelihood(args, positions)


def _fused(args, positions):
    model, likelihood, observation, t = args

    def drawn(position):
        weights, pose = split_position(model, likelihood, position, observation.pose_sigma)
        return weights, _row(pose, range_offset_of(model, likelihood, position, observation.pose_sigma))

    weights, pose = jax.vmap(drawn)(positions)
    return likelihood.power * kernel_call.view_terms(model.field, likelihood, observation, t, weights, pose)


def _row(pose: Pose | None, offset: Float[Array, ""]) -> Float[Array, "6"]:
    """A pose and the range offset in the kernel's format."""
    place = jnp.zeros(5) if pose is None else jnp.stack([pose.yaw, pose.x, pose.y, pose.log_scale, pose.z])
    return jnp.append(place, offset)


def plain_log_likelihood(
    args: tuple[Model, Likelihood, Observation, Float[Array, "... n m"]], positions: Float[Array, "p d"]
) -> Float[Array, "p"]:
    """`log_likelihood` in JAX only: the kernel's reference, and its replacement if there is no kernel."""

    def mapped(args, choice, positions):
        # decode as one batch: one by one, each particle would read all of the hypernetwork's weights from memory
        decoded = jax.vmap(args[0].decode)(positions[:, : args[0].latent])
        return map_with_gradient(_one_particle, None, args, choice, (positions, decoded))

    devices, count = jax.devices(), positions.shape[0]
    if count % args[2].choices:
        raise ValueError(f"{args[2].choices} choices of pixels do not divide {count} positions")
    choice = jnp.arange(count) // max(count // args[2].choices, 1)
    if len(devices) == 1 or count % len(devices):
        return mapped(args, choice, positions)
    mesh = jax.sharding.Mesh(np.array(devices), ("particles",))
    whole, split = jax.sharding.PartitionSpec(), jax.sharding.PartitionSpec("particles")
    shared = jax.shard_map(mapped, mesh=mesh, in_specs=(whole, split, split), out_specs=split, check_vma=False)
    return shared(args, choice, positions)


def _one_particle(args, choice, particle):
    model, likelihood, observation, t = args
    if t.ndim > 2:
        observation, t = observation.chosen(choice), t[choice]
    return log_likelihood_one(model, likelihood, observation, t, *particle)
