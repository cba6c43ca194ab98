"""The encoder's guesses of an object at given yaws. Gradient ascents start from them (`probnerf.sampling.modes`).

The encoder needs the camera pose in the canonical object frame. That depends on the unknown yaw.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.compile_cache import program
from probnerf.prior.encoder_input import camera_features, encoder_image
from probnerf.prior.networks import ProbNeRF
from probnerf.types import POSE_SIZE, Pose, on_device


class EncoderPicture(eqx.Module):
    """The encoder's picture: a square view of the cube by a camera that looks at its centre (view frame)."""

    rgb: Float[Array, "s s 3"]  # in [0, 1]
    distance: Float[Array, "s s"]  # along the ray; 0: not the object, -1: the object at an unknown range
    unknown: Float[Array, "s s"]  # 1 if the pixel is not informative
    T_view_camera: Float[Array, "4 4"]
    tan_half_fov: Float[Array, ""]


def potential_at(model: ProbNeRF, picture: EncoderPicture, pose: Pose) -> tuple[Array, Array]:
    """Mean and precision of q(z | picture) if the object stood at `pose`."""
    T = picture.T_view_camera
    position = pose.to_object(T[:3, 3])
    rotation = pose.to_object_direction(T[:3, :3].T).T
    T_object_camera = jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(position)
    distance = picture.distance * jnp.exp(-pose.log_scale)
    image = encoder_image(picture.rgb, distance, picture.unknown, T_object_camera, picture.tan_half_fov)
    return model.encoder(image[None], camera_features(T_object_camera, picture.tan_half_fov)[None], jnp.ones(1))


def even_yaws(count: int) -> Float[np.ndarray, "count"]:
    """Evenly spaced yaws in radians, from -pi."""
    return (np.arange(count) * (2.0 * np.pi / count) - np.pi).astype(np.float32)


def encoder_positions(
    key: PRNGKeyArray, model: ProbNeRF, picture: EncoderPicture, yaws: Float[np.ndarray, "y"], draws: int, spread: float
) -> Float[Array, "y_draws d"]:
    """Positions with z = mean + spread N(0, 1 / precision) of the encoder at the given yaws, `draws` at each.

    The rest of the pose is perception's guess.
    """
    return _encoder_positions(key, model, picture, on_device(yaws), draws, spread)


def guesses(
    key: PRNGKeyArray, model: ProbNeRF, picture: EncoderPicture, count: int, sample_pose: bool = True
) -> Float[Array, "count d"]:
    """Starts of ascents: the encoder's means at even yaws. If the pose is known, its draws there."""
    if sample_pose:
        return encoder_positions(key, model, picture, even_yaws(count), 1, 0.0)
    return encoder_positions(key, model, picture, np.zeros(1, np.float32), count, 1.0)[:, : model.latent]


@program("draws")
def _encoder_positions(
    key: PRNGKeyArray, model: ProbNeRF, picture: EncoderPicture, yaws: Float[Array, "y"], draws: int, spread: float
) -> Float[Array, "y_j d"]:
    zero = jnp.zeros(())
    noise = jax.random.normal(key, (len(yaws), draws, model.latent))

    def at(yaw: Array, noise: Array) -> Array:
        mean, precision = potential_at(model, picture, Pose(yaw, zero, zero, zero, zero))
        z = mean + spread * noise / jnp.sqrt(precision)
        return jax.vmap(lambda one: model.flow.inverse(one)[0])(z)

    z_tilde = jax.vmap(at)(yaws, noise)
    pose = jnp.zeros((*noise.shape[:2], POSE_SIZE))
    pose = pose.at[..., 0].set(jnp.cos(yaws)[:, None]).at[..., 1].set(jnp.sin(yaws)[:, None])
    return jnp.concatenate([z_tilde, pose], axis=-1).reshape(-1, noise.shape[-1] + POSE_SIZE)
