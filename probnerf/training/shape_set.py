"""What a prior learns of solid shapes, sampled once and kept: points with their occupancy, surfaces with their colour.

One set holds objects of one family; the arrays are alike for all families, so training knows none of them.
"""

import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from foundation.one_line import one_line
from foundation.whole_file import whole_file

GRID, ANCHORS = 16, 6  # per axis: signed distances and colours that recognition reads
CLIP = 0.25  # cube units: signed distances beyond are alike
NEAR, ANYWHERE, SURFACE = 1536, 512, 512  # points of each object
OFFSET = (0.008, 0.12)  # cube units: range of the log-uniform scale of the near points' offsets from the surface
REACH = 1.25  # cube units: no point lies beyond
TABLETOP_NUMBERS, PAINT_NUMBERS = 153, 60  # lengths of `tabletop.description` and `Paint.description`


def centres(count: int) -> Float[np.ndarray, "n 3"]:
    """Centres of the cells of a count^3 grid in [-1, 1]^3."""
    at = (np.arange(count) + 0.5) * (2.0 / count) - 1.0
    return np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class ShapeSet:
    """N objects. Points are in units of REACH / 32767, normals of 1 / 127."""

    distance: np.ndarray  # f16 [N, GRID^3], cube units, clipped to CLIP
    points: np.ndarray  # i16 [N, NEAR + ANYWHERE, 3]
    inside: np.ndarray  # bool [N, NEAR + ANYWHERE]
    surface: np.ndarray  # i16 [N, SURFACE, 3]
    normal: np.ndarray  # i8 [N, SURFACE, 3]
    valid: np.ndarray  # bool [N, SURFACE]
    anchor: np.ndarray  # i16 [N, ANCHORS^3]: the surface point nearest to each cell's centre
    rgb: np.ndarray  # u8 [N, paints, SURFACE, 3], lit
    appearance: np.ndarray  # f16 [N, paints, .]: what else is known of the colours
    kind: np.ndarray  # u8 [N], index into KINDS

    def __len__(self) -> int:
        return len(self.kind)

    def __getitem__(self, rows: slice | np.ndarray) -> "ShapeSet":
        return ShapeSet(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    def save(self, path: Path) -> None:
        """Write atomically."""
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(file, **{f.name: getattr(self, f.name) for f in fields(self)})


def load_shapes(path: Path) -> ShapeSet:
    """Raises FileNotFoundError or ValueError where there is no such set."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if missing := [f.name for f in fields(ShapeSet) if f.name not in file]:
                raise ValueError(f"it lacks {', '.join(missing)}")
            return ShapeSet(**{f.name: file[f.name] for f in fields(ShapeSet)})
    except (zipfile.BadZipFile, zlib.error, EOFError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is no set of shapes ({one_line(error)[:200]}); remove it and make it again") from None


def joined(sets: Sequence[ShapeSet]) -> ShapeSet:
    """One set of the objects of several with equally many paints."""
    return ShapeSet(**{f.name: np.concatenate([getattr(s, f.name) for s in sets]) for f in fields(ShapeSet)})


def as_units(points: np.ndarray) -> np.ndarray:
    """Cube units as i16."""
    return np.round(np.clip(points, -REACH, REACH) * (32767.0 / REACH)).astype(np.int16)


def in_cube(units: np.ndarray) -> np.ndarray:
    """i16 as cube units."""
    return units.astype(np.float32) * np.float32(REACH / 32767.0)


def nearest(surface: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """The surface point nearest to the centre of each of ANCHORS^3 cells."""
    gap = 0.75 * centres(ANCHORS)[:, None] - surface[None]
    return np.argmin(np.einsum("asi,asi->as", gap, gap), axis=1).astype(np.int16)


class ShapeBatch(eqx.Module):
    """What one step reads of b objects."""

    distance: Float[Array | np.ndarray, "b g"]  # of 1 / CLIP cube units
    anchor_rgb: Float[Array | np.ndarray, "b a"]
    appearance: Float[Array | np.ndarray, "b p"]
    points: Float[Array | np.ndarray, "b n 3"]
    inside: Array | np.ndarray  # bool [b, n]
    surface: Float[Array | np.ndarray, "b m 3"]
    normal: Float[Array | np.ndarray, "b m 3"]
    rgb: Float[Array | np.ndarray, "b m 3"]
    valid: Array | np.ndarray  # bool [b, m]

    @property
    def description(self) -> Float[Array, "b d"]:
        """What recognition reads."""
        return jnp.concatenate([self.distance, self.anchor_rgb, self.appearance], axis=1)


def points_of_others(
    solids: ShapeBatch, key: PRNGKeyArray, count: int
) -> tuple[Float[Array, "b m 3"], Bool[Array, "b m"], Bool[Array, "b m"]]:
    """Points that other objects of the batch were asked at, whether each is inside this one, and whether that is sure.

    An object's own points are near its surface, or anywhere, and seldom where only *other* objects are solid (a
    handle). A decoder that learns from them alone gives a cup without a handle one. A distance changes by no more than
    the way from the centres about it where it is known: where these do not tell the side, it is not sure.
    """
    k0, k1 = jax.random.split(key)
    points = jnp.asarray(solids.points)
    size, own = points.shape[:2]
    other = (jnp.arange(size)[:, None] + jax.random.randint(k0, (size, count), 1, max(size, 2))) % size
    points = points[other, jax.random.randint(k1, (size, count), 0, own)]
    below = jnp.clip(jnp.floor((points + 1.0) * (GRID / 2.0) - 0.5).astype(jnp.int32), 0, GRID - 2)
    least, most = jnp.full(points.shape[:2], -jnp.inf), jnp.full(points.shape[:2], jnp.inf)
    for corner in np.ndindex(2, 2, 2):
        cell = below + np.array(corner)
        way = jnp.linalg.norm(points - ((cell + 0.5) * (2.0 / GRID) - 1.0), axis=-1)
        at = (cell[..., 0] * GRID + cell[..., 1]) * GRID + cell[..., 2]
        distance = CLIP * jnp.take_along_axis(jnp.asarray(solids.distance), at, axis=1)
        least, most = jnp.maximum(least, distance - way), jnp.minimum(most, distance + way)
    return points, most < 0.0, (least > 0.0) | (most < 0.0)


DESCRIPTION = GRID**3 + 3 * ANCHORS**3 + PAINT_NUMBERS + TABLETOP_NUMBERS


def draw_shapes(
    sets: Sequence[tuple[ShapeSet, float]], rng: np.random.Generator, size: int, points: int, colours: int
) -> ShapeBatch:
    """A batch: each object's set by the shares, then any object of it."""
    shares = np.array([share for _, share in sets])
    counts = rng.multinomial(size, shares / shares.sum())
    parts = [
        batch_of(each, rng, rng.choice(len(each), count, replace=len(each) < count), points, colours)
        for (each, _), count in zip(sets, counts, strict=True)
        if count
    ]
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def batch_of(
    shapes: ShapeSet,
    rng: np.random.Generator,
    rows: np.ndarray,
    points: int,
    colours: int,
    paint: np.ndarray | None = None,
) -> ShapeBatch:
    """A batch of these objects, each in any of its paints (or in this one). Three quarters of the points are near the
    surface.
    """
    size, near = len(rows), 3 * points // 4
    paint = rng.integers(0, shapes.rgb.shape[1], size) if paint is None else paint
    each = np.arange(size)[:, None]
    at = rows[:, None]
    point = np.concatenate(
        [rng.integers(0, NEAR, (size, near)), rng.integers(NEAR, NEAR + ANYWHERE, (size, points - near))], axis=1
    )
    spot = rng.integers(0, SURFACE, (size, colours))
    rgb = shapes.rgb[rows, paint].astype(np.float32) / 255.0
    return ShapeBatch(
        distance=shapes.distance[rows].astype(np.float32) / CLIP,
        anchor_rgb=2.0 * rgb[each, shapes.anchor[rows]].reshape(size, -1) - 1.0,
        appearance=shapes.appearance[rows, paint].astype(np.float32),
        points=in_cube(shapes.points[at, point]),
        inside=shapes.inside[at, point],
        surface=in_cube(shapes.surface[at, spot]),
        normal=shapes.normal[at, spot].astype(np.float32) / 127.0,
        rgb=rgb[each, spot],
        valid=shapes.valid[at, spot],
    )
