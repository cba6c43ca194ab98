"""The pixel likelihood of an `MLPField` and its gradient as one fused CPU operation (`probnerf/kernel`), from JAX.

The same function as `probnerf.model.pixel_terms` summed over pixels, without anything of size points x width stored.
"""

import ctypes
import os
from functools import cache, partial
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from probnerf.field import MLPField
from probnerf.kernel.build import LIBRARY
from probnerf.types import Observation

if TYPE_CHECKING:
    from probnerf.model import Likelihood

TARGET = "farside_view_terms"


@cache
def available() -> bool:
    """Whether the kernel was built and JAX runs on the CPU; `FARSIDE_KERNEL=0` says no."""
    if os.environ.get("FARSIDE_KERNEL") == "0" or not LIBRARY.is_file() or jax.default_backend() != "cpu":
        return False
    library = ctypes.CDLL(str(LIBRARY))
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(library.FarsideViewTerms), platform="cpu")
    return True


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def view_terms(
    field: MLPField,
    likelihood: "Likelihood",
    observation: Observation,
    t: Float[Array, "n m"],
    weights: Float[Array, "p w"],
    pose: Float[Array, "p 6"],
) -> Float[Array, "p"]:
    """log p(pixels | weights_p, pose_p) for each particle, differentiable in `weights` and `pose`.

    `pose` is yaw, x, y, log-scale, z and the ranges' common offset. The likelihood's `power` is not applied.
    """
    return call(field, likelihood, observation, t, weights, pose)[0]


def call(
    field: MLPField,
    likelihood: "Likelihood",
    observation: Observation,
    t: Float[Array, "n m"],
    weights: Float[Array, "p w"],
    pose: Float[Array, "p 6"],
    threads: int | None = None,
    isa: str = "",
) -> tuple[Float[Array, "p"], Float[Array, "p w"], Float[Array, "p 6"]]:
    """(values, gradients by weights, gradients by pose); `isa` is avx512, avx2 or plain ("": the machine's best)."""
    p = weights.shape[0]
    shapes = [(p,), weights.shape, (p, 6)]
    operation = jax.ffi.ffi_call(TARGET, [jax.ShapeDtypeStruct(s, jnp.float32) for s in shapes])
    flags = [a.astype(jnp.int32) for a in (observation.status, observation.rgb_valid, observation.range_valid)]
    pixels = (observation.rgb, observation.range, observation.range_sigma, observation.limit)
    sizes = {
        "width": field.width,
        "octaves": field.octaves,
        "direction_octaves": field.direction_octaves,
        "radial": field.radial,
        "fitted": field.fitted,
        "colour_count": observation.colour_count,
        "threads": threads or os.cpu_count() or 1,
    }
    numbers = {
        "density_scale": field.density_scale,
        "mask_error": likelihood.mask_error,
        "outlier": likelihood.outlier,
        "outlier_span": likelihood.outlier_span,
        "wall_sigma": likelihood.wall_sigma,
        "colour_sigma": likelihood.colour_sigma,
        "per_density": 1.0 / likelihood.lattice.cubes,
    }
    given = (weights, pose, observation.rays.origin, observation.rays.direction, t, *pixels)
    values, g_weights, g_pose = operation(
        *(a.astype(jnp.float32) for a in given),
        *flags,
        **{name: np.int32(value) for name, value in sizes.items()},
        **{name: np.float32(value) for name, value in numbers.items()},
        isa=isa,
    )
    return values, g_weights, g_pose


def _forward(field, likelihood, observation, t, weights, pose):
    values, g_weights, g_pose = call(field, likelihood, observation, t, weights, pose)
    return values, (g_weights, g_pose)


def _backward(field, gradients, cotangent):
    g_weights, g_pose = gradients
    return None, None, None, g_weights * cotangent[:, None], g_pose * cotangent[:, None]


view_terms.defvjp(_forward, _backward)
