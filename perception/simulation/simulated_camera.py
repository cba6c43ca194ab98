"""A simulated depth camera: objects of the tabletop family on a table, seen with a real sensor's faults.

The world frame has z up, z = 0 on the table top and its origin in the table's middle; metres. An object's own frame is
its canonical one in metres: origin at the cube's centre, so that it stands on z = BASE_Z * half_extent, the handle (or
a carton's front) at +x.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int32

from calibration.camera import Camera
from probnerf.geometry import look_at
from probnerf.objects.ray_tracer import trace
from probnerf.objects.tabletop import TabletopObject, sample_object
from probnerf.types import BASE_Z

_SUB = 2  # rays per pixel and axis
_RAYS = 1 << 13  # traced at a time: one compiled size
_FLOOR, _WALL = -0.75, -1.6  # m: the room's floor (z) and the wall behind the table (x)


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """One object of the family on the table."""

    seed: int  # of the family
    x: float  # m on the table, of the body's axis
    y: float  # m
    yaw: float  # rad, counter-clockwise from above; 0: the handle points along the world's +x

    @cached_property
    def shape(self) -> TabletopObject:
        """The object itself, standing canonically (without slack)."""
        return sample_object(self.seed, slack=0.0)

    @property
    def half_extent(self) -> float:
        """Metres per cube unit."""
        return float(self.shape.half_extent_m)

    @property
    def T_world_object(self) -> Float[np.ndarray, "4 4"]:
        """p_world = T_world_object @ p_object, metres; p_object = half_extent * p_cube."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array(
            [[c, -s, 0, self.x], [s, c, 0, self.y], [0, 0, 1, -BASE_Z * self.half_extent], [0, 0, 0, 1]], np.float64
        )


@dataclass(frozen=True, eq=False)
class TableScene:
    """A table in a room. Object i of the list has id i + 1 in the label map."""

    objects: tuple[PlacedObject, ...]
    table: tuple[float, float] = (0.45, 0.7)  # m, half sides along x and y
    table_colour: tuple[float, float, float] = (0.62, 0.47, 0.33)
    wall_colour: tuple[float, float, float] = (0.72, 0.74, 0.75)
    grain: float = 0.12  # contrast of the table's wood


@dataclass(frozen=True, eq=False)
class FaultlessImage:
    """The picture of a faultless camera."""

    rgb: Float[np.ndarray, "h w 3"]  # in [0, 1]
    depth: Float[np.ndarray, "h w"]  # m along z, through the pixel's centre; inf where there is nothing
    nearest: Float[np.ndarray, "h w"]  # m: the least and the largest depth within the pixel
    farthest: Float[np.ndarray, "h w"]
    label: Int32[np.ndarray, "h w"]  # 0: no object
    gloss: Float[np.ndarray, "h w"] | None = None  # in [0, 1]; 0: matt, 1: a mirror's glare. None: objects 1, others 0


def place_camera(position: tuple[float, float, float], target: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of an upright camera at `position` that looks at `target` (m, world frame)."""
    return look_at(np.asarray(position, float), np.asarray(target, float))


def truth(scene: TableScene, T_world_camera: Float[np.ndarray, "4 4"]) -> list[Float[np.ndarray, "4 4"]]:
    """T_camera_object of each object's canonical frame, metres."""
    return [np.linalg.inv(T_world_camera) @ placed.T_world_object for placed in scene.objects]


def render(scene: TableScene, camera: Camera, T_world_camera: Float[np.ndarray, "4 4"]) -> FaultlessImage:
    """The scene through a faultless camera: four rays per pixel, and one through its centre for depth and label."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    offsets = (np.arange(_SUB) + 0.5) / _SUB - 0.5
    shifts = [(0.0, 0.0)] + [(dx, dy) for dy in offsets for dx in offsets]
    colours, depths, label = [], [], np.zeros(0, np.int32)
    for dx, dy in shifts:
        rays = camera.rays(np.column_stack([(u + dx).ravel(), (v + dy).ravel()]))
        rgb, distance, ids = _shoot(scene, T_world_camera, rays)
        depths.append(distance * rays[:, 2])
        if len(depths) == 1:
            label = ids
        else:
            colours.append(rgb)
    shape = u.shape
    nearest, farthest = np.min(depths, axis=0), np.max(depths, axis=0)
    return FaultlessImage(
        rgb=np.mean(colours, axis=0).reshape(*shape, 3),
        depth=depths[0].reshape(shape),
        nearest=nearest.reshape(shape),
        farthest=farthest.reshape(shape),
        label=label.reshape(shape),
    )


def _shoot(
    scene: TableScene, T_world_camera: Float[np.ndarray, "4 4"], rays: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Int32[np.ndarray, "n"]]:
    """Colour, distance along the ray (m, inf: nothing) and object id of unit rays in the camera frame."""
    origin, directions = T_world_camera[:3, 3], rays @ T_world_camera[:3, :3].T
    rgb, distance = surroundings(scene, origin, directions)
    label = np.zeros(len(rays), np.int32)
    for i, placed in enumerate(scene.objects, start=1):
        T, h = np.linalg.inv(placed.T_world_object), placed.half_extent
        start, heading = (T[:3, :3] @ origin + T[:3, 3]) / h, directions @ T[:3, :3].T
        near = np.flatnonzero(
            _meets_box(start, heading, np.asarray(placed.shape.lower), np.asarray(placed.shape.upper))
        )
        for at in range(0, len(near), _RAYS):
            chosen = near[at : at + _RAYS]
            padded = np.resize(chosen, _RAYS)
            starts = np.broadcast_to(start, (_RAYS, 3)).astype(np.float32)
            hit, length, colour = trace(placed.shape, starts, heading[padded].astype(np.float32))
            count = len(chosen)
            metres = np.where(np.asarray(hit)[:count], np.asarray(length, np.float64)[:count] * h, np.inf)
            nearer = metres < distance[chosen]
            found = chosen[nearer]
            distance[found], label[found] = metres[nearer], i
            rgb[found] = np.asarray(colour)[:count][nearer]
    return rgb, distance, label


def _meets_box(
    start: Float[np.ndarray, "3"],
    heading: Float[np.ndarray, "n 3"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
) -> Bool[np.ndarray, "n"]:
    """Which rays meet a box a little larger than the object's."""
    inverse = 1.0 / np.where(np.abs(heading) < 1e-9, 1e-9, heading)
    a, b = (low - 0.02 - start) * inverse, (high + 0.02 - start) * inverse
    return np.minimum(a, b).max(axis=1) <= np.maximum(a, b).min(axis=1)


def surroundings(
    scene: TableScene, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Colour and distance (m) of the table, the floor or the wall behind."""
    (table, on_table), (floor, on_floor), wall = _planes(scene, origin, directions)
    distance = np.minimum(np.minimum(table, floor), wall)
    colour = np.where((wall < floor)[:, None], scene.wall_colour, 0.55 * np.array(scene.wall_colour))
    x, y = on_floor[:, 0], on_floor[:, 1]
    tiles = np.where((np.floor(x / 0.4) + np.floor(y / 0.4)) % 2 > 0, 1.0, 0.9)
    colour = np.where((floor < wall)[:, None], colour * tiles[:, None], colour)
    x, y = on_table[:, 0], on_table[:, 1]
    # Wood: rings stretched along y, and finer fibres.
    rings = np.sin(2 * np.pi * (9.0 * x + 0.6 * np.sin(5.0 * y + 1.3) + 0.25 * np.sin(17.0 * y)))
    fibres = np.sin(2 * np.pi * (67.0 * x + 0.8 * np.sin(11.0 * y))) * np.sin(2 * np.pi * (3.1 * y + 5.0 * x))
    wood = np.array(scene.table_colour) * (1.0 + scene.grain * (0.6 * rings + 0.4 * fibres))[:, None]
    for placed in scene.objects:  # what stands on the table takes the room's light from its surroundings
        reach = placed.half_extent * float(np.min(placed.shape.upper[:2]))
        gap = np.maximum(np.hypot(x - placed.x, y - placed.y) - reach, 0.0)
        wood = wood * (1.0 - 0.45 * np.exp(-gap / (0.3 * reach)))[:, None]
    return np.where((table <= distance)[:, None], wood, colour), distance


def room_distance(
    scene: TableScene, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Distance (m) of the table, the floor or the wall behind alone."""
    (table, _), (floor, _), wall = _planes(scene, origin, directions)
    return np.minimum(np.minimum(table, floor), wall)


def _planes(
    scene: TableScene, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Distance (m, inf: none) and point on the table and on the floor, and distance of the wall."""

    def meet(axis: int, at: float) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore"):
            t = (at - origin[axis]) / directions[:, axis]
        t = np.where(t > 0, t, np.inf)
        return t, origin + np.where(np.isfinite(t), t, 0.0)[:, None] * directions

    table, on_table = meet(2, 0.0)
    table[(np.abs(on_table[:, :2]) > scene.table).any(axis=1)] = np.inf
    return (table, on_table), meet(2, _FLOOR), meet(0, _WALL)[0]
