"""Views of meshes drawn at random: a camera, the light, the table, things beside and before the object, borders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from perception.simulation.mesh_scene import Light, MeshScene, MeshShape, PlacedMesh, Window, window_about, windowed
from perception.simulation.ray_caster import RayCaster
from perception.simulation.simulated_camera import TableScene, place_camera
from probnerf.types import BASE_Z, BODY_EXTENT

_GRID = 48  # rays a side that look for the object when something is put before it
_PLACES = 17  # sideways, at which it is tried


@dataclass(frozen=True)
class ViewDraws:
    """What is drawn. Ranges are uniform."""

    focal: tuple[float, float] = (250.0, 650.0)  # px: pictures of cheap and good cameras
    width: float = 1.1  # focal lengths
    height: float = 0.825  # focal lengths
    elevation: tuple[float, float] = (12.0, 70.0)  # degrees above the table
    distance: tuple[float, float] = (0.35, 1.0)  # m from the object's middle,
    nearest: float = 3.5  # and at least so many half extents of the object
    aim: float = 0.02  # m; standard deviation of where the camera looks about the object's middle
    beside: float = 0.4  # probability that one or two other things stand about
    before: float = 0.4  # probability that something hides a part of the object,
    hidden: tuple[float, float] = (0.05, 0.8)  # of its pixels so large a share
    border: float = 0.15  # probability that the picture ends within the object,
    cut: tuple[float, float] = (0.05, 0.5)  # so far into its width or height


@dataclass(frozen=True, eq=False)
class DrawnView:
    """A scene whose first object is the one to infer, and the camera of a window of the picture about it."""

    scene: MeshScene
    camera: Camera
    T_world_camera: Float[np.ndarray, "4 4"]

    @property
    def target(self) -> PlacedMesh:
        return self.scene.objects[0]


def draw_view(
    rng: np.random.Generator, shape: MeshShape, others: Sequence[MeshShape] = (), draws: ViewDraws | None = None
) -> DrawnView:
    """A random view of a shape; `others` may stand about, beside boxes of all sizes."""
    draws = draws or ViewDraws()
    target = PlacedMesh(shape, rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(-np.pi, np.pi))
    focal = rng.uniform(*draws.focal)
    width, height = round(draws.width * focal), round(draws.height * focal)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = Camera(width, height, K, np.zeros(5))
    T = _stand(target, rng, draws)
    objects = [target]
    if rng.random() < draws.before:
        objects.append(_before(target, _other(rng, shape, others), T, rng.uniform(*draws.hidden), rng))
    if rng.random() < draws.beside:
        for _ in range(rng.integers(1, 3)):
            objects.append(_beside(objects, _other(rng, shape, others), rng))
    if rng.random() < draws.border:
        camera = windowed(camera, _ending_within(target, camera, T, rng.uniform(*draws.cut), rng))
    scene = MeshScene(tuple(objects), _room(rng), _light(rng))
    return DrawnView(scene, windowed(camera, window_about(target, camera, T)), T)


def box_shape(sides: Float[np.ndarray, "3"], colour: Float[np.ndarray, "3"]) -> MeshShape:
    """A box of these sides (m; the last is its height) in its canonical cube."""
    half_extent = float(max(*sides)) / BODY_EXTENT
    corner = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return MeshShape(corner * sides / half_extent + np.array([0.0, 0.0, BASE_Z]), faces, half_extent, colour)


def hidden_share(
    target: PlacedMesh, front: Sequence[PlacedMesh], T_world_camera: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "m"]:
    """The share of the target's pixels that each placement of one and the same shape hides, seen through any lens."""
    origin = T_world_camera[:3, 3]
    centre = target.T_world_object[:3, 3]
    towards = centre - origin
    side = np.cross(towards, [0.0, 0.0, 1.0])
    side /= max(float(np.linalg.norm(side)), 1e-9)
    down = np.cross(towards / np.linalg.norm(towards), side)
    across = np.linspace(-1.8, 1.8, _GRID) * target.half_extent
    points = centre + across[:, None, None] * side + across[:, None] * down
    directions = (points - origin).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = RayCaster([(target.to_world(target.shape.vertices), target.shape.faces)]).cast(origin, directions)
    hit = np.isfinite(seen.distance)
    directions, distance = directions[hit], seen.distance[hit]
    if not len(distance) or not front:
        return np.zeros(len(front))
    own = RayCaster([(front[0].shape.vertices * front[0].half_extent, front[0].shape.faces)])
    shares = []
    for placed in front:  # the rays move, the shape stands still
        T = placed.T_world_object
        met = own.cast((origin - T[:3, 3]) @ T[:3, :3], directions @ T[:3, :3])
        shares.append((met.distance < distance).mean())
    return np.array(shares)


def _stand(target: PlacedMesh, rng: np.random.Generator, draws: ViewDraws) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of a camera that looks at the object."""
    azimuth, elevation = rng.uniform(-0.5, 0.5), np.deg2rad(rng.uniform(*draws.elevation))  # it faces the wall
    distance = max(rng.uniform(*draws.distance), draws.nearest * target.half_extent)
    towards = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    middle = target.T_world_object[:3, 3]
    return place_camera(tuple(middle + distance * towards), tuple(middle + rng.normal(0.0, draws.aim, 3)))


def _other(rng: np.random.Generator, shape: MeshShape, others: Sequence[MeshShape]) -> MeshShape:
    if others and rng.random() < 0.6:
        return others[int(rng.integers(len(others)))]
    return box_shape(rng.uniform(0.3, 1.8, 3) * shape.half_extent, rng.uniform(0.1, 0.9, 3))


def _before(
    target: PlacedMesh, other: MeshShape, T: Float[np.ndarray, "4 4"], wanted: float, rng: np.random.Generator
) -> PlacedMesh:
    """Another thing between the object and the camera, where it hides about the wanted share, as far as it can."""
    at = np.array([target.x, target.y])
    towards = T[:2, 3] - at
    away = float(np.linalg.norm(towards))
    towards /= max(away, 1e-9)
    touching = target.shape.reach + other.reach
    gap = min(rng.uniform(0.0, 0.06), max(0.0, away - touching - other.reach - 0.1))  # 10 cm before the camera
    yaw = rng.uniform(-np.pi, np.pi)
    places = (
        at
        + (touching + gap) * towards
        + np.linspace(-1, 1, _PLACES)[:, None] * touching * np.array([-towards[1], towards[0]])
    )
    candidates = [PlacedMesh(other, float(x), float(y), yaw) for x, y in places]
    return candidates[int(np.abs(hidden_share(target, candidates, T) - wanted).argmin())]


def _beside(objects: Sequence[PlacedMesh], other: MeshShape, rng: np.random.Generator) -> PlacedMesh:
    """Another thing behind or beside the first, that meets none."""
    target = objects[0]
    angle = rng.uniform(0.6, 2.0 * np.pi - 0.6)  # the camera is about angle 0
    away = target.shape.reach + other.reach + rng.uniform(0.0, 0.08)
    while True:
        x, y = target.x + away * np.cos(angle), target.y + away * np.sin(angle)
        if all(np.hypot(x - o.x, y - o.y) >= o.shape.reach + other.reach for o in objects):
            return PlacedMesh(other, float(x), float(y), rng.uniform(-np.pi, np.pi))
        away += 0.02


def _ending_within(
    target: PlacedMesh, camera: Camera, T: Float[np.ndarray, "4 4"], cut: float, rng: np.random.Generator
) -> Window:
    """The picture up to a border that cuts off this share of the object's width or height, on a random side."""
    inverse = np.linalg.inv(T)
    vertices = target.to_world(target.shape.vertices[:: max(1, len(target.shape.vertices) // 2000)])
    pixels = camera.project(vertices @ inverse[:3, :3].T + inverse[:3, 3])
    size = np.array([camera.width, camera.height])
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    first, last = np.zeros(2, int), size.copy()
    axis = rng.integers(2)
    if rng.random() < 0.5:
        first[axis] = int(np.clip(low[axis] + cut * (high - low)[axis], 0, size[axis] - 1))
    else:
        last[axis] = int(np.clip(high[axis] - cut * (high - low)[axis], 1, size[axis]))
    return Window(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))


def _room(rng: np.random.Generator) -> TableScene:
    """A table and a wall of any colour, from plain to strongly grained."""
    colours = [tuple(float(c) for c in rng.uniform(0.15, 0.95) * rng.uniform(0.6, 1.0, 3)) for _ in range(2)]
    (r, g, b), (wall_r, wall_g, wall_b) = colours
    return TableScene((), table_colour=(r, g, b), wall_colour=(wall_r, wall_g, wall_b), grain=rng.uniform(0.0, 0.25))


def _light(rng: np.random.Generator) -> Light:
    """A lamp above, from any side."""
    x, y = rng.normal(0.0, 0.6, 2)
    return Light((float(x), float(y), 1.0), rng.uniform(0.3, 0.9))
