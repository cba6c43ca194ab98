"""An `MLPField`'s pixel likelihood with its gradient, and its density, as fused CPU operations (`probnerf/kernel`).

They compute the sum of `pixel_terms.pixel_terms` over pixels, and `dispatch.density_at`. They store no array of size
points x width.
"""

import os
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from probnerf.fields.mlp import MLPField
from probnerf.kernel.library import DENSITY, VIEW_TERMS
from probnerf.likelihood.settings import Likelihood
from probnerf.types import Observation


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def view_terms(
    field: MLPField,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "... n m"],
    weights: Float[Array, "p w"],
    pose: Float[Array, "p 6"],
    pixel_weight: Float[Array, "... n"] | None = None,
) -> Float[Array, "p"]:
    """Sum of w_i log p(pixel i | weights_p, pose_p) for each particle, differentiable in `weights` and `pose`.

    `pose` is yaw, x, y, log-scale, z and the common offset of all ranges. w is `pixel_weight`, or 1. The likelihood's
    `power` is not applied. Without differentiation, only the forward pass runs. Where the observation has several
    choices of pixels, the particles are divided among them in blocks of equal size.
    """
    return call(field, likelihood, observation, t, weights, pose, pixel_weight, gradients=False)[0]


def call(
    field: MLPField,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "... n m"],
    weights: Float[Array, "p w"],
    pose: Float[Array, "p 6"],
    pixel_weight: Float[Array, "... n"] | None = None,
    threads: int | None = None,
    isa: str = "",
    gradients: bool = True,
) -> tuple[Float[Array, "p"], Float[Array, "p w"], Float[Array, "p 6"]]:
    """(values, gradients by weights, gradients by pose). `isa` is avx512, avx2 or plain ("": the best available).

    Without `gradients`, the gradient arrays are empty, [0, w] and [0, 6]. If there are fewer particles than threads,
    several threads share a particle, and their number changes the rounding. Otherwise the number has no effect.
    """
    p, w = weights.shape
    shapes = [(p,), (gradients * p, w), (gradients * p, 6)]
    operation = jax.ffi.ffi_call(VIEW_TERMS, [jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes])
    flags = [a.astype(jnp.int32) for a in (observation.status, observation.rgb_valid, observation.range_valid)]
    weight = jnp.ones(t.shape[:-1]) if pixel_weight is None else pixel_weight
    pixels = (observation.rgb, observation.range, observation.range_sigma, observation.limit, weight)
    numbers = {
        "mask_error": likelihood.mask_error,
        "outlier": likelihood.outlier,
        "outlier_span": likelihood.outlier_span,
        "wall_sigma": likelihood.wall_sigma,
        "colour_sigma": likelihood.colour_sigma,
        "per_density": 1.0 / likelihood.lattice.cubes,
    }
    inputs = (weights, pose, observation.rays.origin, observation.rays.direction, t, *pixels)
    values, g_weights, g_pose = operation(
        *(a.astype(jnp.float32) for a in inputs),
        *flags,
        **{name: np.float32(value) for name, value in numbers.items()},
        colour_count=np.int32(observation.colour_count),
        choices=np.int32(observation.choices),
        **_how(field, threads, isa),
    )
    return values, g_weights, g_pose


def _how(field: MLPField, threads: int | None, isa: str) -> dict[str, Any]:
    names = ("width", "octaves", "direction_octaves", "radial", "fitted")
    sizes = {name: np.int32(getattr(field, name)) for name in names}
    return {
        "field": {**sizes, "density_scale": np.float32(field.density_scale)},
        "threads": np.int32(threads or os.cpu_count() or 1),
        "isa": isa,
    }


def density(
    field: MLPField,
    weights: Float[Array, "p w"],
    pose: Float[Array, "p 6"],
    points: Float[Array, "n 3"],
    threads: int | None = None,
    isa: str = "",
) -> Float[Array, "p n"]:
    """Window x density of each particle at points of the view frame; not differentiable. See `call` for `pose`, `isa`.

    Points outside the window cost nothing. The result does not depend on the number of threads.
    """
    found = jax.ShapeDtypeStruct((weights.shape[0], points.shape[0]), jnp.float32)
    inputs = (a.astype(jnp.float32) for a in (weights, pose, points))
    return jax.ffi.ffi_call(DENSITY, found)(*inputs, **_how(field, threads, isa))


def _forward(field, likelihood, observation, t, weights, pose, pixel_weight):
    values, g_weights, g_pose = call(field, likelihood, observation, t, weights, pose, pixel_weight)
    return values, (g_weights, g_pose)


def _backward(field, gradients, cotangent):
    g_weights, g_pose = gradients
    return None, None, None, g_weights * cotangent[:, None], g_pose * cotangent[:, None], None


view_terms.defvjp(_forward, _backward)
