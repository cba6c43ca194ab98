"""The tabletop family: vessels and cartons with exact truth, drawn from a seed.

Canonical frame (cube units): z up, the body's axis at x = y = 0, the base on z = BASE_Z, the handle (or a carton's
front face) at +x, a spout at -x. The larger of the body's longest horizontal side and its height is BODY_EXTENT;
handles and spouts are not part of the body. The object stands in the cube after a small similarity about its support
point (slack).

Symbols: (r, z) are cylindrical coordinates; s in [0, 1] is the height as a fraction of the body's.
"""

import colorsys
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from probnerf.types import BASE_Z

TRAIN_SEEDS = range(0, 1_000_000)
VALIDATION_SEEDS = range(1_000_000, 2_000_000)
TEST_SEEDS = range(2_000_000, 3_000_000)

KINDS = ("can", "cup", "mug", "bowl", "bottle", "pitcher", "carton")
CAN, CUP, MUG, BOWL, BOTTLE, PITCHER, CARTON = range(7)
TEXTURES = ("plain", "banded", "labelled", "printed")
PLAIN, BANDED, LABELLED, PRINTED = range(4)

BODY_EXTENT = 1.4  # cube units
REACH_LIMIT = 1.08  # no part's |x| exceeds this before slack
SLACK_LOG_SCALE = 0.05  # standard deviations of the placement in the cube
SLACK_SHIFT = 0.03

_KIND_WEIGHTS = (0.14, 0.12, 0.24, 0.10, 0.12, 0.14, 0.14)
_TEXTURE_WEIGHTS = (0.35, 0.20, 0.25, 0.20)
_OUTER, _INNER, _TUBE = 10, 5, 9  # vertices of the outer and inner profile, and of the handle's centre line
_ABSENT = -8.0  # the radius of a part that is not there: its distance is then at least 8


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
    lid_start: Float[Array, ""]  # above this s the lid's paint; > 1 where there is none
    light: Float[Array, "3"]  # unit vector towards the light
    ambient: Float[Array, "3"]
    lamp: Float[Array, "3"]


# ---------------------------------------------------------------------------------------------------- geometry


def _outline_distance(outline: Float[Array, "17 2"], r: Array, z: Array) -> Array:
    """Exact signed distance to the solid of revolution; the closing edge on the axis is no surface and is left out.

    The sign is the parity of crossings of the half line towards +r, which never meets the axis. Edges are unrolled: one
    fused elementwise loop is several times faster on a CPU than a reduction over an edge axis.
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
    """Distances of canonical coordinates (before slack) to carton or spout and to the handle; -_ABSENT if absent."""
    box = jnp.where(obj.kind == CARTON, _box_distance(obj.box, x, y, z), -_ABSENT)
    return jnp.minimum(box, _spout_distance(obj.spout, x, y, z)), _tube_distance(obj.tube, obj.tube_section, x, y, z)


def canonical_distances(obj: TabletopObject, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Body (spout included) and handle distances of canonical coordinates."""
    rest, handle = canonical_parts(obj, x, y, z)
    revolved = _outline_distance(obj.outline, jnp.sqrt(x * x + y * y), z)
    return jnp.minimum(rest, jnp.where(obj.kind == CARTON, -_ABSENT, revolved)), handle


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
    """Signed distances (cube units) to the body (with its spout) and to the handle; at least 5 where there is none.

    The handle alone is where the second is <= 0 and the first is > 0: its ends reach into the wall.
    """
    body, handle = canonical_distances(obj, *to_canonical(obj, points))
    return body * obj.scale, handle * obj.scale


def signed_distance(obj: TabletopObject, points: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Signed distance (cube units) of points in the cube to ONE object: negative inside.

    The minimum over the parts' exact distances: exact outside, and its sign is exact everywhere. Inside, it is exact
    where the deepest part's nearest surface is not covered by another part; where parts overlap its magnitude is a
    lower bound.
    """
    body, handle = part_distances(obj, points)
    return jnp.minimum(body, handle)


# ------------------------------------------------------------------------------------------------------ colour


def colour(obj: TabletopObject, points: Float[Array, "... 3"], normals: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Lit colour in [0, 1] of surface points with unit normals: Lambert plus ambient, the light fixed to the object."""
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
    s = (z - BASE_Z) / jnp.where(carton, 2.0 * obj.box[2], obj.outline[_OUTER, 1] - BASE_Z)

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


# ---------------------------------------------------------------------------------------------------- sampling


def _profile(rng: np.random.Generator, kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights u in [0, 1] and radii (largest 1) of the outer profile, chamfered at both ends by the caller."""
    u = np.linspace(0.0, 1.0, _OUTER - 2)
    if kind == CAN:
        radius = np.ones_like(u)
    elif kind == BOWL:
        u = u**1.5  # the curvature sits near the base
        foot = rng.uniform(0.3, 0.6)
        radius = foot + (1.0 - foot) * u ** rng.uniform(0.4, 0.8)
    elif kind == BOTTLE:
        shoulder = rng.uniform(0.45, 0.75)
        neck = shoulder + rng.uniform(0.08, 0.22)
        u = np.concatenate([[0.0, 0.5 * shoulder], np.linspace(shoulder, neck, 5), [1.0]])
        blend = np.clip((u - shoulder) / (neck - shoulder), 0.0, 1.0)
        blend = blend * blend * (3.0 - 2.0 * blend)
        radius = 1.0 + blend * (rng.uniform(0.25, 0.55) - 1.0)
        radius[:2] *= 1.0 - rng.uniform(0.0, 0.12) * np.array([1.0, 0.3])
    else:
        style = rng.uniform()
        if kind == CUP:
            low = rng.uniform(0.6, 0.95)
            radius = low + (1.0 - low) * u
        elif kind == MUG and style < 0.5:
            radius = np.ones_like(u)
        elif kind == MUG and style < 0.75:
            low = rng.uniform(0.75, 1.15)
            radius = low + (1.0 - low) * u
        elif kind == MUG:
            radius = 1.0 - rng.uniform(-0.1, 0.2) * (2.0 * u - 1.0) ** 2
        elif style < 0.65:  # tapered pitcher
            low = rng.uniform(0.85, 1.3)
            radius = low + (1.0 - low) * u
        else:  # belly
            radius = rng.uniform(0.55, 0.8) + 0.4 * np.sin(np.pi * np.clip(u, 0, 1) ** rng.uniform(0.6, 1.0)) ** 1.3
        radius = radius + rng.uniform(0.0, 0.025) * np.sin(2 * np.pi * (rng.uniform(0.5, 1.2) * u + rng.uniform()))
    return u, radius / radius.max()


def _aspect(rng: np.random.Generator, kind: int) -> float:
    """Body diameter over height."""
    if kind == CAN and rng.uniform() < 0.2:
        return rng.uniform(1.1, 2.6)
    low, high = {CAN: (0.5, 1.1), CUP: (0.6, 1.0), MUG: (0.7, 1.2), BOWL: (1.6, 3.0), BOTTLE: (0.28, 0.5)}.get(
        kind, (0.42, 0.85)
    )
    return rng.uniform(low, high)


def _largest_side_m(rng: np.random.Generator, kind: int) -> float:
    low, high = (
        (0.05, 0.18),
        (0.06, 0.15),
        (0.07, 0.14),
        (0.09, 0.26),
        (0.10, 0.30),
        (0.13, 0.30),
        (0.05, 0.28),
    )[kind]
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _handle(
    rng: np.random.Generator, kind: int, z: np.ndarray, radius: np.ndarray, wall: float
) -> tuple[np.ndarray, float, float]:
    """Centre line (x, z), tube radius and extra half width across y of a handle on the profile radius(z)."""
    height = z[-1] - z[0]
    tube = rng.uniform(0.045, 0.1)
    across = max(rng.uniform(0.05, 0.13) - tube, 0.0)
    top = z[-1] - height * rng.uniform(0.05, 0.25) - tube
    bottom = min(z[0] + height * rng.uniform(0.08, 0.45 if kind == MUG else 0.5) + tube, top - 0.4)
    bottom = max(bottom, z[0] + tube + 0.02)
    ends = np.interp([bottom, top], z, radius)
    reach = max(rng.uniform(0.22, 0.5), 2.0 * tube + 0.12)
    reach = max(min(reach, REACH_LIMIT - ends.max()), 2.0 * tube + 0.1)  # outward extent, tube included
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _TUBE)
    cosine, sine = np.maximum(np.cos(angle), 0.0), np.sin(angle)
    squareness = rng.uniform(0.45, 1.0)  # 1: a half ellipse; small: a D
    skew, bulge = rng.uniform(-0.15, 0.35), rng.uniform(0.0, 0.35) * (rng.uniform() < 0.4)
    half = 0.5 * (top - bottom)
    line_z = 0.5 * (top + bottom) + half * np.sign(sine) * np.abs(sine) ** squareness * (1.0 + bulge * cosine)
    out = cosine**squareness * (1.0 + skew * sine)
    line_z = np.clip(line_z, z[0] + tube + 0.01, z[-1] + 0.12)
    along = np.linspace(0.0, 1.0, _TUBE)
    wall_x = np.maximum((1 - along) * ends[0] + along * ends[1], np.interp(line_z, z, radius))
    # The ends' balls meet the wall without showing in the cavity.
    line_x = wall_x + max(tube - wall, 0.0) + 0.01 + (reach - tube) * out / out.max()
    line_x = np.minimum(line_x, REACH_LIMIT - tube)
    return np.stack([line_x, line_z], axis=-1), tube, across


def _paint(rng: np.random.Generator) -> np.ndarray:
    style = rng.uniform()
    if style < 0.2:
        return rng.uniform(0.82, 1.0) * rng.uniform(0.94, 1.0, 3)
    if style < 0.3:
        return rng.uniform(0.05, 0.3) * rng.uniform(0.9, 1.0, 3)
    return np.array(colorsys.hsv_to_rgb(rng.uniform(), rng.uniform(0.2, 0.95), rng.uniform(0.35, 1.0)))


def _appearance(rng: np.random.Generator, kind: int, is_closed: bool) -> dict[str, np.ndarray | float]:
    """Paint, pattern and light."""
    texture = rng.choice(len(TEXTURES), p=_TEXTURE_WEIGHTS)
    paint = np.stack([_paint(rng) for _ in range(7)])
    if rng.uniform() < 0.6 or texture == PRINTED:
        paint[5] = paint[0]
    if rng.uniform() < 0.5:
        paint[6] = paint[0]
    waves = rng.normal(size=(2, 3, 4))
    waves[..., :3] *= (rng.uniform(4.0, 11.0) / np.linalg.norm(waves[..., :3], axis=-1))[..., None]
    waves[..., 3] = rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    lid_start = 2.0
    if is_closed and kind in (CAN, BOTTLE, MUG, PITCHER) and rng.uniform() < 0.75:
        lid_start = {CAN: rng.uniform(0.9, 0.995), BOTTLE: rng.uniform(0.82, 0.95)}.get(kind, rng.uniform(0.88, 0.97))
    wraps = rng.uniform() < (0.5 if kind in (CAN, BOTTLE) else 0.15)
    light = np.array([*rng.normal(size=2), rng.uniform(0.3, 2.0)])
    ambient, lamp = rng.uniform(0.35, 0.75), rng.uniform(0.2, 0.65)
    low = rng.uniform(0.05, 0.4)
    return {
        "texture": texture,
        "paint": paint,
        "bands": np.array([rng.uniform(0.7, 4.0), rng.uniform(), rng.uniform(-0.6, 0.6)]),
        "label": np.array(
            [
                rng.uniform(-np.pi, np.pi),
                -1.01 if wraps else np.cos(rng.uniform(0.4, 1.6)),
                rng.uniform(0.5, 0.95),
                low,
                min(low + rng.uniform(0.3, 0.6), 0.95),
            ]
        ),
        "waves": waves,
        "pattern_level": rng.uniform(-0.2, 0.9, 2),
        "lid_start": lid_start,
        "light": light / np.linalg.norm(light),
        "ambient": ambient * rng.uniform(0.95, 1.05, 3),
        "lamp": lamp * rng.uniform(0.92, 1.08, 3),
    }


def _vessel(rng: np.random.Generator, kind: int) -> dict[str, np.ndarray | float]:
    aspect = _aspect(rng, kind)
    height = min(BODY_EXTENT, BODY_EXTENT / aspect)
    u, radius = _profile(rng, kind)
    radius = 0.5 * aspect * height * radius
    z = BASE_Z + height * u
    is_closed = kind in (CAN, BOTTLE) or rng.uniform() < {MUG: 0.08, PITCHER: 0.45}.get(kind, 0.0)
    wall = rng.uniform(0.07, 0.13)
    chamfer = rng.uniform(0.008, 0.03)
    # Chamfers keep the largest radius and both end planes; a vertex next to the end moves along the profile.
    outer_z = np.concatenate([[z[0], z[0] + chamfer], z[1:-1], [z[-1] - chamfer, z[-1]]])
    outer_r = np.interp(outer_z, z, radius)
    outer_r[[0, -1]] -= chamfer
    outline = np.tile([0.0, z[-1]], (17, 1))
    outline[0] = 0.0, z[0]
    outline[1 : 1 + _OUTER] = np.stack([outer_r, outer_z], axis=-1)
    if not is_closed:
        floor = z[0] + rng.uniform(0.07, 0.13)
        inner_z = floor + (z[-1] - floor) * (np.linspace(1.0, 0.0, _INNER) ** (1.5 if kind == BOWL else 1.0))
        inner_r = np.maximum(np.interp(inner_z, z, radius) - wall, 0.05)
        inner_r[0] += min(chamfer, 0.3 * wall)
        outline[11 : 11 + _INNER] = np.stack([inner_r, inner_z], axis=-1)
        outline[16] = 0.0, floor
    shape: dict[str, np.ndarray | float] = {
        "is_open": not is_closed,
        "outline": outline,
        "box": np.array([0.3, 0.3, 0.3, 0.01]),
        "body_reach": np.array([radius.max(), radius.max()]),
        "top": z[-1],
    }
    thickness = 0.13 if is_closed else wall
    if kind in (MUG, PITCHER) and rng.uniform() < 0.85:
        tube, tube_radius, across = _handle(rng, kind, z, radius, thickness)
        shape |= {"tube": tube, "tube_section": np.array([tube_radius, across])}
    if kind == PITCHER and rng.uniform() < 0.7:
        thick, thin = rng.uniform(0.1, 0.16), rng.uniform(0.05, 0.08)
        foot = z[-1] - thick - height * rng.uniform(0.0, 0.12)
        x = np.interp(foot, z, radius) + max(thick - thickness, 0.0) + 0.01
        tip_x = x + rng.uniform(0.1, 0.22)
        tip_z = min(foot + rng.uniform(0.08, 0.25), z[-1] + 0.05)
        shape["spout"] = np.array([[-x, foot, thick], [-tip_x, tip_z, thin]])
    return shape


def _carton(rng: np.random.Generator) -> dict[str, np.ndarray | float]:
    """A box whose front is its widest upright face; upright, or lying on its largest face."""
    sides = np.sort(np.array([rng.uniform(0.2, 0.75), rng.uniform(0.4, 1.0), 1.0]))
    lying = rng.uniform() < 0.3
    depth, width, height = (sides[1], sides[2], sides[0]) if lying else (sides[0], sides[1], sides[2])
    if not lying and rng.uniform() < 0.25:
        width, height = height, width  # on its long narrow side
    half = 0.5 * BODY_EXTENT * np.array([depth, width, height])
    rounding = min(rng.uniform(0.005, 0.06), 0.4 * half.min())
    return {
        "is_open": False,
        "outline": np.tile([0.0, BASE_Z], (17, 1)),
        "box": np.array([*half, rounding]),
        "body_reach": half[:2],
        "top": BASE_Z + 2.0 * half[2],
    }


def _sample(seed: int, slack: float) -> dict[str, np.ndarray | float]:
    rng = np.random.default_rng([seed, 7])
    kind = int(rng.choice(len(KINDS), p=_KIND_WEIGHTS))
    shape = _carton(rng) if kind == CARTON else _vessel(rng, kind)
    has_handle = "tube" in shape
    absent_line = np.stack([np.linspace(0.0, 0.1, _TUBE), np.zeros(_TUBE)], axis=-1)
    reach, top = np.asarray(shape.pop("body_reach")), shape.pop("top")
    lower, upper = np.array([*-reach, BASE_Z]), np.array([*reach, top])
    if has_handle:
        tube, (radius, across) = np.asarray(shape["tube"]), np.asarray(shape["tube_section"])
        upper = np.maximum(upper, [tube[:, 0].max() + radius, radius + across, tube[:, 1].max() + radius])
    if "spout" in shape:
        spout = np.asarray(shape["spout"])
        lower = np.minimum(lower, [(spout[:, 0] - spout[:, 2]).min(), -spout[:, 2].max(), BASE_Z])
        upper = np.maximum(upper, [0.0, 0.0, (spout[:, 1] + spout[:, 2]).max()])
    while True:  # the part of the slack that stays well inside the box that rays are traced in
        scale = np.exp(slack * SLACK_LOG_SCALE * rng.standard_normal())
        shift = slack * SLACK_SHIFT * rng.standard_normal(2)
        if max(np.abs(scale * lower[:2] + shift).max(), np.abs(scale * upper[:2] + shift).max()) <= 1.2:
            break
    return {
        "tube": absent_line,
        "tube_section": np.array([_ABSENT, 0.0]),
        "spout": np.array([[0.0, 0.0, _ABSENT], [0.1, 0.0, _ABSENT]]),
        **shape,
        **_appearance(rng, kind, not shape["is_open"]),
        "kind": kind,
        "has_handle": has_handle,
        "half_extent_m": _largest_side_m(rng, kind) / BODY_EXTENT,
        "scale": scale,
        "shift": shift,
        "lower": lower,
        "upper": upper,
    }


def _as_object(fields: dict[str, np.ndarray]) -> TabletopObject:
    kinds = {"kind": np.int32, "texture": np.int32, "has_handle": bool, "is_open": bool}
    return TabletopObject(**{k: jnp.asarray(np.asarray(v, kinds.get(k, np.float32))) for k, v in fields.items()})


def sample_object(seed: int, slack: float = 1.0) -> TabletopObject:
    """The object of a seed; `slack` multiplies the placement's standard deviations (0: canonical)."""
    return _as_object({k: np.asarray(v) for k, v in _sample(seed, slack).items()})


def sample_objects(seeds: Sequence[int], slack: float = 1.0) -> TabletopObject:
    """The objects of several seeds, stacked along a leading axis."""
    samples = [_sample(int(seed), slack) for seed in seeds]
    return _as_object({k: np.stack([np.asarray(s[k]) for s in samples]) for k in samples[0]})
