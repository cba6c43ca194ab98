"""Pictures and solid truth of tabletop objects: sphere tracing (Hart 1996), cameras, occupancy. Units: cube units."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from probnerf.families.tabletop import TabletopObject, canonical_distances, colour, part_distances
from probnerf.types import BASE_Z

STEPS = 48
HIT = 1e-3  # a ray that comes this close (canonical units) to the surface has hit it
_DIFFERENCE = 1e-3  # step of the normals' finite difference


class View(eqx.Module):
    """Square pictures of one object (or, with leading axes, of several)."""

    rgb: Float[Array, "size size 3"]  # in [0, 1], white where there is no object
    mask: Bool[Array, "size size"]
    range: Float[Array, "size size"]  # distance along the ray, inf where there is no object


def _trace(
    obj: TabletopObject, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"]
) -> tuple[Bool[Array, "n"], Float[Array, "n"], Float[Array, "n 3"]]:
    # In the canonical frame, whose axes are the cube's: only origins and lengths change.
    ox = (origins[:, 0] - obj.shift[0]) / obj.scale
    oy = (origins[:, 1] - obj.shift[1]) / obj.scale
    oz = (origins[:, 2] - BASE_Z) / obj.scale + BASE_Z
    dx, dy, dz = directions[:, 0], directions[:, 1], directions[:, 2]

    def slab(o: Array, d: Array, low: Array, high: Array) -> tuple[Array, Array]:
        inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
        a, b = (low - 0.01 - o) * inverse, (high + 0.01 - o) * inverse
        return jnp.minimum(a, b), jnp.maximum(a, b)

    x0, x1 = slab(ox, dx, obj.lower[0], obj.upper[0])
    y0, y1 = slab(oy, dy, obj.lower[1], obj.upper[1])
    z0, z1 = slab(oz, dz, obj.lower[2], obj.upper[2])
    near = jnp.maximum(jnp.maximum(jnp.maximum(x0, y0), z0), 0.0)
    far = jnp.minimum(jnp.minimum(x1, y1), z1)

    def distance(x: Array, y: Array, z: Array) -> Array:
        return jnp.minimum(*canonical_distances(obj, x, y, z))

    def step(_: int, t: Array) -> Array:
        # A converged ray keeps stepping by its residual, of either sign: that refines it.
        return jnp.where(t > far, t, t + distance(ox + t * dx, oy + t * dy, oz + t * dz))

    t = jax.lax.fori_loop(0, STEPS, step, near)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    hit = (t <= far) & (distance(x, y, z) < HIT)

    # Normals by central differences over a tetrahedron's corners: four distances, and no gradient of min to go wrong.
    nx, ny, nz = jnp.zeros_like(x), jnp.zeros_like(x), jnp.zeros_like(x)
    for ex, ey, ez in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        e = _DIFFERENCE
        d = distance(x + e * ex, y + e * ey, z + e * ez)
        nx, ny, nz = nx + ex * d, ny + ey * d, nz + ez * d
    normals = jnp.stack([nx, ny, nz], axis=-1)
    normals = normals / jnp.maximum(jnp.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    t = t * obj.scale
    rgb = colour(obj, origins + t[:, None] * directions, normals)
    return hit, jnp.where(hit, t, jnp.inf), jnp.where(hit[:, None], rgb, 1.0)


@jax.jit
def trace(
    obj: TabletopObject, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"]
) -> tuple[Bool[Array, "n"], Float[Array, "n"], Float[Array, "n 3"]]:
    """First hits of unit rays from outside ONE object: hit, distance (a miss: inf), colour (a miss: white)."""
    return _trace(obj, origins, directions)


@jax.jit
def trace_batch(
    objects: TabletopObject, origins: Float[Array, "b n 3"], directions: Float[Array, "b n 3"]
) -> tuple[Bool[Array, "b n"], Float[Array, "b n"], Float[Array, "b n 3"]]:
    """`trace` of a stack of objects, each with its own rays."""
    return jax.vmap(_trace)(objects, origins, directions)


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """T_object_camera of an upright camera (OpenCV axes: x right, y down, z forward) that looks at `target`."""
    forward = np.asarray(target, float) - np.asarray(position, float)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down: the picture's right is the object's +y
        right = np.array([0.0, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    transform = np.eye(4)
    transform[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    transform[:3, 3] = position
    return transform


def pinhole_rays(
    T_object_camera: Float[np.ndarray, "4 4"], focal_px: float, size: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and unit directions of a square picture's pixels, row by row; pixel centres lie at +0.5."""
    pixel = np.arange(size) + 0.5 - 0.5 * size
    v, u = np.meshgrid(pixel, pixel, indexing="ij")
    rays = np.stack([u, v, np.full_like(u, focal_px)], axis=-1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ T_object_camera[:3, :3].T
    origins = np.broadcast_to(T_object_camera[:3, 3], rays.shape)
    return origins.astype(np.float32), rays.astype(np.float32)


def render_views(
    objects: TabletopObject, T_object_camera: Float[np.ndarray, "b 4 4"], focal_px: float, size: int
) -> View:
    """One picture of each of a stack of objects."""
    rays = [pinhole_rays(T, focal_px, size) for T in np.asarray(T_object_camera)]
    hit, distance, rgb = trace_batch(objects, np.stack([o for o, _ in rays]), np.stack([d for _, d in rays]))
    shape = (len(rays), size, size)
    return View(rgb=rgb.reshape(*shape, 3), mask=hit.reshape(shape), range=distance.reshape(shape))


@partial(jax.jit, static_argnames="grid")
def _half_lattice(obj: TabletopObject, grid: int) -> tuple[Bool[Array, "m m m"], Bool[Array, "m m m"]]:
    axis = jnp.linspace(-1.0, 1.0, 2 * grid + 1)
    points = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    body, handle = part_distances(obj, points)
    return jnp.minimum(body, handle) <= 0.0, (handle <= 0.0) & (body > 0.0)


def _any_in_voxel(inside: Bool[Array, "m m m"]) -> Bool[Array, "g g g"]:
    return jax.lax.reduce_window(inside, False, jax.lax.bitwise_or, (3, 3, 3), (2, 2, 2), "valid")


def solid_occupancy(obj: TabletopObject, grid: int = 64) -> Bool[Array, "grid grid grid"]:
    """Voxels of [-1, 1]^3 that meet the solid, index order [ix, iy, iz], centres at -1 + (i + 0.5) 2 / grid.

    A voxel counts if the distance is <= 0 at any of 27 points of the closed voxel: its corners, the middles of its
    edges and faces, and its centre (a lattice at half the voxels' spacing).
    """
    return _any_in_voxel(_half_lattice(obj, grid)[0])


def handle_occupancy(obj: TabletopObject, grid: int = 64) -> Bool[Array, "grid grid grid"]:
    """Voxels that meet the handle outside the body, by the same 27 points as `solid_occupancy`."""
    return _any_in_voxel(_half_lattice(obj, grid)[1])
