"""Space that may be occupied at a chosen risk: its surface, for collision checkers, and the distance to it.

A voxel counts where its `marginal` probability of being occupied is above the risk. That is said of each voxel alone.
How likely a whole region is free, jointly over its voxels, only `query` tells.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy import ndimage

from perception.answers.hypotheses import Hypotheses
from perception.answers.query import marginal
from probnerf.rendering.occupancy import above_plane, coarsen, voxel_centres

MAX_CELLS = 15_000_000  # of a distance field
MAX_SAMPLES = 20_000_000  # of an object's voxels


def risky_surface(
    h: Hypotheses, risk: float, grid: int = 64
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Surface of all voxels with P(occupied) > risk: (vertices in metres in the object frame, triangles).

    It is that of `grid` voxels per axis at most; a wide voxel is occupied if one in it is. It follows the voxels'
    faces, as a smooth one would cut their corners off. Triangles turn counter-clockwise seen from outside. Where all
    is below the risk there are no vertices.
    """
    filled, width = (marginal(h) > risk).reshape(h.seen.shape), h.grid
    while width > grid and width % 2 == 0:
        width //= 2
    corners, faces = _voxel_faces(coarsen(filled, width))
    return (corners * 2.0 / width - 1.0) * h.object_frame.half_extent, faces


def _voxel_faces(filled: Bool[np.ndarray, "G G G"]) -> tuple[Int[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The faces between voxels that are filled and others as triangles between voxel corners, [0, G]."""
    padded, quads = np.pad(filled, 1).astype(np.int8), []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3  # u, v and the axis are right-handed
        square = np.zeros((4, 3), np.int64)
        square[:, u], square[:, v] = (0, 1, 1, 0), (0, 0, 1, 1)
        step = np.diff(padded, axis=axis)
        for sign, turn in ((-1, square), (1, square[::-1])):
            first = np.argwhere(step == sign)
            first[:, [u, v]] -= 1
            quads.append(first[:, None] + turn)
    corners, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    return corners, index.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int32)


def cells(
    h: Hypotheses, mask: Bool[np.ndarray, "V"], T_frame_camera: Float[np.ndarray, "4 4"], width: float
) -> tuple[Int[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Cells that an object's masked voxels reach: of each sample (its cell, the flat index of its voxel).

    Cells are cubes of `width` (m) along a frame's axes; cell (i, j, k) begins at width (i, j, k). A voxel is sampled so
    densely that no cell that lies within the mask is left out: a lattice of step s has a point in every cube with edges
    of sqrt(3) s, however that is turned. Raises ValueError for more than MAX_SAMPLES samples.
    """
    index = np.flatnonzero(mask)
    parts = int(np.ceil(np.sqrt(3.0) * h.voxel_m / width * (1 - 1e-9)))
    if len(index) * parts**3 > MAX_SAMPLES:
        raise ValueError(
            f"cells of {1000 * width:.2g} mm are too narrow for voxels of {1000 * h.voxel_m:.2g} mm: {len(index)} of"
            f" these would need {parts**3} samples each; ask for wider cells"
        )
    offset = ((np.arange(parts) + 0.5) / parts - 0.5) * 2.0 / h.grid
    offsets = np.stack(np.meshgrid(offset, offset, offset), axis=-1).reshape(-1, 3)
    centres = voxel_centres(h.grid).reshape(-1, 3)[index].astype(np.float64)
    points = h.object_frame.to_camera((centres[:, None] + offsets).reshape(-1, 3))
    points = points @ T_frame_camera[:3, :3].T + T_frame_camera[:3, 3]
    # Rounding must not throw samples on a border to either side.
    return np.floor(points / width + 1e-6).astype(np.int64), np.repeat(index, len(offsets))


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Signed distances on a lattice of cells along the axes of a frame."""

    first: Int[np.ndarray, "3"]  # the cell with the least coordinates; it begins at width * first
    width: float  # of a cell, metres
    distance: Float32[np.ndarray, "X Y Z"]  # metres from each cell's centre; negative inside; NaN: nothing was inferred


def distance_field(
    scene: Sequence[Hypotheses],
    T_frame_camera: Float[np.ndarray, "4 4"],
    box: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None,
    risk: float,
    width: float,
    farthest: float = 2.0,
    cleared: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]] | None = None,
) -> DistanceField:
    """Signed distance to where some object's P(occupied) is above the risk.

    `box` is (low, high) in metres in the frame; None: all cubes. Cells that it meets belong to it, and those that begin
    at its upper faces, as in nvblox. Distances are correct to the diagonal of a cell, reach to objects outside the box,
    and end at `farthest` (m). NaN is what lies outside of every object's cube, or in the table: nobody said anything
    about it. Where `cleared` holds of a cell's centre (m, in the frame) the cell is taken for free. Raises ValueError
    for a box that is empty, not finite or too large.
    """

    def all_cells(mask: Callable[[Hypotheses], Bool[np.ndarray, "V"]]) -> Int[np.ndarray, "n 3"]:
        return np.concatenate([cells(h, mask(h), T_frame_camera, width)[0] for h in scene])

    known, filled = all_cells(_above), all_cells(lambda h: marginal(h) > risk)
    if cleared is not None:
        filled = filled[~cleared((filled + 0.5) * width)]
    if box is None:
        first, last = known.min(axis=0), known.max(axis=0)
    else:
        low, high = (np.asarray(corner, np.float64) / width for corner in box)
        if not (np.isfinite([low, high]).all() and (low < high).all() and np.abs([low, high]).max() < 1e9):
            raise ValueError(f"the box {[np.asarray(corner).tolist() for corner in box]} is empty or not finite")
        first, last = (np.floor(corner + 1e-6).astype(np.int64) for corner in (low, high))
    known = known[np.all((known >= first) & (known <= last), axis=1)]
    distance = np.full(_count(first, last), np.nan, np.float32)
    if len(known):  # distances are worked out where there are objects alone
        every = np.concatenate([known, filled])
        start, end = every.min(axis=0), every.max(axis=0)
        occupied = np.zeros(_count(start, end), bool)
        occupied[tuple((filled - start).T)] = True
        own = _signed_cells(occupied)[tuple((known - start).T)] * width
        distance[tuple((known - first).T)] = np.clip(own, -farthest, farthest)
    return DistanceField(first, width, distance)


def _signed_cells(occupied: Bool[np.ndarray, "X Y Z"]) -> Float[np.ndarray, "X Y Z"]:
    """Distance of each cell to the border of what is occupied, in cells, negative inside; infinite where nothing is."""
    if not occupied.any():
        return np.full(occupied.shape, np.inf)
    outside = ndimage.distance_transform_edt(~occupied)
    inside = ndimage.distance_transform_edt(np.pad(occupied, 1))[1:-1, 1:-1, 1:-1]
    return np.where(occupied, 0.5 - inside, outside - 0.5)  # the border lies half a cell from the centres beside it


def _count(first: Int[np.ndarray, "3"], last: Int[np.ndarray, "3"]) -> tuple[int, int, int]:
    """Cells from the first to the last. Raises ValueError if they are too many."""
    x, y, z = (last - first + 1).tolist()
    if x * y * z > MAX_CELLS:
        raise ValueError(f"the box has {x} x {y} x {z} cells; ask for at most {MAX_CELLS}, or set wider ones")
    return x, y, z


def _above(h: Hypotheses) -> Bool[np.ndarray, "V"]:
    """The voxels above the table."""
    return np.broadcast_to(above_plane(h.grid), h.seen.shape).ravel()


def ends(h: Hypotheses) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Lowest and highest coordinates of each hypothesis (m, object frame); of an empty one the origin."""
    found = np.zeros((2, len(h.weights), 3))
    for s, shape in enumerate(h.solid):
        for axis in range(3):
            filled = np.flatnonzero(shape.any(axis=tuple({0, 1, 2} - {axis})))
            if len(filled):
                found[:, s, axis] = np.array([filled[0], filled[-1] + 1]) * h.voxel_m - h.object_frame.half_extent
    return found[0], found[1]


def edge_lengths(h: Hypotheses) -> Float[np.ndarray, "3"]:
    """How large the object is along each axis of its frame (m): the weighted median of the hypotheses."""
    low, high = ends(h)
    voxels = np.rint((high - low) / h.voxel_m)  # equal ones must be equal, or the median is any of them
    return np.quantile(voxels, 0.5, axis=0, weights=h.weights, method="inverted_cdf") * h.voxel_m
