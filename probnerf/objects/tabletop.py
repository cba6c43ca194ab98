"""The tabletop family: vessels and cartons with exact geometry, drawn from a seed.

Canonical frame (cube units): z up, the body's axis at x = y = 0, the base on z = BASE_Z, the handle (or a carton's
front face) at +x, a spout at -x. The larger of the body's longest horizontal side and its height is BODY_EXTENT;
handles and spouts are not part of the body. The object's placement in the cube adds a small similarity transform about
its support point (slack).

Symbols: (r, z) are cylindrical coordinates; s in [0, 1] is the height as a fraction of the body's.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from probnerf.objects.tabletop_sampler import (
    ABSENT,
    BANDED,
    CARTON,
    KINDS,
    LABELLED,
    OUTER_VERTICES,
    PRINTED,
    TEXTURES,
    draw,
)
from probnerf.types import BASE_Z

TRAIN_SEEDS = range(0, 1_000_000)
VALIDATION_SEEDS = range(1_000_000, 2_000_000)
TEST_SEEDS = range(2_000_000, 3_000_000)


class TabletopObject(eqx.Module):
    """One object; leaves may carry leading batch axes. Lengths are canonical cube units, before slack."""

    kind: Int[Array, ""]  # index into KINDS
    texture: Int[Array, ""]  # index into TEXTURES
    has_handle: Bool[Array, ""]
    is_open: Bool[Array, ""]  # a vessel with a cavity
    half_extent_m: Float[Array, ""]  # metres per canonical cube unit: max(body width, height) / BODY_EXTENT
    scale: Float[Array, ""]  # slack: p_cube = scale (p - base) + base + (shift, 0), with base = (0, 0, BASE_Z)
    shift: Float[Array, "2"]
    lower: Float[Array, "3"]  # bounding box of all parts
    upper: Float[Array, "3"]
    outline: Float[Array, "17 2"]  # (r, z) from the axis at the base, over the outer and the inner profile, to the axis
    box: Float[Array, "4"]  # half sides x, y, z and the edges' radius (cartons)
    tube: Float[Array, "9 2"]  # (x, z) centre line of the handle
    tube_section: Float[Array, "2"]  # radius; half width across y beyond it
    spout: Float[Array, "2 3"]  # (x, z, radius) of the round cone's two ends, at y = 0
    paint: Float[Array, "7 3"]  # body, second, third, label, lid, handle, interior
    bands: Float[Array, "3"]  # bands per height, phase, threshold
    label: Float[Array, "5"]  # azimuth, cosine of half width, half width on a box's face (of 1), s from, s to
    waves: Float[Array, "2 3 4"]  # two patterns: sums of three sinusoids (wave vector, phase)
    pattern_level: Float[Array, "2"]
    lid_start: Float[Array, ""]  # the lid's paint starts at this s; > 1 if there is no lid
    light: Float[Array, "3"]  # unit vector towards the light
    ambient: Float[Array, "3"]
    lamp: Float[Array, "3"]


# ---------------------------------------------------------------------------------------------------- geometry


def _outline_distance(outline: Float[Array, "17 2"], r: Array, z: Array) -> Array:
    """Exact signed distance to the solid of revolution; the edge on the axis is not a surface and is excluded.

    The sign is the parity of the outline's crossings with the half line towards +r, which never crosses the axis. Edges
    are unrolled: on a CPU, one fused elementwise loop is several times faster than a reduction over an edge axis.
    """
    start, edge = outline[:-1], outline[1:] - outline[:-1]
    squared = jnp.sum(edge * edge, axis=-1)
    inverse = jnp.where(squared > 1e-12, 1.0 / jnp.maximum(squared, 1e-12), 0.0)  # padding edges have no length
    slope = jnp.where(edge[:, 1] == 0.0, 0.0, edge[:, 0] / jnp.where(edge[:, 1] == 0.0, 1.0, edge[:, 1]))
    nearest = jnp.full_like(r, 64.0)
    inside = jnp.zeros(r.shape, bool)
    for i in range(outline.shape[0] - 1):
        u, v = r - start[i, 0], z - start[i, 1]
        t = jnp.clip((u * edge[i, 0] + v * edge[i, 1]) * inverse[i], 0.0, 1.0)
        du, dv = u - t * edge[i, 0], v - t * edge[i, 1]
        nearest = jnp.minimum(nearest, du * du + dv * dv)
        straddles = (z < start[i, 1]) != (z < outline[i + 1, 1])
        inside = inside ^ (straddles & (u < v * slope[i]))
    distance = jnp.sqrt(nearest)
    return jnp.where(inside, -distance, distance)


def _box_distance(box: Float[Array, "4"], x: Array, y: Array, z: Array) -> Array:
    """Exact signed distance to a rounded box that stands on BASE_Z."""
    qx = jnp.abs(x) - (box[0] - box[3])
    qy = jnp.abs(y) - (box[1] - box[3])
    qz = jnp.abs(z - (BASE_Z + box[2])) - (box[2] - box[3])
    px, py, pz = jnp.maximum(qx, 0.0), jnp.maximum(qy, 0.0), jnp.maximum(qz, 0.0)
    return jnp.sqrt(px * px + py * py + pz * pz) + jnp.minimum(jnp.maximum(jnp.maximum(qx, qy), qz), 0.0) - box[3]


def _tube_distance(tube: Float[Array, "9 2"], section: Float[Array, "2"], x: Array, y: Array, z: Array) -> Array:
    """Exact signed distance to a ball swept along the centre line and over |y| <= the section's half width."""
    start, edge = tube[:-1], tube[1:] - tube[:-1]
    inverse = 1.0 / jnp.maximum(jnp.sum(edge * edge, axis=-1), 1e-12)
    nearest = jnp.full_like(x, 64.0)
    for i in range(tube.shape[0] - 1):
        u, v = x - start[i, 0], z - start[i, 1]
        t = jnp.clip((u * edge[i, 0] + v * edge[i, 1]) * inverse[i], 0.0, 1.0)
        du, dv = u - t * edge[i, 0], v - t * edge[i, 1]
        nearest = jnp.minimum(nearest, du * du + dv * dv)
    w = jnp.maximum(jnp.abs(y) - section[1], 0.0)
    return jnp.sqrt(nearest + w * w) - section[0]


def _spout_distance(spout: Float[Array, "2 3"], x: Array, y: Array, z: Array) -> Array:
    """Exact signed distance to a round cone (the hull of two balls)."""
    axis = spout[1, :2] - spout[0, :2]
    length = jnp.sqrt(jnp.sum(axis * axis))
    axis = axis / length
    b = (spout[0, 2] - spout[1, 2]) / length
    a = jnp.sqrt(1.0 - b * b)
    u, v = x - spout[0, 0], z - spout[0, 1]
    along = u * axis[0] + v * axis[1]
    across2 = jnp.maximum(u * u + v * v + y * y - along * along, 0.0)
    across = jnp.sqrt(across2)
    k = a * along - b * across
    beyond = along - length
    return jnp.where(
        k < 0.0,
        jnp.sqrt(across2 + along * along) - spout[0, 2],
        jnp.where(
            k > a * length,
            jnp.sqrt(across2 + beyond * beyond) - spout[1, 2],
            a * across + b * along - spout[0, 2],
        ),
    )


def canonical_parts(obj: TabletopObject, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Distances of canonical coordinates (before slack) to carton or spout and to the handle; -ABSENT if absent."""
    box = jnp.where(obj.kind == CARTON, _box_distance(obj.box, x, y, z), -ABSENT)
    return jnp.minimum(box, _spout_distance(obj.spout, x, y, z)), _tube_distance(obj.tube, obj.tube_section, x, y, z)


def canonical_distances(obj: TabletopObject, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Distances of canonical coordinates to the body (including the spout) and to the handle."""
    rest, handle = canonical_parts(obj, x, y, z)
    revolved = _outline_distance(obj.outline, jnp.sqrt(x * x + y * y), z)
    return jnp.minimum(rest, jnp.where(obj.kind == CARTON, -ABSENT, revolved)), handle


def to_canonical(obj: TabletopObject, points: Float[Array, "... 3"]) -> tuple[Array, Array, Array]:
    """Canonical x, y, z of points in the cube: undoes the slack."""
    return (
        (points[..., 0] - obj.shift[0]) / obj.scale,
        (points[..., 1] - obj.shift[1]) / obj.scale,
        (points[..., 2] - BASE_Z) / obj.scale + BASE_Z,
    )


def part_distances(
    obj: TabletopObject, points: Float[Array, "... 3"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Signed distances (cube units) to the body (with its spout) and to the handle; at least 5 if there is no handle.

    The handle's ends extend into the wall. So a point is only in the handle if the second is <= 0 and the first is > 0.
    """
    body, handle = canonical_distances(obj, *to_canonical(obj, points))
    return body * obj.scale, handle * obj.scale


def signed_distance(obj: TabletopObject, points: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Signed distance (cube units) of points in the cube to ONE object: negative inside.

    It is the minimum over the parts' exact distances. It is exact outside, and its sign is exact everywhere. Inside, it
    is exact if the deepest part's nearest surface is not covered by another part. If parts overlap, its magnitude is a
    lower bound.
    """
    body, handle = part_distances(obj, points)
    return jnp.minimum(body, handle)


# ------------------------------------------------------------------------------------------------------ colour


def colour(obj: TabletopObject, points: Float[Array, "... 3"], normals: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Lit colour in [0, 1] of surface points with unit normals: Lambert plus ambient; the light is fixed to it."""
    x, y, z = to_canonical(obj, points)
    body, handle = canonical_distances(obj, x, y, z)
    return canonical_colour(obj, (x, y, z), normals, handle < body)


def canonical_colour(
    obj: TabletopObject,
    points: tuple[Array, Array, Array],
    normals: Float[Array, "... 3"],
    on_handle: Bool[Array, "..."],
) -> Float[Array, "... 3"]:
    """`colour` of canonical coordinates x, y, z."""
    x, y, z = points
    r = jnp.sqrt(x * x + y * y)
    nx, ny, nz = normals[..., 0], normals[..., 1], normals[..., 2]
    carton = obj.kind == CARTON
    s = (z - BASE_Z) / jnp.where(carton, 2.0 * obj.box[2], obj.outline[OUTER_VERTICES, 1] - BASE_Z)

    def pattern(k: int) -> Array:
        wave = obj.waves[k]
        total = sum(jnp.sin(x * wave[j, 0] + y * wave[j, 1] + z * wave[j, 2] + wave[j, 3]) for j in range(3))
        return total > obj.pattern_level[k]

    first, second = pattern(0), pattern(1)
    banded = jnp.sin(2.0 * jnp.pi * (obj.bands[0] * s + obj.bands[1])) > obj.bands[2]
    around = (x * jnp.cos(obj.label[0]) + y * jnp.sin(obj.label[0])) >= r * obj.label[1]
    faces_x = jnp.abs(nx) > jnp.abs(ny)
    on_face = jnp.where(faces_x, jnp.abs(y) < obj.label[2] * obj.box[1], jnp.abs(x) < obj.label[2] * obj.box[0])
    labelled = jnp.where(carton, on_face & (jnp.abs(nz) < 0.7), around) & (s > obj.label[3]) & (s < obj.label[4])

    def choose(condition: Array, a: Array, b: Array) -> Array:
        return jnp.where(condition[..., None], a, b)

    body_paint = jnp.broadcast_to(obj.paint[0], (*x.shape, 3))
    printed = choose(first, obj.paint[1], choose(second, obj.paint[2], body_paint))
    in_label = choose(first, obj.paint[1], choose(second, obj.paint[2], obj.paint[3]))
    paint = choose((obj.texture == BANDED) & banded, obj.paint[1], body_paint)
    paint = choose((obj.texture == LABELLED) & labelled, in_label, paint)
    paint = choose((obj.texture == PRINTED) & jnp.ones_like(first), printed, paint)
    paint = choose(s > obj.lid_start, obj.paint[4], paint)
    inward = (nx * x + ny * y < -0.1 * r) | ((nz > 0.5) & (s < 0.6))  # the cavity's wall or floor
    paint = choose(obj.is_open & inward, obj.paint[6], paint)
    paint = choose(on_handle, obj.paint[5], paint)
    facing = jnp.maximum(jnp.sum(normals * obj.light, axis=-1), 0.0)
    return jnp.clip(paint * (obj.ambient + obj.lamp * facing[..., None]), 0.0, 1.0)


def _as_object(fields: dict[str, np.ndarray]) -> TabletopObject:
    kinds = {"kind": np.int32, "texture": np.int32, "has_handle": bool, "is_open": bool}
    return TabletopObject(**{k: jnp.asarray(np.asarray(v, kinds.get(k, np.float32))) for k, v in fields.items()})


def sample_object(seed: int, slack: float = 1.0) -> TabletopObject:
    """The object of a seed; `slack` multiplies the placement's standard deviations (0: canonical)."""
    return _as_object({k: np.asarray(v) for k, v in draw(seed, slack).items()})


def sample_objects(seeds: Sequence[int], slack: float = 1.0) -> TabletopObject:
    """The objects of several seeds, stacked along a leading axis."""
    samples = [draw(int(seed), slack) for seed in seeds]
    return _as_object({k: np.stack([np.asarray(s[k]) for s in samples]) for k in samples[0]})


def description(obj: TabletopObject) -> Float[Array, "p"]:
    """All parameters of shape and appearance, as one vector of numbers of order 1: the input of `Recognition`.

    Angles are given as cosine and sine. A pattern that is not used is given as zeros.
    """
    patterned = (obj.texture == LABELLED) | (obj.texture == PRINTED)
    per_height, phase, threshold = obj.bands
    parts = [
        3.0 * obj.outline,
        3.0 * obj.box,
        2.0 * obj.tube,
        10.0 * obj.tube_section,
        obj.spout,
        2.0 * obj.paint - 1.0,
        (obj.texture == BANDED) * jnp.stack([0.5 * per_height, *_turn(2.0 * jnp.pi * phase), threshold]),
        (obj.texture == LABELLED) * jnp.stack([*_turn(obj.label[0]), *obj.label[1:]]),
        patterned * jnp.concatenate([0.1 * obj.waves[..., :3], jnp.stack(_turn(obj.waves[..., 3]), axis=-1)], axis=-1),
        patterned * obj.pattern_level,
        obj.lid_start,
        obj.light,
        obj.ambient,
        obj.lamp,
        2.0 * jax.nn.one_hot(obj.kind, len(KINDS)),
        2.0 * jax.nn.one_hot(obj.texture, len(TEXTURES)),
        2.0 * obj.has_handle,
        2.0 * obj.is_open,
        10.0 * jnp.log(obj.scale),
        20.0 * obj.shift,
    ]
    return jnp.concatenate([jnp.clip(jnp.ravel(part).astype(jnp.float32), -5.0, 5.0) for part in parts])


def _turn(angle: Float[Array, "..."]) -> tuple[Array, Array]:
    return jnp.cos(angle), jnp.sin(angle)
