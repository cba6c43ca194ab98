"""The position vector that samplers move, split into its parts.

A position is a flat vector [z~ (K) | a, b, x, y, log-scale, range offset, z (7, if the pose is unknown) | delta (D, if
`sample_delta`)]. Each entry has the prior N(0, 1). So every model has the same log prior, and tempering multiplies the
log-likelihood by one number.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.base import Model
from probnerf.likelihood.settings import Likelihood
from probnerf.settings import NO_TAILS, PoseTails
from probnerf.types import POSE_SIZE, Pose

STRAIGHT = 2.5  # standard normals beyond which tails grow no faster: scales stay finite wherever a chain may go


def stretched(latent: Float[Array, "... 3"], tails: PoseTails) -> Float[Array, "... 3"]:
    """x, y and log-scale in perception's widths, of standard normals: sinh(k u) / k, with k of `tails` by their signs.

    Near 0 it is u itself: the widths hold for most objects, and a few err by many of them. (Half of the sinh-arcsinh
    family of Jones and Pewsey 2009.)
    """
    k, bent = _growth(latent, tails), jnp.clip(latent, -STRAIGHT, STRAIGHT)
    return jnp.sinh(k * bent) / k + jnp.cosh(k * STRAIGHT) * (latent - bent)


def unstretched(widths: Float[Array, "... 3"], tails: PoseTails) -> Float[Array, "... 3"]:
    """The standard normals whose `stretched` is `widths`."""
    k = _growth(widths, tails)
    most = jnp.sinh(k * STRAIGHT) / k
    bent = jnp.clip(widths, -most, most)
    return jnp.arcsinh(k * bent) / k + (widths - bent) / jnp.cosh(k * STRAIGHT)


def log_stretch(latent: Float[Array, "... 3"], tails: PoseTails) -> Float[Array, "..."]:
    """Logarithm of the determinant of `stretched`."""
    bent = jnp.clip(latent, -STRAIGHT, STRAIGHT)
    return jnp.sum(jnp.log(jnp.cosh(_growth(latent, tails) * bent)), axis=-1)


def _growth(value: Float[Array, "... 3"], tails: PoseTails) -> Float[Array, "... 3"]:
    below, above = jnp.maximum(jnp.asarray(tails), 1e-3).T
    return jnp.where(value < 0.0, below, above)


def pose_of(latent: Float[Array, "... 7"], pose_sigma: Float[Array, "5"], tails: PoseTails = NO_TAILS) -> Pose:
    """yaw = atan2(b, a); x, y and log-scale are `stretched` normals, z a normal, times perception's widths."""
    a, b = latent[..., 0], latent[..., 1]
    # atan2 has no gradient at the origin, which has measure zero but can occur in float32
    at_origin = (a * a + b * b) < 1e-12
    yaw = jnp.arctan2(b, jnp.where(at_origin, 1.0, a))
    x, y, log_scale = jnp.moveaxis(stretched(latent[..., 2:5], tails) * pose_sigma[:3], -1, 0)
    return Pose(yaw=yaw, x=x, y=y, log_scale=log_scale, z=latent[..., 6] * pose_sigma[4])


def range_offset_of(
    model: Model, likelihood: Likelihood, position: Float[Array, "d"], pose_sigma: Float[Array, "5"]
) -> Float[Array, ""]:
    """Common offset of all ranges of a view, cube units: a depth camera's bias, which averaging does not remove.

    Without it, a range bias would shift the hidden back wall, with false confidence.
    """
    return position[model.latent + 5] * pose_sigma[3] if likelihood.sample_pose else jnp.zeros(())


def split_position(
    model: Model,
    likelihood: Likelihood,
    position: Float[Array, "d"],
    pose_sigma: Float[Array, "5"],
    decoded: Float[Array, "w"] | None = None,
) -> tuple[Float[Array, "w"], Pose | None]:
    """Field weights w~ and pose of one position; `decoded` is its `model.decode`, if already computed."""
    k = model.latent
    weights = model.decode(position[:k]) if decoded is None else decoded
    pose = None
    if likelihood.sample_pose:
        pose = pose_of(position[k : k + POSE_SIZE], pose_sigma, likelihood.pose_tails)
    if likelihood.sample_delta:
        weights = weights + likelihood.delta_scale * position[-weights.shape[0] :]  # w~ = w + sqrt(alpha) delta
    return weights, pose
