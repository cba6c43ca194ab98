"""Rays from one point through a voxel grid over the cube [-1, 1]^3: crossings with a box, and voxel values there.

Symbols: G voxels per axis, n rays, k steps of one length along each; cube units.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy.typing import ArrayLike

_SAMPLES = 500_000  # points per chunk of lookups


def crossed(
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distances at which each ray enters and leaves a box. If it misses, the first is larger than the second."""
    d = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    a, b = (low - origin) / d, (high - origin) / d
    return np.maximum(np.minimum(a, b).max(axis=1), 0.0), np.maximum(a, b).min(axis=1)


def nearest(bordered: Shaped[np.ndarray, "..."], *coordinates: Float[np.ndarray, "..."]) -> np.ndarray:
    """The voxel values at points of the cube (or square). Points outside have the border's value.

    `bordered` holds the voxels with one more on each side: `np.pad(values, 1)`. Coordinates are clipped to that border.
    """
    wide = bordered.shape[0]
    index = np.zeros((), np.int32)
    for p in coordinates:
        index = index * wide + np.clip((p + 1.0) * (0.5 * (wide - 2)) + 1.0, 0, wide - 1).astype(np.int32)
    return bordered.ravel()[index]


def met(
    bordered: Shaped[np.ndarray, "G+2 G+2 G+2"],
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
    step: float,
    first: float = 0.0,
    low: Float[ArrayLike, "3"] = (-1.0, -1.0, -1.0),
    high: Float[ArrayLike, "3"] = (1.0, 1.0, 1.0),
) -> Iterator[tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m k"], Shaped[np.ndarray, "m k"]]]:
    """Yields (rays, distances, values there) in chunks of rays that cross a box: the cube, or low to high.

    Directions are unit vectors. Distances start `first` steps after the ray enters the box. They increase in steps of
    `step` voxels, at least until it leaves the box. Points are computed in f32.
    """
    near, far = crossed(origin, directions, np.asarray(low), np.asarray(high))
    rays = np.flatnonzero(far > near)
    if not len(rays):
        return
    length = step * 2.0 / (bordered.shape[0] - 2)
    steps = length * (np.arange(int(np.ceil((far - near)[rays].max() / length)) + 1) + first)
    origin, directions = origin.astype(np.float32), directions.astype(np.float32)
    for part in np.array_split(rays, max(1, len(rays) * len(steps) // _SAMPLES)):
        t = near[part, None] + steps
        at = t.astype(np.float32)
        points = (at * d[:, None] + o for o, d in zip(origin, directions[part].T, strict=True))
        yield part, t, nearest(bordered, *points)
