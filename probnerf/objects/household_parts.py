"""Parts of household things as closed solids: lathes, tubes, boxes, superquadrics, plates, and vessels with walls.

Metres, z up. Sections are planar: (r, z) of a lathe, (x, y) of a plate, (x, z) of a path. Booleans are exact
(manifold3d), so walls and handles stay as thin as they are drawn.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection as Section
from manifold3d import JoinType, Mesh64, OpType
from manifold3d import Manifold as Solid
from scipy.interpolate import PchipInterpolator

Triple = Sequence[float] | Float[np.ndarray, "3"]
Warp = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]

SEGMENTS = 60  # around a lathe: corners of polygons of 4, 5, 6, 10 and 12 sides fall on vertices


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def union(parts: Sequence[Solid]) -> Solid:
    """The solid of all parts together."""
    return Solid.batch_boolean(list(parts), OpType.Add)


# ---------------------------------------------------------------------------------------------------- sections


def smooth(knots: Sequence[tuple[float, float]], count: int = 24) -> Float[np.ndarray, "count 2"]:
    """A smooth curve through planar knots that does not overshoot: monotone cubics over the chord length."""
    points = np.asarray(knots, float)
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return PchipInterpolator(chord, points)(np.linspace(0.0, chord[-1], count))


def arc(
    centre: tuple[float, float], radii: tuple[float, float], start: float, end: float, count: int = 20
) -> Float[np.ndarray, "count 2"]:
    """Points of an elliptic arc; angles in degrees."""
    angle = np.radians(np.linspace(start, end, count))
    return np.asarray(centre) + np.stack([radii[0] * np.cos(angle), radii[1] * np.sin(angle)], axis=-1)


def stroke(path: Float[np.ndarray, "n 2"], radius: float | Float[np.ndarray, "n"]) -> Section:
    """The planar region within `radius` of a path; a radius for each point tapers it."""
    radii = np.broadcast_to(radius, len(path))
    discs = [
        Section.circle(float(r), 24).translate((float(x), float(y))) for (x, y), r in zip(path, radii, strict=True)
    ]
    pieces = [Section.batch_hull([a, b]) for a, b in pairwise(discs)]
    return Section.batch_boolean(pieces, OpType.Add)


def disc(radius: float, at: tuple[float, float] = (0.0, 0.0)) -> Section:
    """A planar disc."""
    return Section.circle(radius, 48).translate(at)


def rectangle(low: tuple[float, float], high: tuple[float, float], rounding: float = 0.0) -> Section:
    """A planar rectangle, its corners rounded by a radius."""
    size = (high[0] - low[0], high[1] - low[1])
    section = Section.square(size).translate(low)
    return section.offset(-rounding).offset(rounding, JoinType.Round, 2.0, 32) if rounding > 0.0 else section


def plate(section: Section, thickness: float, upright: bool = False) -> Solid:
    """A section made thick about its plane: (x, y) lying, or (x, z) where it is upright."""
    solid = Solid.extrude(section, thickness).translate((0.0, 0.0, -0.5 * thickness))
    return solid.rotate((90.0, 0.0, 0.0)) if upright else solid


# ------------------------------------------------------------------------------------------------------ solids


def _mirrored(outline: Float[np.ndarray, "n 2"]) -> Section:
    return Section([np.concatenate([outline, outline[::-1] * [-1.0, 1.0]])])


def lathe(outline: Float[np.ndarray, "n 2"], warp: Warp | None = None) -> Solid:
    """The solid of revolution about z below an outline (r, z) from its base to its top."""
    solid = Solid.revolve(_mirrored(outline), SEGMENTS)
    return solid.warp_batch(warp) if warp else solid


def vessel(
    outline: Float[np.ndarray, "n 2"],
    wall: float,
    floor: float,
    warp: Warp | None = None,
    extras: Sequence[Solid] = (),
    bores: Sequence[Solid] = (),
) -> Solid:
    """A lathe hollowed from its mouth down to z = `floor`, with handles or spouts that do not reach inside.

    outline: (r, z) of the outer surface from the base to the rim. wall: its thickness across the surface.
    warp: deforms body and cavity alike. extras are united with the body before cavity and bores are cut.
    """
    mouth = np.asarray([[outline[-1, 0], outline[-1, 1] + 2.0 * wall]])
    inner = _mirrored(np.concatenate([outline, mouth])).offset(-wall, JoinType.Round, 2.0, 24)
    inner ^= Section.square((2.0, 2.0)).translate((-1.0, floor))
    cavity = max(inner.decompose(), key=lambda part: part.bounds()[3])  # a pinched one is not reached from the mouth
    hole = Solid.revolve(cavity, SEGMENTS)
    hole = hole.warp_batch(warp) if warp else hole
    return union([lathe(outline, warp), *extras]) - union([hole, *bores])


def tube(
    path: Float[np.ndarray, "n 2"],
    across: float | Float[np.ndarray, "n"],
    along_y: float | Float[np.ndarray, "n"] | None = None,
    exponent: float = 2.0,
) -> Solid:
    """A superelliptic section swept along a path (x, z) at y = 0.

    across: half thickness in the path's plane. along_y: half width (default: the same). exponent: 2 is an ellipse,
    more is squarer. The path's radius of curvature should exceed `across`.
    """
    sides, n = 20, len(path)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    a = np.broadcast_to(across, n)
    b = np.broadcast_to(across if along_y is None else along_y, n)
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1.0 / exponent)
    in_plane = path[:, None] + (a[:, None] * (radius * c))[..., None] * normal[:, None]
    y = b[:, None] * (radius * s)
    rings = np.stack([in_plane[..., 0], y, in_plane[..., 1]], axis=-1).reshape(-1, 3)
    ends = np.asarray([[path[0, 0], 0.0, path[0, 1]], [path[-1, 0], 0.0, path[-1, 1]]])
    ring, side = np.arange(n - 1)[:, None] * sides, np.arange(sides)
    low, following = ring + side, ring + (side + 1) % sides
    quads = ((low, low + sides, following), (following, low + sides, following + sides))
    faces = np.concatenate([np.stack(quad, axis=-1).reshape(-1, 3) for quad in quads])
    first, last, turned = np.full(sides, n * sides), np.full(sides, n * sides + 1), (side + 1) % sides
    rim = (n - 1) * sides
    caps = [np.stack([first, side, turned], axis=-1), np.stack([last, rim + turned, rim + side], axis=-1)]
    faces = np.concatenate([faces, *caps]).astype(np.uint64)
    return Solid(Mesh64(np.concatenate([rings, ends]), faces))


def capsule(start: Triple, end: Triple, radius: float, end_radius: float | None = None) -> Solid:
    """The hull of two balls."""
    balls = [
        Solid.sphere(r, 24).translate(tuple(map(float, p)))
        for p, r in ((start, radius), (end, radius if end_radius is None else end_radius))
    ]
    return Solid.batch_hull(balls)


def superquadric(half_sides: Triple, upright: float = 1.0, around: float = 1.0, segments: int = 40) -> Solid:
    """A superellipsoid at the origin; exponents as in Barr (1981): 1 is an ellipsoid, towards 0 a box."""

    def stretch(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        radius = np.linalg.norm(p[:, :2], axis=1, keepdims=True)
        flat = np.abs(p[:, :2] / np.maximum(radius, 1e-12)) ** around * radius**upright
        return np.sign(p) * np.concatenate([flat, np.abs(p[:, 2:]) ** upright], axis=1) * np.asarray(half_sides)

    return Solid.sphere(1.0, segments).warp_batch(stretch)


def rounded_box(size: Triple, rounding: float = 0.0, chamfered: bool = False, taper: float = 1.0) -> Solid:
    """A box centred on the z axis that stands on z = 0, its edges rounded or chamfered; `taper` scales its top."""
    half = np.asarray(size, float) / 2.0
    rounding = min(rounding, 0.99 * half.min())
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    corners = signs * (half - rounding)
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    if rounding > 0.0 and not chamfered:
        directions = Solid.sphere(1.0, 16).to_mesh64().vert_properties[:, :3]
    points = (corners[:, None] + rounding * directions).reshape(-1, 3)
    height = (points[:, 2:] + half[2]) / size[2]
    points = np.concatenate([points[:, :2] * (1.0 + (taper - 1.0) * height), points[:, 2:] + half[2]], axis=1)
    return Solid.hull_points(np.unique(points, axis=0))


def rod(radius: float, start: float, end: float, end_radius: float | None = None, segments: int = 40) -> Solid:
    """A cylinder or cone along x from `start` to `end`."""
    solid = Solid.cylinder(end - start, radius, radius if end_radius is None else end_radius, segments)
    return solid.rotate((0.0, 90.0, 0.0)).translate((start, 0.0, 0.0))


# ------------------------------------------------------------------------------------------------ deformations


def bent(solid: Solid, curvature: float, step: float) -> Solid:
    """Bent in the xz plane: the x axis becomes a circle through the origin that rises where `curvature` (1/m) > 0.

    step: the longest edge (metres) left before bending.
    """
    if abs(curvature) < 1e-3:
        return solid

    def bend(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        angle, radius = p[:, 0] * curvature, 1.0 / curvature - p[:, 2]
        return np.stack([radius * np.sin(angle), p[:, 1], 1.0 / curvature - radius * np.cos(angle)], axis=1)

    return solid.refine_to_length(step).warp_batch(bend)


def lumpy(solid: Solid, rng: np.random.Generator, strength: float) -> Solid:
    """Slightly irregular: displaced by a smooth random field of relative size `strength`."""
    low_x, low_y, low_z, high_x, high_y, high_z = solid.bounding_box()
    size = max(high_x - low_x, high_y - low_y, high_z - low_z)
    waves, phases = rng.normal(0.0, 4.0 / size, (3, 3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))

    def displace(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return p + strength * size / 3.0 * np.sin(np.einsum("nk,ijk->nij", p, waves) + phases).sum(axis=2)

    return solid.warp_batch(displace)


def section_warp(rng: np.random.Generator, plain: float, even: bool = False) -> Warp | None:
    """A cross-section for a lathe: round with probability `plain`, else squircle, polygon, flutes or ellipse.

    Radii at azimuth 0 stay; where `even`, those at azimuth pi stay too.
    """
    if rng.random() < plain:
        return None
    style = rng.integers(4)
    exponent = rng.uniform(2.5, 7.0)
    sides = int(rng.choice([4, 6, 10, 12] if even else [4, 5, 6, 10, 12]))
    blend = rng.uniform(0.5, 1.0)
    depth, flutes = rng.uniform(0.02, 0.07), 2 * int(rng.integers(2, 6))
    flatness = rng.uniform(0.55, 0.9)

    def factor(angle: np.ndarray) -> np.ndarray:
        if style == 0:
            return (np.abs(np.cos(angle)) ** exponent + np.abs(np.sin(angle)) ** exponent) ** (-1.0 / exponent)
        if style == 1:
            step = 2.0 * np.pi / sides
            edge = 1.0 / np.cos((angle + step / 2.0) % step - step / 2.0)
            return 1.0 + blend * (edge - 1.0)
        return 1.0 + depth * (np.cos(flutes * angle) - 1.0) if style == 2 else np.ones_like(angle)

    def warp(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        scale = factor(np.arctan2(p[:, 1], p[:, 0]))
        return np.stack([p[:, 0] * scale, p[:, 1] * scale * (flatness if style == 3 else 1.0), p[:, 2]], axis=1)

    return warp
