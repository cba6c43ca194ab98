"""Pictures and true occupancy of tabletop objects, by ray tracing. Lengths are in cube units.

Hits on vessel walls have a closed form. Other parts use sphere tracing (Hart 1996).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from probnerf.geometry import pinhole_rays
from probnerf.objects.tabletop import (
    CARTON,
    TabletopObject,
    canonical_colour,
    canonical_parts,
    part_distances,
    to_canonical,
)

STEPS = 48
HIT = 1e-3  # a ray within this distance (canonical units) of the surface has hit it
_DIFFERENCE = 1e-3  # step of the normals' finite difference
_CORNERS = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], np.float32)
_SEAM = 2e-6  # overlap of neighbouring edges, so that no ray passes between them


class RenderedView(eqx.Module):
    """Square pictures of one object (or, with leading axes, of several)."""

    rgb: Float[Array, "size size 3"]  # in [0, 1]; white outside the object
    mask: Bool[Array, "size size"]
    range: Float[Array, "size size"]  # distance along the ray; inf outside the object


def _vessel_hit(
    outline: Float[Array, "17 2"], origin: tuple[Array, Array, Array], direction: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    """First hit on the surface of revolution: distance (inf: none) and the unsigned z component of the unit normal.

    An edge of slope k = dr/dz sweeps the cone x^2 + y^2 = (r_a + k (z - z_a))^2, quadratic in t. A flat edge sweeps a
    plane. There are few edges, but they are in a loop: XLA would compute an unrolled chain once for each of its uses.
    """
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    oo, od, dd = ox * ox + oy * oy, ox * dx + oy * dy, dx * dx + dy * dy

    def edge(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Update the nearest hit so far and its normal's z component with edge i."""
        best, normal_z = state
        (ra, za), (rb, zb) = outline[i], outline[i + 1]
        rise = zb - za
        flat = rise == 0.0  # also an edge of padding, which has no length
        k = jnp.where(flat, 0.0, (rb - ra) / jnp.where(flat, 1.0, rise))
        low, high = jnp.minimum(za, zb) - _SEAM, jnp.maximum(za, zb) + _SEAM
        inner, outer = jnp.minimum(ra, rb), jnp.maximum(ra, rb) + jnp.where(ra == rb, 0.0, _SEAM)
        w = ra + k * (oz - za)
        a, b, c = dd - k * k * dz * dz, od - k * dz * w, oo - w * w
        discriminant = b * b - a * c
        q = -(b + jnp.where(b < 0.0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(discriminant, 0.0)))  # no cancellation
        plane = (za - oz) / jnp.where(dz == 0.0, 1e-12, dz)
        r2 = oo + plane * (2.0 * od + plane * dd)
        on_plane = flat & (r2 >= inner * inner) & (r2 < outer * outer) & (plane >= 0.0)
        found = jnp.where(on_plane, plane, jnp.inf)
        for t in (q / jnp.where(a == 0.0, 1e-12, a), c / jnp.where(q == 0.0, 1e-12, q)):
            z = oz + t * dz
            on_cone = ~flat & (discriminant >= 0.0) & (z >= low) & (z <= high) & (t >= 0.0)
            found = jnp.minimum(found, jnp.where(on_cone, t, jnp.inf))
        edge_normal_z = jnp.where(flat, 1.0, -k / jnp.sqrt(1.0 + k * k))
        return jnp.minimum(found, best), jnp.where(found < best, edge_normal_z, normal_z)

    return jax.lax.fori_loop(0, outline.shape[0] - 1, edge, (jnp.full_like(ox, jnp.inf), jnp.ones_like(ox)))


def _trace(
    obj: TabletopObject, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"]
) -> tuple[Bool[Array, "n"], Float[Array, "n"], Float[Array, "n 3"]]:
    """Vessel walls in closed form. Carton, spout and handle have few terms each and use sphere tracing."""
    # In the canonical frame. Its axes are parallel to the cube's: only origins and lengths change.
    ox, oy, oz = to_canonical(obj, origins)
    dx, dy, dz = directions[:, 0], directions[:, 1], directions[:, 2]

    def slab(o: Array, d: Array, low: Array, high: Array) -> tuple[Array, Array]:
        inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
        a, b = (low - 0.01 - o) * inverse, (high + 0.01 - o) * inverse
        return jnp.minimum(a, b), jnp.maximum(a, b)

    x0, x1 = slab(ox, dx, obj.lower[0], obj.upper[0])
    y0, y1 = slab(oy, dy, obj.lower[1], obj.upper[1])
    z0, z1 = slab(oz, dz, obj.lower[2], obj.upper[2])
    near = jnp.maximum(jnp.maximum(jnp.maximum(x0, y0), z0), 0.0)
    reach = jnp.minimum(jnp.minimum(x1, y1), z1) - near
    ox, oy, oz = ox + near * dx, oy + near * dy, oz + near * dz  # single precision needs a nearby origin

    wall, normal_z = _vessel_hit(obj.outline, (ox, oy, oz), (dx, dy, dz))
    wall = jnp.where((obj.kind == CARTON) | (wall > reach), jnp.inf, wall)
    far = jnp.minimum(reach, wall)

    def distance(x: Array, y: Array, z: Array) -> Array:
        return jnp.minimum(*canonical_parts(obj, x, y, z))

    def step(_: int, t: Array) -> Array:
        # A converged ray continues to step by its residual, of either sign. This refines the hit.
        return jnp.where(t > far, t, t + distance(ox + t * dx, oy + t * dy, oz + t * dz))

    stepped = jax.lax.fori_loop(0, STEPS, step, jnp.zeros_like(ox))
    x, y, z = ox + stepped * dx, oy + stepped * dy, oz + stepped * dz
    rest, handle = canonical_parts(obj, x, y, z)
    on_part = (stepped <= far) & (jnp.minimum(rest, handle) < HIT)
    t = jnp.where(on_part, stepped, jnp.where(jnp.isfinite(wall), wall, 0.0))
    hit = on_part | jnp.isfinite(wall)

    # The parts' normals, by differences over a tetrahedron's corners: four distances, and no gradient of a minimum.
    def corner(i: Array, gradient: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        ex, ey, ez = jnp.asarray(_CORNERS)[i]
        d = distance(x + _DIFFERENCE * ex, y + _DIFFERENCE * ey, z + _DIFFERENCE * ez)
        return gradient[0] + ex * d, gradient[1] + ey * d, gradient[2] + ez * d

    zero = jnp.zeros_like(x)
    nx, ny, nz = jax.lax.fori_loop(0, 4, corner, (zero, zero, zero))
    length = jnp.maximum(jnp.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)

    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    per_r = jnp.sqrt(jnp.maximum(1.0 - normal_z * normal_z, 0.0)) / jnp.maximum(jnp.sqrt(x * x + y * y), 1e-9)
    facing = jnp.where(per_r * (x * dx + y * dy) + normal_z * dz > 0.0, -1.0, 1.0)  # the hit normal faces the ray
    normals = jnp.stack(
        [
            jnp.where(on_part, nx / length, facing * per_r * x),
            jnp.where(on_part, ny / length, facing * per_r * y),
            jnp.where(on_part, nz / length, facing * normal_z),
        ],
        axis=-1,
    )
    rgb = canonical_colour(obj, (x, y, z), normals, on_part & (handle < rest))
    return hit, jnp.where(hit, (near + t) * obj.scale, jnp.inf), jnp.where(hit[:, None], rgb, 1.0)


@jax.jit
def trace(
    obj: TabletopObject, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"]
) -> tuple[Bool[Array, "n"], Float[Array, "n"], Float[Array, "n 3"]]:
    """First hits of unit rays from outside ONE object: hit, distance (inf for a miss), colour (white for a miss)."""
    return _trace(obj, origins, directions)


@jax.jit
def trace_batch(
    objects: TabletopObject, origins: Float[Array, "b n 3"], directions: Float[Array, "b n 3"]
) -> tuple[Bool[Array, "b n"], Float[Array, "b n"], Float[Array, "b n 3"]]:
    """`trace` of a stack of objects, each with its own rays."""
    return jax.vmap(_trace)(objects, origins, directions)


def render_views(
    objects: TabletopObject, T_object_camera: Float[np.ndarray, "b 4 4"], focal_px: float, size: int
) -> RenderedView:
    """One picture of each of a stack of objects."""
    rays = [pinhole_rays(T, focal_px, size) for T in np.asarray(T_object_camera)]
    hit, distance, rgb = trace_batch(objects, np.stack([o for o, _ in rays]), np.stack([d for _, d in rays]))
    shape = (len(rays), size, size)
    return RenderedView(rgb=rgb.reshape(*shape, 3), mask=hit.reshape(shape), range=distance.reshape(shape))


@partial(jax.jit, static_argnames="grid")
def _half_lattice(obj: TabletopObject, grid: int) -> tuple[Bool[Array, "m m m"], Bool[Array, "m m m"]]:
    axis = jnp.linspace(-1.0, 1.0, 2 * grid + 1)
    points = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    body, handle = part_distances(obj, points)
    return jnp.minimum(body, handle) <= 0.0, (handle <= 0.0) & (body > 0.0)


def _any_in_voxel(inside: Bool[Array, "m m m"]) -> Bool[Array, "g g g"]:
    return jax.lax.reduce_window(inside, False, jax.lax.bitwise_or, (3, 3, 3), (2, 2, 2), "valid")


def solid_occupancy(obj: TabletopObject, grid: int = 64) -> Bool[Array, "grid grid grid"]:
    """Voxels of [-1, 1]^3 that intersect the solid, index order [ix, iy, iz], centres at -1 + (i + 0.5) 2 / grid.

    A voxel counts if the distance is <= 0 at any of 27 points of the closed voxel: its corners, the middles of its
    edges and faces, and its centre (a lattice at half the voxels' spacing).
    """
    return _any_in_voxel(_half_lattice(obj, grid)[0])


def handle_occupancy(obj: TabletopObject, grid: int = 64) -> Bool[Array, "grid grid grid"]:
    """Voxels that intersect the handle outside the body, by the same 27 points as `solid_occupancy`."""
    return _any_in_voxel(_half_lattice(obj, grid)[1])
