"""Triangle meshes as objects of the cube: how one stands, what of it is solid, and where its surface is.

Canonical frame (cube units): z up, the object rests on z = BASE_Z, the principal horizontal axis of its surface along
x with the longer tail (positive third moment; a handle, as a rule) at +x. The middle of the horizontal bounding box is
at x = y = 0. The larger of its longest horizontal side and its height is BODY_EXTENT. A round or square object's yaw
is ambiguous, and stays so.

Solid: points with a generalised winding number above 1/2 (Jacobson et al. 2013), which also holds for meshes with
holes, overlaps or inner faces, where the parity of crossings is wrong. An open sheet or a blade has no inside that a
voxel could hold. It gets a wall of one voxel of a 64^3 grid.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import igl
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from trimesh.ray.ray_pyembree import RayMeshIntersector

from probnerf.types import BASE_Z, BODY_EXTENT

WALL = 2.0 / 64  # cube units: thickness of what is thinner
SMALLEST, LARGEST = 0.01, 0.6  # m: longest sides of things on tables
MOST_FACES = 200_000


@dataclass(frozen=True, eq=False)
class MeshObject:
    """One object in its canonical frame."""

    vertices: Float[np.ndarray, "v 3"]  # cube units
    faces: Int[np.ndarray, "f 3"]
    half_extent: float  # metres per cube unit
    kind: str  # one of shape_kinds.KINDS
    name: str

    @cached_property
    def normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit normals of the faces; zeros where a face has no area."""
        cross = np.cross(self._corner(1) - self._corner(0), self._corner(2) - self._corner(0))
        return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)

    @cached_property
    def areas(self) -> Float[np.ndarray, "f"]:
        """Areas of the faces, square cube units."""
        cross = np.cross(self._corner(1) - self._corner(0), self._corner(2) - self._corner(0))
        return 0.5 * np.linalg.norm(cross, axis=1)

    @cached_property
    def thickness(self) -> Float[np.ndarray, "f"]:
        """Length of the ray from each face's centre into the object; inf where it meets no other face."""
        mesh = trimesh.Trimesh(self.vertices, self.faces, process=False)
        centres = self.vertices[self.faces].mean(axis=1)
        start = centres - 1e-4 * self.normals
        thickness = np.full(len(self.faces), np.inf)
        where, ray, _ = RayMeshIntersector(mesh).intersects_location(start, -self.normals, multiple_hits=False)
        thickness[ray] = np.linalg.norm(where - centres[ray], axis=1)
        return thickness

    @cached_property
    def is_thin(self) -> Bool[np.ndarray, "f"]:
        """Faces of walls thinner than WALL, and of open sheets (no wall behind them)."""
        return (self.thickness < WALL) | np.isinf(self.thickness)

    def _corner(self, i: int) -> Float[np.ndarray, "f 3"]:
        return self.vertices[self.faces[:, i]]

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance to the solid's surface (cube units), negative inside. Exact but near thickened walls."""
        points = np.ascontiguousarray(points, np.float64)
        distance = _distance(points, self.vertices, self.faces)
        winding = igl.fast_winding_number(self.vertices, self.faces, points)
        signed = np.where(winding > 0.5, -distance, distance)
        if self.is_thin.any():
            signed = np.minimum(signed, _distance(points, self.vertices, self.faces[self.is_thin]) - 0.5 * WALL)
        return signed

    def surface(
        self, rng: np.random.Generator, count: int
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Surface points and their unit normals. Half are drawn by area, half by area over thickness."""
        thin = np.clip(np.where(np.isinf(self.thickness), WALL, self.thickness), WALL, 0.5)
        shares = self.areas / self.areas.sum() + (self.areas / thin) / (self.areas / thin).sum()
        face = rng.choice(len(self.faces), count, p=shares / shares.sum())
        a, b = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1.0 - a, a * (1.0 - b), a * b], axis=-1)
        points = np.einsum("nc,nci->ni", weights, self.vertices[self.faces[face]])
        return points, self.normals[face]


def _distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(igl.point_mesh_squared_distance(points, vertices, faces)[0], 0.0))


def resting_poses(mesh: trimesh.Trimesh) -> tuple[Float[np.ndarray, "p 4 4"], Float[np.ndarray, "p"]]:
    """Poses in which the mesh may rest on a plane, and their probabilities (those of a fall from a random turn)."""
    # the surface's centroid: most things are shells, and a mesh with holes has no centre of mass (trimesh would search
    # for one inside the hull for ever)
    transforms, shares = trimesh.poses.compute_stable_poses(mesh, center_mass=mesh.centroid, n_samples=1)
    if not len(shares):
        return np.eye(4)[None], np.ones(1)
    return np.asarray(transforms), np.asarray(shares) / np.sum(shares)


def canonical(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], kind: str = "other", name: str = ""
) -> MeshObject:
    """The object of a mesh that stands as it is (metres, z up)."""
    vertices, faces = np.asarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    corners = vertices[faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not areas.sum() > 0:
        raise ValueError(f"{name}: its faces have no area")
    middles, share = corners.mean(axis=1)[:, :2], areas / areas.sum()
    centred = middles - share @ middles
    # within-face spread matters where faces are large: the corners' spread about the face's middle, over 12
    spread = corners[..., :2] - corners[..., :2].mean(axis=1, keepdims=True)
    moment = (centred * share[:, None]).T @ centred + np.einsum("f,fci,fcj->ij", share, spread, spread) / 12.0
    axis = np.linalg.eigh(moment)[1][:, 1]
    if share @ (centred @ axis) ** 3 < 0.0:
        axis = -axis
    turn = np.array([[axis[0], axis[1], 0.0], [-axis[1], axis[0], 0.0], [0.0, 0.0, 1.0]])
    turned = vertices @ turn.T
    used = turned[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    half_extent = float((high - low).max()) / BODY_EXTENT
    middle = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    placed = (turned - middle) / half_extent + [0.0, 0.0, BASE_Z]
    return MeshObject(placed, faces, half_extent, kind, name)


def rests(mesh: trimesh.Trimesh, rng: np.random.Generator, natural: float, stretch: float) -> trimesh.Trimesh:
    """The mesh (metres, its natural up is z), stretched at random along its axes, in a random resting pose.

    `natural` is the probability that it stands as it is; `stretch` the standard deviation of each axis's log scale.
    """
    placed = mesh.copy()
    placed.apply_transform(np.diag([*np.exp(stretch * rng.standard_normal(3)), 1.0]))
    if rng.random() >= natural:
        transforms, shares = resting_poses(placed)
        placed.apply_transform(transforms[rng.choice(len(shares), p=shares)])
    return placed


Y_UP = (".glb", ".gltf")


def mesh_files(folder: Path) -> list[Path]:
    """The folder's mesh files by name. Raises FileNotFoundError if there is none."""
    files = sorted(f for f in Path(folder).iterdir() if f.suffix.lower() in (*Y_UP, ".obj", ".ply", ".stl"))
    if not files:
        raise FileNotFoundError(f"{folder} holds no meshes (.glb, .gltf, .obj, .ply or .stl)")
    return files


def read_folder(folder: Path, y_up: Sequence[str] = Y_UP) -> Iterator[tuple[str, trimesh.Trimesh | str]]:
    """Name and mesh (metres, z up) of each mesh file, or why it is left out (`why_not`)."""
    for file in mesh_files(folder):
        yield file.stem, read_mesh(file, y_up)


def read_mesh(file: Path, y_up: Sequence[str] = Y_UP) -> trimesh.Trimesh | str:
    """A file's mesh (metres, z up), or why it is left out (`why_not`)."""
    try:
        mesh = trimesh.load_mesh(file)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        if file.suffix.lower() in y_up:
            mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, [1, 0, 0]))
        return why_not(mesh) or mesh
    except Exception as error:  # a broken file may fail anywhere in its reader, or where its mesh is used
        return f"cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})"


def why_not(mesh: trimesh.Trimesh) -> str:
    """Why a mesh (metres) is no object to learn from; empty if it is one."""
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return "no triangles"
    if len(mesh.faces) > MOST_FACES:
        return f"{len(mesh.faces)} faces, more than {MOST_FACES}; decimate it"
    if mesh.vertices.shape[1:] != (3,) or not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        return "a face names a corner that is not there"
    if not np.isfinite(mesh.vertices).all():
        return "a vertex is not finite"
    sides = np.sort(mesh.extents)
    if not SMALLEST <= sides[2] <= LARGEST:
        return f"longest side {sides[2]:.3g} m, not {SMALLEST:g} to {LARGEST:g} m; scale it to metres"
    voxel = sides[2] / BODY_EXTENT * WALL
    if sides[0] < voxel:
        return f"flat: {1e3 * sides[0]:.2g} mm thin, less than a voxel of {1e3 * voxel:.2g} mm"
    hull = mesh.convex_hull
    if 2.0 * hull.volume / hull.area < voxel:
        return f"a plate: {2e3 * hull.volume / hull.area:.2g} mm thin on average, less than a voxel"
    return ""
