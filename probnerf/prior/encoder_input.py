"""The encoder's input: camera features, and an image with each pixel's position in the object frame."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.mlp import encode, with_radius
from probnerf.prior.networks import POINT_OCTAVES

ENCODER_RADIUS = 1.25  # half width of the encoder's picture at the cube's centre, cube units


def camera_features(T_object_camera: Float[Array, "4 4"], tan_half_fov: Float[Array, ""]) -> Float[Array, "13"]:
    """Camera features for the encoder: rotation, position times 0.2, tangent of the half field of view."""
    return jnp.concatenate(
        [T_object_camera[:3, :3].reshape(-1), 0.2 * T_object_camera[:3, 3], jnp.atleast_1d(tan_half_fov)]
    )


def pixel_directions(
    size: int, T_object_camera: Float[Array, "4 4"], tan_half_fov: Float[Array, ""]
) -> Float[Array, "s s 3"]:
    """Unit directions, in the object frame, of the rays through a square picture's pixels."""
    pixel = ((jnp.arange(size) + 0.5) / (0.5 * size) - 1.0) * tan_half_fov
    v, u = jnp.meshgrid(pixel, pixel, indexing="ij")
    rays = jnp.stack([u, v, jnp.ones_like(u)], axis=-1)
    return rays / jnp.linalg.norm(rays, axis=-1, keepdims=True) @ T_object_camera[:3, :3].T


def encoder_image(
    rgb: Float[Array, "s s 3"],
    distance: Float[Array, "s s"],
    unknown: Float[Array, "s s"],
    T_object_camera: Float[Array, "4 4"],
    tan_half_fov: Float[Array, ""],
) -> Float[Array, "c s s"]:
    """Channels first: masked colour, masks (object, unknown, range), and each pixel's position in the object frame.

    Each range becomes a point in canonical coordinates. So the network need not learn to rotate views, and pooled
    features do not depend on the camera. A pixel without a range has zeros. `distance` is negative for an object pixel
    without a range.
    """
    size = rgb.shape[0]
    known = unknown < 0.5
    mask = (distance != 0.0) & known
    rays = pixel_directions(size, T_object_camera, tan_half_fov)
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
