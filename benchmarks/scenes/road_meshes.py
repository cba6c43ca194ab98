"""Other people's vehicles: textured meshes of Gazebo's models in the frame of the family `cars`.

The folder is not part of this repository. It holds NAME/meshes/*.obj with NAME/materials/textures/*.png of
https://github.com/osrf/gazebo_models (Creative Commons Attribution 3.0, Nathan Koenig). They are only tested on, never
learnt from. A texture that is not there (wheels of another model) is black rubber.
"""

from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from probnerf.objects.mesh import MeshObject
from probnerf.types import BASE_Z, BODY_EXTENT

MODELS = ("hatchback", "hatchback_blue", "hatchback_red", "ambulance", "bus")
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # their fronts are at -y
METRES = {"bus": 0.01}  # a unit of the file; an inch where nothing is said
INCH = 0.0254
SAMPLES = 60_000  # surface points whose colours are known
RUBBER = (0.08, 0.08, 0.085)
LIGHT, AMBIENT, LAMP = np.array([0.35, 0.3, 0.89]), 0.6, 0.45


class _Textures(trimesh.resolvers.Resolver):
    """Files of one model by their last names, wherever an .mtl says that they are."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """The file's bytes. Raises FileNotFoundError, as trimesh expects."""
        last = name.strip().replace("\\", "/").split("/")[-1]
        for place in ("materials/textures", "meshes"):
            if (self._folder / place / last).is_file():
                return (self._folder / place / last).read_bytes()
        raise FileNotFoundError(last)

    def write(self, name: str, data: bytes) -> None:
        """Nothing is written."""
        raise NotImplementedError

    def namespaced(self, namespace: str) -> "_Textures":
        """The same: only last names count."""
        return self

    def keys(self) -> list[str]:
        """Names that can be asked for."""
        return [path.name for path in self._folder.rglob("*") if path.is_file()]


@dataclass(frozen=True, eq=False)
class RoadMesh:
    """One vehicle, in the canonical cube of `benchmarks.paper.cars`: front at +x, wheels on z = BASE_Z."""

    mesh: MeshObject
    points: Float[np.ndarray, "n 3"]  # on its surface, cube units
    colours: UInt8[np.ndarray, "n 3"]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def rgb(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Lit colours of surface points (cube units): that of the nearest sample, Lambert plus ambient."""
        paint = self.colours[self._tree.query(points)[1]] / 255.0
        facing = np.maximum(normals @ LIGHT, 0.0)[:, None]
        return np.clip(paint * (AMBIENT + LAMP * facing), 0.0, 1.0)

    @property
    def description(self) -> Float[np.ndarray, "0"]:
        """Nothing: it is not learnt from."""
        return np.zeros(0, np.float32)


def road_mesh_file(folder: Path, name: str) -> Path:
    """The vehicle's file. Raises FileNotFoundError in one line."""
    found = sorted((folder / name / "meshes").glob("*.obj"))
    if not found:
        raise FileNotFoundError(f"{folder / name}/meshes holds no .obj; give a folder of Gazebo's models")
    return found[0]


def read_road_mesh(folder: Path, name: str) -> RoadMesh:
    """The vehicle of this name. Raises FileNotFoundError or ValueError in one line."""
    file = road_mesh_file(folder, name)
    scene = trimesh.load_scene(BytesIO(file.read_bytes()), file_type="obj", resolver=_Textures(folder / name))
    parts = [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise ValueError(f"{file} holds no triangles")
    area = sum(part.area for part in parts)
    points, colours = [], []
    for part in parts:
        count = max(1, round(SAMPLES * part.area / area))
        at, colour = _sampled(part, count)
        points.append(at)
        colours.append(colour)
    vertices = np.concatenate([part.vertices for part in parts]) @ TURN.T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit = max(high[0] - low[0], high[2] - low[2]) / BODY_EXTENT  # of the file, per cube unit
    origin = np.array([*(0.5 * (low + high))[:2], low[2]])

    def placed(p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return (p - origin) / unit + [0.0, 0.0, BASE_Z]

    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]).astype(np.int64)
    mesh = MeshObject(placed(vertices), faces, unit * METRES.get(name, INCH), "other", name)
    return RoadMesh(mesh, placed(np.concatenate(points) @ TURN.T), np.concatenate(colours))


def _sampled(part: trimesh.Trimesh, count: int) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Surface points of one part, the same each time, and their colours."""
    material = getattr(part.visual, "material", None)
    if getattr(material, "image", None) is None:
        at, _ = trimesh.sample.sample_surface(part, count, seed=0)
        return np.asarray(at), np.broadcast_to(np.round(255.0 * np.array(RUBBER)).astype(np.uint8), (len(at), 3))
    at, _, colour = trimesh.sample.sample_surface(part, count, sample_color=True, seed=0)
    return np.asarray(at), np.asarray(colour)[:, :3].astype(np.uint8)
