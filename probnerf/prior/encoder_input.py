"""The encoder's input: the camera's numbers, and an image whose pixels carry their place in the object frame."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.mlp import encode, with_radius
from probnerf.prior.networks import POINT_OCTAVES

ENCODER_RADIUS = 1.25  # the encoder's picture shows this much around the cube's centre, in cube units


def camera_features(T_object_camera: Float[Array, "4 4"], tan_half_fov: Float[Array, ""]) -> Float[Array, "13"]:
    """The camera's numbers for the encoder: rotation, a fifth of its position, the tangent of its half field."""
    return jnp.concatenate(
        [T_object_camera[:3, :3].reshape(-1), 0.2 * T_object_camera[:3, 3], jnp.atleast_1d(tan_half_fov)]
    )


def encoder_image(
    rgb: Float[Array, "s s 3"],
    distance: Float[Array, "s s"],
    unknown: Float[Array, "s s"],
    T_object_camera: Float[Array, "4 4"],
    tan_half_fov: Float[Array, ""],
) -> Float[Array, "c s s"]:
    """Channels first: masked colour, masks (object, unknown, range), and where each pixel lies in the object frame.

    Range becomes a point in canonical coordinates, so that the network need not learn to turn views: pooled features
    say what is where, whatever the camera. Without range (distance < 0 marks an object pixel without one) they are 0.
    """
    size = rgb.shape[0]
    known = unknown < 0.5
    mask = (distance != 0.0) & known
    pixel = ((jnp.arange(size) + 0.5) / (0.5 * size) - 1.0) * tan_half_fov
    v, u = jnp.meshgrid(pixel, pixel, indexing="ij")
    rays = jnp.stack([u, v, jnp.ones_like(u)], axis=-1)
    rays = rays / jnp.linalg.norm(rays, axis=-1, keepdims=True) @ T_object_camera[:3, :3].T
    points = T_object_camera[:3, 3] + distance[..., None] * rays
    has_point = mask & (distance > 0.0)
    place = with_radius(jnp.where(has_point[..., None], points, 0.0).reshape(-1, 3).T)
    encoded = encode(place, POINT_OCTAVES).reshape(-1, size, size)
    return jnp.concatenate(
        [
            (jnp.moveaxis(rgb, -1, 0) - 0.5) * mask,
            jnp.stack([mask, ~known, has_point]).astype(jnp.float32),
            encoded * has_point,
        ]
    )
