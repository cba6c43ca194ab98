"""Where particles start: a defensive mixture of the prior and of the encoder's guess at every yaw.

The encoder needs the camera in the canonical object frame, which the unknown pose turns; so a proposal first draws the
pose from its prior, then z~ given that pose: q(q) = share N(q; 0, I) + (1 - share) N(pose; 0, I) q(z~ | picture, pose).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.model import POSE_SIZE, Likelihood, pose_of
from probnerf.prior import ProbNeRF
from probnerf.types import Pose, identity_pose
from probnerf.views import camera_features, encoder_image


class Picture(eqx.Module):
    """What the encoder sees: a square view of the cube by a camera that looks at its centre (view frame)."""

    rgb: Float[Array, "s s 3"]  # in [0, 1]
    distance: Float[Array, "s s"]  # along the ray; 0: not the object, -1: the object, at an unknown range
    unknown: Float[Array, "s s"]  # 1 where the pixel says nothing
    T_view_camera: Float[Array, "4 4"]
    tan_half_fov: Float[Array, ""]


def potential_at(model: ProbNeRF, picture: Picture, pose: Pose, flatten: float) -> tuple[Array, Array]:
    """Mean and precision of q(z | picture) if the object stood at `pose`; `flatten` < 1 widens the Gaussian."""
    T = picture.T_view_camera
    position = pose.to_object(T[:3, 3])
    rotation = pose.to_object_direction(T[:3, :3].T).T
    T_object_camera = jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(position)
    distance = picture.distance * jnp.exp(-pose.log_scale)
    image = encoder_image(picture.rgb, distance, picture.unknown, T_object_camera, picture.tan_half_fov)
    mean, precision = model.encoder(
        image[None], camera_features(T_object_camera, picture.tan_half_fov)[None], jnp.ones(1)
    )
    return mean, precision * flatten


def _log_encoder(model: ProbNeRF, z_tilde: Array, mean: Array, precision: Array) -> Float[Array, ""]:
    """log q(z~): the Gaussian on z = m(z~), times |dz/dz~|."""
    z, log_det = model.flow.forward(z_tilde)
    return 0.5 * jnp.sum(jnp.log(precision) - jnp.log(2 * jnp.pi) - precision * (z - mean) ** 2) + log_det


def _log_normal(x: Array) -> Float[Array, ""]:
    return -0.5 * jnp.sum(x * x + jnp.log(2 * jnp.pi))


@eqx.filter_jit
def propose(
    key: PRNGKeyArray,
    model: ProbNeRF,
    likelihood: Likelihood,
    picture: Picture,
    pose_sigma: Float[Array, "5"],
    populations: int,
    count: int,
    prior_share: float = 0.25,
    flatten: float = 0.5,
    each: int = 8,
) -> tuple[Float[Array, "m n d"], Float[Array, "m n"]]:
    """Positions of `populations` x `count` starts and their log-density under the mixture.

    `each` starts share a pose, for the encoder is what costs: every one of them has the mixture's law.
    """
    k = model.latent
    dim = k + POSE_SIZE * likelihood.sample_pose

    def at_pose(key: PRNGKeyArray) -> tuple[Array, Array]:
        """`each` starts at one pose, and their log-densities."""
        pose_key, key = jax.random.split(key)
        place = jax.random.normal(pose_key, (dim - k,))
        pose = pose_of(place, pose_sigma) if likelihood.sample_pose else identity_pose()
        mean, precision = potential_at(model, picture, pose, flatten)

        def one(key: PRNGKeyArray) -> tuple[Array, Array]:
            k0, k1, k2 = jax.random.split(key, 3)
            guess, _ = model.flow.inverse(mean + jax.random.normal(k1, (k,)) / jnp.sqrt(precision))
            z_tilde = jnp.where(jax.random.uniform(k2) < prior_share, jax.random.normal(k0, (k,)), guess)
            log_z = jnp.logaddexp(
                jnp.log(prior_share) + _log_normal(z_tilde),
                jnp.log1p(-prior_share) + _log_encoder(model, z_tilde, mean, precision),
            )
            return jnp.concatenate([z_tilde, place]), log_z + _log_normal(place)

        return jax.vmap(one)(jax.random.split(key, each))

    poses = -(-count // each)
    q, log_q = jax.lax.map(at_pose, jax.random.split(key, populations * poses), batch_size=32)
    return q.reshape(populations, -1, dim)[:, :count], log_q.reshape(populations, -1)[:, :count]
