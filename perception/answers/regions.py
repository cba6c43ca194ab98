"""Regions of a planner's queries, metres, in the frame of the query."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_fill_holes

REACH = 1e6  # m; a region may lie so far from the frame's origin. Farther, sizes and volumes overflow
MOST_CELLS = 20_000_000  # of the box about a mesh
_MOST_POINTS, _POINTS_AT_ONCE = 20_000_000, 1_000_000  # of a mesh's triangles, half a cell apart
_MESHES = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")  # trimesh unpacks archives, too


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the frame of the question, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not np.all(np.abs([self.low, self.high]) <= REACH):  # a NaN is not
            raise ValueError(
                f"the box {[*self.low, *self.high]} has a number that is not finite, or beyond {REACH:g}; "
                "give six, in metres"
            )
        for axis, low, high in zip("xyz", self.low, self.high, strict=True):
            if not low < high:
                raise ValueError(
                    f"the box is empty: {axis}1 = {high:g} is not greater than {axis}0 = {low:g}; "
                    "give x0 y0 z0 x1 y1 z1 in metres"
                )


@dataclass(frozen=True, eq=False)
class Points:
    """N >= 1 points in the frame of the question, metres."""

    points: Float[np.ndarray, "N 3"]

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not len(self.points):
            raise ValueError(f"points have shape {list(self.points.shape)}; give [N, 3] with N >= 1, in metres")
        if not (near := np.all(np.abs(self.points) <= REACH, axis=1)).all():
            row = int(np.flatnonzero(~near)[0])
            raise ValueError(f"point {row + 1} is {self.points[row].tolist()}; give numbers up to {REACH:g}, in metres")


@dataclass(frozen=True, eq=False)
class Swept:
    """The union of N >= 1 boxes that may be turned, such as what a gripper sweeps.

    A box thinner than a voxel of the object that it meets counts as one voxel thick.
    """

    T_frame_box: Float[np.ndarray, "N 4 4"]  # p_frame = T_frame_box @ p_box; the box's middle is its origin, metres
    size: Float[np.ndarray, "N 3"]  # lengths of its edges, metres

    def __post_init__(self) -> None:
        T, size = self.T_frame_box, self.size
        if T.ndim != 3 or T.shape[1:] != (4, 4) or not len(T) or size.shape != (len(T), 3):
            raise ValueError(
                f"boxes have poses {list(T.shape)} and sizes {list(size.shape)}; give [N, 4, 4] and [N, 3]"
            )
        if not ((np.abs(T) <= REACH).all() and ((size > 0) & (size <= REACH)).all()):
            raise ValueError(f"a box's pose is not finite, an edge is not longer than 0 m, or beyond {REACH:g} m")

    def holds(self, box: int, *axes: Float[np.ndarray, "..."], thicker: float = 0.0) -> Bool[np.ndarray, "..."]:
        """Whether points, given by coordinates that broadcast, lie in a box whose edges are at least `thicker` long."""
        T, half = np.linalg.inv(self.T_frame_box[box])[:3], 0.5 * np.maximum(self.size[box], thicker)
        inside = np.ones((), bool)
        for (a, b, c, d), h in zip(T, half, strict=True):
            inside = inside & (np.abs(a * axes[0] + b * axes[1] + (c * axes[2] + d)) <= h)
        return inside


@dataclass(frozen=True, eq=False)
class Cells:
    """The union of N >= 1 equal cubes on a lattice, such as the inside of a mesh (`read_mesh`)."""

    centres: Float[np.ndarray, "N 3"]  # in the frame of the question, metres
    width: float  # of a cube, metres

    def __post_init__(self) -> None:
        Points(self.centres)
        if not 0 < self.width <= REACH:
            raise ValueError(f"cells are {self.width:g} m wide; give more than 0 and up to {REACH:g}")


Region = Box | Points | Swept | Cells


def moved(region: Box | Points | Swept, T_other_frame: Float[np.ndarray, "4 4"]) -> Points | Swept:
    """The same region in another frame: p_other = T_other_frame @ p_frame. A box becomes one that may be turned."""
    if isinstance(region, Points):
        return Points(region.points @ T_other_frame[:3, :3].T + T_other_frame[:3, 3])
    if isinstance(region, Swept):
        return Swept(T_other_frame @ region.T_frame_box, region.size)
    T = np.eye(4)
    T[:3, 3] = 0.5 * np.add(region.low, region.high)
    return Swept((T_other_frame @ T)[None], np.subtract(region.high, region.low)[None])


def read_points(path: str | Path) -> Points:
    """Read an .xyz file: one point a line, x y z in metres; further columns and # comments are ignored.

    Raises FileNotFoundError, or ValueError naming the line.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a text file with x y z (metres) on each line")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not a text file; write x y z (metres) on each line") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.partition("#")[0].strip()]
    if not lines:
        raise ValueError(f"{path} holds no points; write x y z (metres) on each line")
    unread = iter(lines)
    try:
        points = np.loadtxt((line for _, line in unread), usecols=(0, 1, 2), ndmin=2)
    except ValueError:
        number, line = lines[-1 - len(list(unread))]
        raise ValueError(f"{path}, line {number}: '{line[:60]}' is not a point; write x y z (metres)") from None
    if not (finite := np.isfinite(points).all(axis=1)).all():
        number, line = lines[int(finite.argmin())]
        raise ValueError(f"{path}, line {number}: '{line[:60]}' is not finite; remove the line")
    return Points(points)


def read_mesh(path: Path, width: float) -> Cells:
    """The region of a mesh file (.obj, .stl, .ply, .off, .glb; metres), in its own frame: cells that its surface meets
    or encloses. A surface with an opening wider than a cell encloses nothing there.

    Raises FileNotFoundError, or ValueError if the file holds no triangles or would fill more than `MOST_CELLS`.
    """
    import trimesh

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a mesh (.obj, .stl, .ply, .off or .glb, in metres)")
    if path.suffix.lower() not in _MESHES:
        raise ValueError(f"{path} is no mesh by its name; give a {', '.join(_MESHES)} file, in metres")
    try:
        mesh = trimesh.load_mesh(path, process=False)  # processing drops vertices that are not finite
    except Exception as error:  # the formats' readers raise various types
        raise ValueError(f"{path} cannot be read as a mesh ({error}); export it again as .obj, .stl or .ply") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise ValueError(f"{path} holds no triangles; export it as a triangle mesh (points go to --points)")
    if not (near := (np.abs(mesh.vertices) <= REACH).all(axis=1)).all():
        row, numbers = int(np.flatnonzero(~near)[0]), f"give finite numbers up to {REACH:g}, in metres"
        raise ValueError(f"{path}: vertex {row + 1} is {mesh.vertices[row].tolist()}; {numbers}")
    cells = float(np.prod(np.ceil(mesh.extents / width) + 1))
    if cells > MOST_CELLS:
        size = " x ".join(f"{e:g}" for e in mesh.extents)
        raise ValueError(
            f"{path} is {size} m large: too large to be filled with cells of {width:g} m; is it in metres?"
        )
    if not 0 <= int(mesh.faces.min()) <= int(mesh.faces.max()) < len(mesh.vertices):
        raise ValueError(f"{path} has a triangle of a vertex that is not there; export it again")
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    met = _met(corners, width)
    if met is None:
        raise ValueError(
            f"{path} has {len(mesh.faces)} triangles that meet too many cells of {width:g} m; keep what is near the"
            " objects, or simplify it (is it in metres?)"
        )
    grid, first = met
    return Cells(width * (np.argwhere(binary_fill_holes(grid)) + first), width)


def _met(corners: Float[np.ndarray, "f 3 3"], width: float) -> tuple[Bool[np.ndarray, "x y z"], np.ndarray] | None:
    """The cells about whole multiples of `width` that triangles meet, and the first one's; None if they are too many.

    By points of each triangle in rows along its longest edge, no more than half a cell apart.
    """
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # from each corner to the next
    turn = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, apex = np.moveaxis(np.take_along_axis(corners, turn[:, :, None], axis=1), 1, 0)
    height = np.linalg.norm(np.cross(b - a, apex - a), axis=1) / np.maximum(edges.max(axis=1), 1e-300)
    across, down = (np.ceil(np.maximum(length / (0.5 * width), 1.0)) for length in (edges.max(axis=1), height))
    counts = (across + 1) * (down + 1)
    if counts.sum() > _MOST_POINTS:
        return None
    low, high = (np.rint(bound(corners, axis=(0, 1)) / width).astype(int) for bound in (np.min, np.max))
    grid = np.zeros(high - low + 1, bool)
    chunk = np.cumsum(counts) // _POINTS_AT_ONCE
    for rows in np.split(np.arange(len(corners)), np.flatnonzero(np.diff(chunk)) + 1):
        each = counts[rows].astype(int)
        row = np.repeat(rows, each)
        number = np.arange(len(row)) - np.repeat(np.cumsum(each) - each, each)
        v, u = np.divmod(number, across[row].astype(int) + 1)
        along = a[row] + (u / across[row])[:, None] * (b - a)[row]
        points = apex[row] + (v / down[row])[:, None] * (along - apex[row])
        grid[tuple((np.rint(points / width).astype(int) - low).T)] = True
    return grid, low
