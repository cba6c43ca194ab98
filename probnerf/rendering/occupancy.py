"""From opacity to *solid* space, on a voxel grid over the cube [-1, 1]^3.

Symbols: G voxels per axis, index order [i_x, i_y, i_z], voxel width 2/G, voxel centres at -1 + (i + 1/2) 2/G; cube
units throughout. The same operator gives a hypothesis' occupancy and the ground truth. For the ground truth, a wall is
a voxel that intersects the true solid.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import ArrayLike
from scipy import ndimage

from probnerf.types import BASE_Z

WALL_OPACITY = 0.5
_SIX_CONNECTED = ndimage.generate_binary_structure(3, 1)


def voxel_centres(grid: int) -> Float[np.ndarray, "G G G 3"]:
    """Centres of the voxels, f32, cube units."""
    axis = (-1.0 + (np.arange(grid) + 0.5) * 2.0 / grid).astype(np.float32)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def above_plane(grid: int) -> Bool[np.ndarray, "G"]:
    """Which voxel levels (last axis of a grid) are above the support plane: those whose centre is not below it.

    A level whose centre lies in the plane counts, as in `solid`. If the grid is a multiple of eight, there is none.
    """
    return _centre_z(grid) >= BASE_Z


def voxel_index(points: Float[ArrayLike, "... 3"], grid: int) -> Int[np.ndarray, "..."]:
    """Flat index (C order) of the voxel that holds each point (cube units); -1 for a point outside the cube."""
    points = np.asarray(points)
    inside, index = np.ones(points.shape[:-1], bool), np.zeros(points.shape[:-1], np.int64)
    for axis in range(3):
        p = points[..., axis]
        inside &= (p >= -1.0) & (p <= 1.0)
        # Clip, so that a point on the cube's upper faces belongs to the last voxel.
        index = index * grid + np.clip(np.floor((p + 1.0) * (0.5 * grid)), 0, grid - 1).astype(np.int64)
    return np.where(inside, index, -1)


def solid(
    opacity: Shaped[np.ndarray, "... G G G"], base: Float[ArrayLike, "..."] = BASE_Z
) -> Bool[np.ndarray, "... G G G"]:
    """Solid occupancy of opacity grids in the view frame: a float in [0, 1], or u8 as round(255 * opacity).

    Opacity >= 0.5 marks a wall. Walls are dilated by one voxel (6-connected). Every voxel that is not 6-connected to
    the outside of the cube through empty space becomes solid. An erosion then reverses the dilation. So a closed can is
    solid, and the cavity of an open cup is empty. (The filling must come between dilation and erosion: a closing alone
    cannot seal a pinhole in a wall of one or two voxels.)

    The support plane is not a wall: a shape with an open, unseen bottom stays open. A shape ends at `base`, on which it
    stands (z of the view frame), and nothing below is occupied. If `base` is above the measured plane, the table is
    higher than measured. The shape's lowest layer then continues down to the plane.
    """
    opacity = np.asarray(opacity)
    if opacity.ndim < 3 or len(set(opacity.shape[-3:])) != 1:
        raise ValueError(f"opacity has shape {opacity.shape}; its last three axes must be equal")
    threshold = WALL_OPACITY * (255.0 if opacity.dtype == np.uint8 else 1.0)
    walls = opacity >= threshold
    grid = opacity.shape[-1]
    flat = walls.reshape(-1, grid, grid, grid)
    filled = np.stack([_fill(wall) for wall in flat]) if len(flat) else flat
    # Last, not first, so that a bottom slightly below the plane still seals the object.
    bases = np.broadcast_to(np.asarray(base, np.float64), walls.shape[:-3]).ravel()
    level = _centre_z(grid)
    plane = np.searchsorted(level, BASE_Z)
    for shape, lowest in zip(filled, np.searchsorted(level, bases), strict=True):
        shape[..., : min(lowest, plane)] = False
        if plane < lowest < grid:
            shape[..., plane:lowest] = shape[..., lowest, None]
    return filled.reshape(walls.shape)


def voxel_surface(occupied: Bool[np.ndarray, "G G G"]) -> Float[np.ndarray, "n 3"]:
    """Centres of the voxel faces between occupied and empty space (outside the cube is empty), f64, cube units."""
    padded = np.pad(occupied, 1)
    width = 2.0 / occupied.shape[0]
    faces = []
    for axis in range(3):
        index = np.argwhere(np.diff(padded, axis=axis)).astype(np.float64)
        index -= 0.5  # voxel i of the padded grid has its centre at -1 + (i - 1/2) width
        index[:, axis] += 0.5
        faces.append(-1.0 + index * width)
    return np.concatenate(faces)


def coarsen(occupied: Bool[np.ndarray, "... G G G"], grid: int) -> Bool[np.ndarray, "... g g g"]:
    """Occupancy on a coarser grid: a large voxel is occupied if any voxel in it is."""
    factor, rest = divmod(occupied.shape[-1], grid)
    if rest or factor < 1:
        raise ValueError(f"a grid of {occupied.shape[-1]} voxels does not divide into {grid}")
    blocks = occupied.reshape(*occupied.shape[:-3], grid, factor, grid, factor, grid, factor)
    return np.asarray(blocks.any(axis=(-5, -3, -1)))


def _centre_z(grid: int) -> Float[np.ndarray, "G"]:
    return -1.0 + (np.arange(grid) + 0.5) * 2.0 / grid


def _fill(walls: Bool[np.ndarray, "G G G"]) -> Bool[np.ndarray, "G G G"]:
    """Dilate walls by one voxel, fill voxels that the outside cannot reach, erode by one voxel."""
    filled = np.zeros_like(walls)
    columns = np.any(walls, axis=2)
    if columns.any():
        occupied = (np.any(columns, axis=1), np.any(columns, axis=0), np.any(walls, axis=(0, 1)))
        sides = [np.flatnonzero(side) for side in occupied]
        box = tuple(slice(side[0], side[-1] + 1) for side in sides)  # bounding box of all walls; the rest is outside
        # a margin for the dilation, then a border of outside voxels
        grown = _dilate(np.pad(walls[box], 2))
        empty, _ = ndimage.label(~grown, structure=_SIX_CONNECTED)
        filled[box] = _erode(empty != empty[0, 0, 0])[2:-2, 2:-2, 2:-2]
    return filled


def _dilate(mask: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """6-connected dilation inside the array: six shifted ORs, about ten times faster than scipy here."""
    grown = mask.copy()
    for axis in range(3):
        target, source = np.moveaxis(grown, axis, 0), np.moveaxis(mask, axis, 0)
        target[1:] |= source[:-1]
        target[:-1] |= source[1:]
    return grown


def _erode(mask: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "X Y Z"]:
    """6-connected erosion. Voxels outside the array count as occupied."""
    return ~_dilate(~mask)
