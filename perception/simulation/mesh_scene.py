"""Triangle meshes on the simulated table, seen by the faultless camera, in a window of the picture if that is enough.

World and object frames are those of `simulated_camera`. A mesh stands in its canonical cube as the family's objects do:
its resting plane at z = BASE_Z, cube units.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from calibration.camera import Camera
from perception.simulation.ray_caster import RayCaster
from perception.simulation.simulated_camera import _SUB, FaultlessImage, TableScene, room_distance, surroundings
from probnerf.types import BASE_Z

# Reflected colour in [0, 1] at points on the surface with these unit normals, both canonical, cube units.
Paint = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]


@dataclass(frozen=True, eq=False)
class MeshShape:
    """A mesh in its canonical cube."""

    vertices: Float[np.ndarray, "v 3"]  # cube units
    faces: Int[np.ndarray, "f 3"]
    half_extent: float  # m per cube unit
    paint: Paint | Float[np.ndarray, "f 3"] | Float[np.ndarray, "3"] | tuple[float, float, float]  # or colour of faces
    gloss: float = 0.0  # in [0, 1]; highlights for the eye, glare for the sensor
    lit: bool = False  # the colours are lit already: the scene's lamp adds nothing to them

    @cached_property
    def reach(self) -> float:
        """The largest horizontal distance from the canonical axis, m."""
        return float(np.hypot(self.vertices[:, 0], self.vertices[:, 1]).max()) * self.half_extent

    def colour(
        self, face: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Reflected colour at points of faces (canonical, cube units)."""
        if callable(self.paint):
            return np.asarray(self.paint(points, normals), np.float64)
        colours = np.asarray(self.paint, np.float64)
        return np.broadcast_to(colours, points.shape) if colours.ndim == 1 else colours[face]


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A mesh that stands on the table."""

    shape: MeshShape
    x: float = 0.0  # m on the table, of the canonical axis
    y: float = 0.0  # m
    yaw: float = 0.0  # rad, counter-clockwise from above; 0: the canonical +x points along the world's

    @property
    def half_extent(self) -> float:
        """Metres per cube unit."""
        return self.shape.half_extent

    @property
    def T_world_object(self) -> Float[np.ndarray, "4 4"]:
        """p_world = T_world_object @ p_object, metres; p_object = half_extent * p_cube."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array(
            [[c, -s, 0, self.x], [s, c, 0, self.y], [0, 0, 1, -BASE_Z * self.half_extent], [0, 0, 0, 1]], np.float64
        )

    def to_world(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Canonical cube units to the world, m."""
        T = self.T_world_object
        return points * self.half_extent @ T[:3, :3].T + T[:3, 3]

    def to_cube(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World, m, to canonical cube units."""
        T = self.T_world_object
        return (points - T[:3, 3]) @ T[:3, :3] / self.half_extent


@dataclass(frozen=True)
class Light:
    """One distant lamp and even light from everywhere. `ambient` 1 leaves colours as painted."""

    direction: tuple[float, float, float] = (0.4, 0.3, 0.85)  # towards the lamp, world frame
    ambient: float = 0.45  # share of the light that comes from everywhere

    @property
    def unit(self) -> Float[np.ndarray, "3"]:
        return np.asarray(self.direction) / np.linalg.norm(self.direction)


@dataclass(frozen=True, eq=False)
class MeshScene:
    """Meshes on a table in a room. Mesh i of the list has id i + 1 in the label map."""

    objects: tuple[PlacedMesh, ...]
    room: TableScene = field(default_factory=lambda: TableScene(()))  # its own objects are not drawn
    light: Light = field(default_factory=Light)

    @cached_property
    def caster(self) -> RayCaster:
        """All meshes in the world frame; built once for any number of views."""
        return RayCaster([(placed.to_world(placed.shape.vertices), placed.shape.faces) for placed in self.objects])


@dataclass(frozen=True)
class Window:
    """A rectangle of a picture, px; the first column and row are inside."""

    left: int
    top: int
    width: int
    height: int


def windowed(camera: Camera, window: Window) -> Camera:
    """The camera whose whole picture is the window. Exact with any lens: only the principal point moves."""
    K = camera.K.copy()
    K[:2, 2] -= (window.left, window.top)
    return replace(camera, width=window.width, height=window.height, K=K)


def window_about(
    placed: PlacedMesh, camera: Camera, T_world_camera: Float[np.ndarray, "4 4"], radius: float = 1.6
) -> Window:
    """The part of the picture within `radius` cube units of the object's middle: the encoder's picture and more.

    Raises `ValueError` if the picture has no part of it.
    """
    middle = np.linalg.inv(T_world_camera) @ placed.T_world_object[:, 3]
    centre = camera.project(middle[None, :3])[0]
    reach = radius * placed.half_extent * camera.K[[0, 1], [0, 1]] / middle[2]
    size = np.array([camera.width, camera.height])
    low, high = (np.clip(np.nan_to_num(at, nan=0.0), 0, size) for at in (centre - reach, centre + reach))
    left, top = np.floor(low).astype(int)
    width, height = np.ceil(high).astype(int) - (left, top)
    if min(width, height) < 1:
        raise ValueError(f"the object at {placed.x:g}, {placed.y:g} m is outside the picture; aim the camera at it")
    return Window(int(left), int(top), int(width), int(height))


def render_meshes(scene: MeshScene, camera: Camera, T_world_camera: Float[np.ndarray, "4 4"]) -> FaultlessImage:
    """The scene through a faultless camera: four rays per pixel, and one through its centre for depth and label.

    Give the camera of a window (`windowed`) to have that part alone.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    offsets = (np.arange(_SUB) + 0.5) / _SUB - 0.5
    centre = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    distance, mesh, _ = _shoot(scene, T_world_camera, centre, coloured=False)
    depth, label = distance * centre[:, 2], mesh + 1
    nearest, farthest, colours = depth, depth, []
    for dy in offsets:
        for dx in offsets:
            rays = camera.rays(np.column_stack([(u + dx).ravel(), (v + dy).ravel()]))
            distance, _, rgb = _shoot(scene, T_world_camera, rays)
            colours.append(rgb)
            nearest, farthest = np.minimum(nearest, distance * rays[:, 2]), np.maximum(farthest, distance * rays[:, 2])
    gloss = np.array([0.0, *(placed.shape.gloss for placed in scene.objects)])
    return FaultlessImage(
        rgb=np.clip(np.mean(colours, axis=0), 0.0, 1.0).reshape(*u.shape, 3),
        depth=depth.reshape(u.shape),
        nearest=nearest.reshape(u.shape),
        farthest=farthest.reshape(u.shape),
        label=label.reshape(u.shape).astype(np.int32),
        gloss=gloss[label].reshape(u.shape),
    )


def _shoot(
    scene: MeshScene, T_world_camera: Float[np.ndarray, "4 4"], rays: Float[np.ndarray, "n 3"], coloured: bool = True
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Distance (m, inf: nothing), mesh (-1: none) and colour of unit rays in the camera frame."""
    origin, directions = T_world_camera[:3, 3], rays @ T_world_camera[:3, :3].T
    hits = scene.caster.cast(origin, directions)
    mesh, distance, rgb = hits.mesh, hits.distance, np.zeros(rays.shape)
    (missed,) = np.nonzero(mesh < 0)  # what stands on the table is met before it
    if not coloured:
        distance[missed] = room_distance(scene.room, origin, directions[missed])
        return distance, mesh, rgb
    rgb[missed], distance[missed] = surroundings(scene.room, origin, directions[missed])
    points = origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * directions
    light, ambient = scene.light.unit, scene.light.ambient
    for i, placed in enumerate(scene.objects):
        (at,) = np.nonzero(mesh == i)
        normal, R = hits.normal[at], placed.T_world_object[:3, :3]
        own = placed.shape.colour(hits.face[at], placed.to_cube(points[at]), normal @ R)
        lit = ~scene.caster.shaded(points[at], normal, light)
        direct = (1.0 - ambient) * lit * np.clip(normal @ light, 0.0, 1.0)
        rgb[at] = own if placed.shape.lit else own * (ambient + direct)[:, None]
        if placed.shape.gloss:
            halfway = light - directions[at]
            halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
            highlight = np.clip(np.einsum("ni,ni->n", normal, halfway), 0.0, 1.0) ** 60
            rgb[at] += (placed.shape.gloss * (1.0 - ambient) * lit * highlight)[:, None]
    (table,) = np.nonzero((mesh < 0) & (np.abs(points[:, 2]) < 1e-6))
    shade = scene.caster.shaded(points[table], np.array([0.0, 0.0, 1.0]), light)
    rgb[table[shade]] *= ambient + 0.3 * (1.0 - ambient)  # what the lit table reflects reaches it, too
    return distance, mesh, rgb
