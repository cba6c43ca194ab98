"""Scans and meshes that no prior was trained on, at rest on a plane, seen by a library's ray caster (trimesh's, by
embree where that is installed).

Nothing of this project's renderer or simulated sensor takes part. A mesh lies in one of its stable poses, drawn by
probability; a mesh whose longest side is no household thing's is scaled. The camera draws its distance and elevation
until its picture shows the whole object. Depth has white noise and is missing at edges; the true mask is given. What a
point is, solid or free, says the generalised winding number of the mesh (Jacobson et al. 2013, libigl), as the parity
of a ray's crossings is wrong on meshes of parts that overlap. A scene depends on the mesh and its name alone.
"""

import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy import ndimage

from calibration.camera import Camera
from perception.sources.frame import Frame
from probnerf.geometry import look_at
from probnerf.objects.tabletop import VALIDATION_SEEDS

DATA = Path(__file__).resolve().parent.parent.parent.parent / "shared" / "data"
GSO, BULLET = "scans, to choose by", "Bullet's meshes, test"
HOUSEHOLD = "the household generator's validation objects"
SETS = {"gso": GSO, "bullet": BULLET, "household": HOUSEHOLD}
FILES = {
    GSO: ("val_meshes/gso/*.ply",),
    BULLET: ("meshes/bullet3/mug.obj", "meshes/bullet3/random_objects/*.obj"),
}
_SHIFTS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))  # px; rays of a pixel's colour


@dataclass(frozen=True)
class StrangerConfig:
    """The camera, its faults, and where points are scored."""

    width: int = 640  # px
    height: int = 480  # px
    focal: float = 600.0  # px
    distance: tuple[float, float] = (0.45, 0.8)  # m from the middle of the object's box
    elevation: tuple[float, float] = (25.0, 60.0)  # degrees above the table
    aim: float = 0.02  # m; standard deviation of where the camera looks about that middle
    border: float = 10.0  # px that the object keeps from the picture's border
    plausible: float = 0.5  # m; a mesh whose longest side is longer has another unit,
    longest: tuple[float, float] = (0.08, 0.2)  # m; and is given one of these
    noise: float = 0.001  # m: the standard deviation of depth is noise + noise_z2 z^2
    noise_z2: float = 0.002  # 1/m
    edge: float = 0.01  # m of depth between a pixel and its neighbour that make an edge, which has no depth
    max_range: float = 4.0  # m: no depth beyond
    colour_noise: float = 0.006  # of [0, 1]
    margin: float = 0.03  # m by which the object's box is enlarged for the scored points
    behind: float = 0.005  # m behind the true depth count as unseen
    drawn: int = 100_000  # points in the box; of those above the table and unseen
    points: int = 5000  # are scored, at most


@dataclass(frozen=True, eq=False)
class Stranger:
    """An object on the table z = 0 of the world frame (z up, metres), and the frame of a camera that sees it."""

    name: str
    mesh: trimesh.Trimesh  # as it lies there
    frame: Frame  # with the sensor's faults; its label is 1 where the true mask is
    T_world_camera: Float[np.ndarray, "4 4"]
    depth: Float[np.ndarray, "h w"]  # the true one, m along z; inf where there is nothing


def files(condition: str, data: Path = DATA, count: int = 100) -> list[Path]:
    """The meshes of a condition in order, so many at most. Raises FileNotFoundError where there is none."""
    if condition == HOUSEHOLD:
        return household_files(count, Path(tempfile.gettempdir()) / "farside-household")
    found = [path for pattern in FILES[condition] for path in sorted(data.glob(pattern))]
    if not found:
        raise FileNotFoundError(f"{data}: no {FILES[condition][0]} there; give the folder of the data with --data")
    return found[:count]


def household_files(count: int, folder: Path) -> list[Path]:
    """Meshes of so many of the generator's validation objects, written into a folder."""
    from probnerf.objects.household import draw_mesh  # it needs the extra `meshes`

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for seed in VALIDATION_SEEDS[:count]:
        made = draw_mesh(seed)
        paths.append(folder / f"{made.name.replace(' ', '_')}_{seed}.ply")
        made.mesh.export(paths[-1])
    return paths


def stranger(path: Path, config: StrangerConfig | None = None) -> Stranger:
    """The scene of a mesh file. Raises ValueError where it holds no triangles, or no view shows it whole."""
    config = config or StrangerConfig()
    rng = np.random.default_rng([zlib.crc32(path.stem.encode()), 61])
    mesh = trimesh.load_mesh(path)
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not float(mesh.extents.max()) > 0:
        raise ValueError(f"{path} holds no triangles")
    longest = rng.uniform(*config.longest)
    if float(mesh.extents.max()) > config.plausible:
        mesh.apply_scale(longest / float(mesh.extents.max()))
    rest(mesh, rng)
    camera, T_world_camera = stand(mesh, rng, config)
    frame, depth = photograph(mesh, camera, T_world_camera, rng, config)
    return Stranger(path.stem, mesh, frame, T_world_camera, depth)


def rest(mesh: trimesh.Trimesh, rng: np.random.Generator) -> None:
    """Lay a mesh down in a stable pose drawn by probability, turned and placed at random on z = 0."""
    centre = mesh.center_mass if mesh.is_watertight else mesh.convex_hull.center_mass
    poses, probabilities = trimesh.poses.compute_stable_poses(mesh, centre)
    mesh.apply_transform(poses[rng.choice(len(poses), p=probabilities / probabilities.sum())])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(-np.pi, np.pi), [0, 0, 1]))
    low, high = mesh.bounds
    at = rng.uniform(-0.05, 0.05, 2)
    mesh.apply_translation([*(at - 0.5 * (low + high)[:2]), -low[2]])


def stand(
    mesh: trimesh.Trimesh, rng: np.random.Generator, config: StrangerConfig
) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
    """A pinhole camera and its T_world_camera: the first draw that shows the whole object."""
    K = np.array([[config.focal, 0, config.width / 2], [0, config.focal, config.height / 2], [0, 0, 1]])
    camera = Camera(config.width, config.height, K, np.zeros(5))
    middle = mesh.bounds.mean(axis=0)
    for _ in range(200):
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(*config.elevation))
        towards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * np.cos(elevation)
        position = middle + rng.uniform(*config.distance) * towards
        T_world_camera = look_at(position, middle + rng.normal(0.0, config.aim, 3))
        px = camera.project(_to_camera(T_world_camera, np.asarray(mesh.vertices)))
        size = np.array([config.width, config.height])
        if np.all((px > config.border) & (px < size - 1 - config.border)):
            return camera, T_world_camera
    raise ValueError(f"no view from up to {config.distance[1]:g} m shows the whole object")


def photograph(
    mesh: trimesh.Trimesh,
    camera: Camera,
    T_world_camera: Float[np.ndarray, "4 4"],
    rng: np.random.Generator,
    config: StrangerConfig,
) -> tuple[Frame, Float[np.ndarray, "h w"]]:
    """The frame of a faulty sensor, and the true depth of the pixels' centres (m along z)."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    paint = _painted(mesh, rng)
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    distance, face = _cast(mesh, T_world_camera, rays)
    depth, mask = (distance * rays[:, 2]).reshape(u.shape), (face >= 0).reshape(u.shape)
    colours = []
    for dx, dy in _SHIFTS:
        rays = camera.rays(np.column_stack([(u + dx).ravel(), (v + dy).ravel()]))
        distance, face = _cast(mesh, T_world_camera, rays)
        there = np.isfinite(distance)[:, None]
        at = T_world_camera[:3, 3] + np.where(there, distance[:, None], 0.0) * (rays @ T_world_camera[:3, :3].T)
        colours.append(np.where(there, paint(at, face), 0.7))
    rgb = np.mean(colours, axis=0).reshape(*u.shape, 3) + rng.normal(0.0, config.colour_noise, (*u.shape, 3))
    # on a plane inverse depth is linear in the pixels, so its second difference finds steps and not slanted surfaces
    bends = [np.abs(ndimage.correlate1d(1.0 / depth, [1.0, -2.0, 1.0], axis, mode="nearest")) for axis in (0, 1)]
    with np.errstate(invalid="ignore"):
        step = np.maximum(*bends) * depth**2
        measured = depth + rng.standard_normal(depth.shape) * (config.noise + config.noise_z2 * depth**2)
        measured[~(step < config.edge) | ~(depth < config.max_range)] = np.nan
    image = np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
    return Frame(image, measured.astype(np.float32), camera, label=mask.astype(np.int32)), depth


def hidden_points(
    scene: Stranger, config: StrangerConfig | None = None
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Unseen points about an object (camera frame, m), and which of them lie in it.

    Uniform in its box (along the table's axes) enlarged by `margin`, above the table, in the picture, and `behind` or
    more behind the true depth on the ray to the point itself.
    """
    config = config or StrangerConfig()
    rng = np.random.default_rng([zlib.crc32(scene.name.encode()), 67])
    low, high = scene.mesh.bounds + np.array([[-config.margin], [config.margin]])
    points = rng.uniform(low, high, (config.drawn, 3))
    points = points[points[:, 2] > 0]
    seen_from, camera = _to_camera(scene.T_world_camera, points), scene.frame.camera
    px = camera.project(seen_from)
    inside = np.all((px >= -0.5) & (px < [camera.width - 0.5, camera.height - 0.5]), axis=1)
    length = np.linalg.norm(seen_from, axis=1)
    rays = seen_from / length[:, None]
    distance, _ = _cast(scene.mesh, scene.T_world_camera, rays)
    unseen = inside & (seen_from[:, 2] >= distance * rays[:, 2] + config.behind)
    keep = np.flatnonzero(unseen)[: config.points]
    return seen_from[keep], solid_at(scene.mesh, points[keep])


def solid_at(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points (in the mesh's frame) lie in the solid: those of a generalised winding number above 1/2."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    return np.asarray(igl.winding_number(vertices, faces, np.ascontiguousarray(points, np.float64))) > 0.5


def _cast(
    mesh: trimesh.Trimesh, T_world_camera: Float[np.ndarray, "4 4"], rays: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], np.ndarray]:
    """Length (m) to the first thing that rays from the camera (unit, camera frame) meet, the mesh or the table, and the
    mesh's face; inf and -1 where there is none."""
    origin, directions = T_world_camera[:3, 3], rays @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = np.where(directions[:, 2] < 0, -origin[2] / directions[:, 2], np.inf)
    found, ray, at = mesh.ray.intersects_id(
        np.broadcast_to(origin, rays.shape), directions, multiple_hits=False, return_locations=True
    )
    length = np.linalg.norm(at - origin, axis=1)
    nearer = length < distance[ray]
    distance[ray[nearer]] = length[nearer]
    face = np.full(len(rays), -1)
    face[ray[nearer]] = found[nearer]
    return distance, face


def _painted(mesh: trimesh.Trimesh, rng: np.random.Generator) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Colours (in [0, 1]) of points on the mesh's faces, or on the table (-1), lit from above: the object is plain, has
    bands, or two halves."""
    one, other, table = rng.uniform(0.15, 0.9, 3), rng.uniform(0.15, 0.9, 3), rng.uniform(0.3, 0.7, 3)
    kind, across = rng.integers(3), rng.standard_normal(3)
    across /= np.linalg.norm(across)
    width, middle = float(mesh.extents.max()) / rng.uniform(3.0, 8.0), mesh.bounds.mean(axis=0)
    light = np.array([*rng.uniform(-0.5, 0.5, 2), 1.0])
    light /= np.linalg.norm(light)
    normals = np.asarray(mesh.face_normals)

    def paint(points: np.ndarray, face: np.ndarray) -> np.ndarray:
        along = (points - middle) @ across
        second = [np.zeros(len(points), bool), np.floor(along / width) % 2 == 1, along > 0][kind]
        shade = 0.4 + 0.6 * np.abs(normals[face] @ light)
        own = np.where(second[:, None], other, one) * shade[:, None]
        return np.where((face >= 0)[:, None], own, table)

    return paint


def _to_camera(T_world_camera: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
