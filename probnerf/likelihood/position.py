"""The position vector that samplers move, split into its parts.

A position is a flat vector [z~ (K) | a, b, x, y, log-scale, range offset, z (7, if the pose is unknown) | delta (D, if
`sample_delta`)]. Each entry has the prior N(0, 1). So every model has the same log prior, and tempering multiplies the
log-likelihood by one number.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.base import Model
from probnerf.likelihood.settings import Likelihood
from probnerf.types import POSE_SIZE, Pose


def pose_of(latent: Float[Array, "7"], pose_sigma: Float[Array, "5"]) -> Pose:
    """yaw = atan2(b, a); x, y, log-scale and z are standard normals times perception's widths."""
    a, b = latent[..., 0], latent[..., 1]
    # atan2 has no gradient at the origin, which has measure zero but can occur in float32
    at_origin = (a * a + b * b) < 1e-12
    yaw = jnp.arctan2(b, jnp.where(at_origin, 1.0, a))
    x, y, log_scale = (latent[..., 2 + i] * pose_sigma[i] for i in range(3))
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
        pose = pose_of(position[k : k + POSE_SIZE], pose_sigma)
    if likelihood.sample_delta:
        weights = weights + likelihood.delta_scale * position[-weights.shape[0] :]  # w~ = w + sqrt(alpha) delta
    return weights, pose
