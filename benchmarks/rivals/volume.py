"""Volume rendering by quadrature inside a box, and rays of pictures to train on."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

Box = tuple[float, float, float, float, float, float]  # low x y z, high x y z; cube units
RadianceField = Callable[[Array, Array], tuple[Array, Array]]  # points, directions [n 3] -> sigma [n], rgb [n 3]
MARGIN = 0.04  # of the box about what pictures show, cube units


@dataclass(frozen=True)
class FieldConfig:
    """Sizes of a field of conditioned blocks (`layers.ConditionedBlock`), and how it is trained."""

    box: Box
    """Outside is nothing."""
    tan_half_fov: float
    """Of all cameras."""
    width: int = 192
    blocks: int = 4
    octaves: int = 6
    """Of the points' encoding."""
    samples: int = 48
    """On a ray."""
    density_scale: float = 30.0
    """Per cube unit."""
    objects: int = 24
    """A step."""
    rays: int = 128
    """An object and step."""
    peak_rate: float = 1e-3
    """Of Adam."""


class Pictures(eqx.Module):
    """Pictures of objects on the device, to draw from inside `jit`."""

    rgb: UInt8[Array, "n v s s 3"]
    T_object_camera: Float[Array, "n v 4 4"]
    tan_half_fov: Float[Array, ""]
    frame: Int[Array, "n v 4"]  # the object's first row and column, and those after its last


class Rays(eqx.Module):
    """Rays through pixels, with what was seen there."""

    origin: Float[Array, "*n 3"]
    direction: Float[Array, "*n 3"]  # unit
    rgb: Float[Array, "*n 3"]
    weight: Float[Array, "*n"]  # a weighted mean over drawn rays is an unbiased mean over the pictures' pixels


def directions(
    T_object_camera: Float[Array, "*n 4 4"], tan_half_fov: Float[Array, ""], pixel: Float[Array, "*n 2"], size: int
) -> Float[Array, "*n 3"]:
    """Unit directions through places (column, row) of square pictures; a pixel's centre lies at +0.5."""
    image = (2.0 * pixel / size - 1.0) * tan_half_fov
    ray = jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)
    ray = ray / jnp.linalg.norm(ray, axis=-1, keepdims=True)
    return jnp.einsum("...ij,...j->...i", T_object_camera[..., :3, :3], ray)


def projected(
    T_object_camera: Float[Array, "4 4"], tan_half_fov: Float[Array, ""], points: Float[Array, "n 3"], size: int
) -> tuple[Float[Array, "n 2"], Float[Array, "n 3"]]:
    """Places (column, row) where points appear in a square picture, and the points in the camera's frame."""
    camera = (points - T_object_camera[:3, 3]) @ T_object_camera[:3, :3]
    image = camera[:, :2] / (tan_half_fov * jnp.maximum(camera[:, 2:], 1e-3))
    return 0.5 * size * (image + 1.0), camera


def draw_rays(pictures: Pictures, objects: Int[Array, "b"], views: Int[Array, "b r"], key: PRNGKeyArray) -> Rays:
    """A random pixel of each of these views, [b r]: half of them in the object's frame."""
    size = pictures.rgb.shape[2]
    k0, k1 = jax.random.split(key)
    frame = pictures.frame[objects[:, None], views]
    extent = jnp.maximum(frame[..., 2:] - frame[..., :2], 1)
    inside = jax.random.bernoulli(k0, 0.5, views.shape)[..., None]
    u = jax.random.uniform(k1, (*views.shape, 2))
    pixel = jnp.where(inside, frame[..., :2] + jnp.floor(u * extent), jnp.floor(u * size)).astype(int)
    framed = jnp.all((pixel >= frame[..., :2]) & (pixel < frame[..., 2:]), axis=-1)
    odds = 0.5 + 0.5 * framed * size**2 / jnp.prod(extent, axis=-1)
    T = pictures.T_object_camera[objects[:, None], views]
    return Rays(
        origin=T[..., :3, 3],
        direction=directions(T, pictures.tan_half_fov, pixel[..., ::-1] + 0.5, size),
        rgb=pictures.rgb[objects[:, None], views, pixel[..., 0], pixel[..., 1]] / 255.0,
        weight=1.0 / odds,
    )


def span(box: Box, origin: Float[Array, "n 3"], direction: Float[Array, "n 3"]) -> tuple[Array, Array]:
    """Where rays enter and leave the box, [n] each; equal where they miss."""
    corners = jnp.asarray(box).reshape(2, 3)
    safe = jnp.where(jnp.abs(direction) < 1e-6, 1e-6, direction)
    t = (corners[:, None] - origin) / safe
    enter = jnp.maximum(jnp.max(jnp.min(t, axis=0), axis=-1), 0.0)
    return enter, jnp.maximum(jnp.min(jnp.max(t, axis=0), axis=-1), enter)


def integrate(
    field: RadianceField,
    box: Box,
    origin: Float[Array, "n 3"],
    direction: Float[Array, "n 3"],
    samples: int,
    key: PRNGKeyArray | None = None,
) -> tuple[Float[Array, "n 3"], Float[Array, "n"]]:
    """Colour of rays on white, and their opacity: quadrature in as many equal bins (NeRF, eqs. 2 and 3).

    The place in each bin is random, or its middle without a key. Nothing is outside the box.
    """
    enter, leave = span(box, origin, direction)
    place = 0.5 if key is None else jax.random.uniform(key, (len(origin), samples))
    width = ((leave - enter) / samples)[:, None]
    t = enter[:, None] + (jnp.arange(samples) + place) * width
    points = origin[:, None] + t[..., None] * direction[:, None]
    along = jnp.broadcast_to(direction[:, None], points.shape)
    sigma, rgb = field(points.reshape(-1, 3), along.reshape(-1, 3))
    depth = sigma.reshape(t.shape).astype(jnp.float32) * width
    before = jnp.cumsum(depth, axis=1) - depth
    weight = jnp.exp(-before) * -jnp.expm1(-depth)
    opacity = jnp.sum(weight, axis=1)
    colour = jnp.sum(weight[..., None] * rgb.reshape(*t.shape, 3).astype(jnp.float32), axis=1)
    return colour + (1.0 - opacity)[:, None], opacity


def frames_and_box(
    distance: Float[np.ndarray, "n v s s"], T_object_camera: Float[np.ndarray, "n v 4 4"], tan_half_fov: float
) -> tuple[Int[np.ndarray, "n v 4"], Box]:
    """Each object's frame in its pictures (`Pictures.frame`), and a box about all surfaces seen. 0 is a miss."""
    size = distance.shape[2]
    seen = np.asarray(distance > 0)
    rows, columns = np.any(seen, axis=3), np.any(seen, axis=2)
    first = [np.argmax(s, axis=-1) for s in (rows, columns)]
    last = [size - np.argmax(s[..., ::-1], axis=-1) for s in (rows, columns)]
    row, column = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    centre = jnp.asarray(np.stack([column, row], axis=-1) + 0.5)

    def corners(given):
        """Low and high of what an object's pictures show."""
        ranges, T = given
        ray = directions(
            T[:, None, None], jnp.asarray(tan_half_fov), jnp.broadcast_to(centre, (*ranges.shape, 2)), size
        )
        points = T[:, None, None, :3, 3] + ranges[..., None].astype(jnp.float32) * ray
        hit = (ranges > 0)[..., None]
        spans = jnp.where(hit, points, jnp.inf), jnp.where(hit, points, -jnp.inf)
        return jnp.min(spans[0], axis=(0, 1, 2)), jnp.max(spans[1], axis=(0, 1, 2))

    low, high = jax.jit(lambda *given: jax.lax.map(corners, given))(distance, T_object_camera)
    x0, y0, z0 = (np.min(np.asarray(low, float), axis=0) - MARGIN).round(4).tolist()
    x1, y1, z1 = (np.max(np.asarray(high, float), axis=0) + MARGIN).round(4).tolist()
    return np.stack([*first, *last], axis=-1).astype(np.int32), (x0, y0, z0, x1, y1, z1)
