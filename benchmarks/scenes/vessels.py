"""Vessels on a simulated table, with the handle hidden or in sight, and the truth in the frame of the view."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.camera import Camera
from perception.observation.object_frame import ObjectFrame, object_frame
from perception.observation.segmentation import Segment, segment
from perception.observation.settings import ObserveConfig
from perception.observation.visibility import seen_voxels
from perception.simulation.sensor_draws import told_pose
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import FaultlessImage, PlacedObject, TableScene, place_camera, render, truth
from perception.sources.frame import Frame
from probnerf.geometry import pinhole_rays
from probnerf.objects.ray_tracer import trace
from probnerf.objects.tabletop import (
    TRAIN_SEEDS,
    TabletopObject,
    canonical_parts,
    part_distances,
    sample_objects,
    to_canonical,
)
from probnerf.rendering.occupancy import above_plane, coarsen, solid
from probnerf.types import Pose

GRID = 32  # voxels per axis that answers are judged on
FINE = 64  # voxels per axis of the truth, before it is coarsened as the hypotheses are


@dataclass(frozen=True)
class ViewConfig:
    """The simulated camera and where it may stand, and when a view shows the handle."""

    width: int = 640  # px
    height: int = 480  # px
    focal: float = 600.0  # px
    elevation: tuple[float, float] = (15.0, 60.0)  # degrees above the table
    distance: tuple[float, float] = (0.45, 0.9)  # m from the object's middle,
    nearest: float = 3.5  # and at least so many half extents of the object
    aim: float = 0.02  # m; standard deviation of where the camera looks about the object's middle
    tries: int = 60  # placements drawn for a vessel before the next one is taken
    least: int = 500  # px of the object that a hidden handle's view has
    shown: int = 150  # px of the handle in an informative view,
    shown_share: float = 0.04  # and at least so much of the object's pixels


Handle = Literal["hidden", "informative"]  # no pixel shows the handle; it shows clearly (`ViewConfig.shown`)


@dataclass(frozen=True, eq=False)
class VesselPicture:
    """A vessel on the table and a camera that stands as was asked for, before any sensor."""

    placed: PlacedObject
    camera: Camera
    T_world_camera: Float[np.ndarray, "4 4"]
    picture: FaultlessImage  # faultless

    @property
    def T_camera_object(self) -> Float[np.ndarray, "4 4"]:
        """The canonical object frame in the camera's, metres."""
        return truth(TableScene((self.placed,)), self.T_world_camera)[0]


@dataclass(frozen=True, eq=False)
class VesselView:
    """A view of a vessel as perception takes it, and what is there. Grids are [i_x, i_y, i_z] over the view's cube."""

    seed: int
    frame: Frame  # with the sensor's faults, and the true mask as label 1
    segment: Segment
    cube: ObjectFrame
    shape: TabletopObject | None  # None: none of the family
    T_canonical_view: Float[np.ndarray, "4 4"]  # affine: from the view's cube to the shape's, cube units both
    solid: Bool[np.ndarray, "32 32 32"]
    body: Bool[np.ndarray, "32 32 32"]  # without its handle
    seen: Bool[np.ndarray, "32 32 32"]  # by the true geometry (without depth, in silhouette), or in the table
    near_handle: Bool[
        np.ndarray, "32 32 32"
    ]  # outside the body, where the true handle passes as it turns about the axis
    pose_known: bool = False  # the cube is the object's own


def vessel_picture(seed: int, handle: Handle, config: ViewConfig | None = None) -> VesselPicture | None:
    """The vessel of a family seed in the first of independent draws (uniform yaw, elevation and distance) in which its
    handle is hidden or shows, as asked for; None if it has none, or `tries` draws hold no such view.
    """
    config = config or ViewConfig()
    shape = PlacedObject(seed, 0.0, 0.0, 0.0).shape
    if not bool(shape.has_handle):
        return None
    rng = np.random.default_rng([seed, 23])
    camera = simulated_camera(config)
    for _ in range(config.tries):
        placed, T_world_camera = place(seed, rng, config)
        if shows_handle(placed, T_world_camera) != (handle == "informative"):  # a small picture costs less
            continue
        view = VesselPicture(placed, camera, T_world_camera, render(TableScene((placed,)), camera, T_world_camera))
        pixels, total = pixels_of_handle(view), int((view.picture.label == 1).sum())
        if handle == "hidden" and total >= config.least and not pixels:
            return view
        if handle == "informative" and pixels >= max(config.shown, config.shown_share * total):
            return view
    return None


def vessel_view(
    picture: VesselPicture,
    depth: bool = True,
    fault: Callable[[Frame], Frame] | None = None,
    pose_known: bool = False,
) -> VesselView:
    """What perception makes of a picture through a faulty sensor, with the truth in the cube that it chose.

    A `fault` is done to the frame on top of the sensor's; what is truly seen and there stays what it is. Without
    `depth` the segment is the true mask's, on the plane that a camera's pose over the table gives which errs as much as
    `PlaneGuess` states (`told_pose`): what a user has to say of a picture; only what is beside the outline counts as
    seen.
    With `pose_known` the cube is the object's own, as a marker on it would tell. Raises ValueError where perception
    refuses.
    """
    placed, camera, seed = picture.placed, picture.camera, picture.placed.seed
    frame = sense(picture.picture, camera, picture.T_world_camera, seed)
    if not depth:
        frame = replace(frame, depth=None, T_world_camera=pose_as_stated(picture.T_world_camera, seed))
    frame = frame if fault is None else fault(frame)
    found = segment(frame, 1)[0]
    if pose_known:
        cube = ObjectFrame(picture.T_camera_object, placed.half_extent, found.plane, 0.0, 0.0)
    else:
        cube = object_frame(frame, found, ObserveConfig())
    # Without depth no pixel sees where the object is: scored behind its true surface alone, voxels would tell that
    true_depth = picture.picture.depth.astype(np.float32) if depth else None
    faultless = Frame(frame.rgb, true_depth, camera, frame_id=frame.frame_id)
    T_canonical_view = _affine(cube, picture.T_camera_object, placed.half_extent)
    body, handle = (np.asarray(a) for a in _parts(placed.shape, T_canonical_view, FINE))
    swept = np.asarray(_swept(placed.shape, T_canonical_view, GRID))
    return VesselView(
        seed=seed,
        frame=frame,
        segment=found,
        cube=cube,
        shape=placed.shape,
        T_canonical_view=T_canonical_view,
        solid=coarsen(solid((body | handle).astype(np.float32)), GRID),
        body=coarsen(solid(body.astype(np.float32)), GRID),
        seen=seen_voxels(faultless, found, cube, GRID) | in_table(GRID),
        near_handle=swept & ~coarsen(body, GRID),
        pose_known=pose_known,
    )


def in_table(grid: int) -> Bool[np.ndarray, "g"]:
    """Which layers of voxels lie under the plane, by i_z: there is nothing to be seen, and truths end above."""
    return ~above_plane(grid)


def pose_as_stated(T_world_camera: Float[np.ndarray, "4 4"], seed: int) -> Float[np.ndarray, "4 4"]:
    """A camera's pose as its user tells it: height and tilt err by what `PlaneGuess` states, drawn by the seed."""
    return told_pose(T_world_camera, np.random.default_rng([seed, 53]))


def hidden_vessel(seed: int, config: ViewConfig | None = None) -> VesselView | None:
    """The vessel of a family seed in an RGB-D view that does not show its handle.

    None: no handle, none hidden in `tries` draws of yaw and camera, or outside perception's range of sizes.
    """
    picture = vessel_picture(seed, "hidden", config)
    try:
        return None if picture is None else vessel_view(picture)
    except ValueError:
        return None


def simulated_camera(config: ViewConfig) -> Camera:
    """A pinhole camera without distortion."""
    K = np.array([[config.focal, 0, config.width / 2], [0, config.focal, config.height / 2], [0, 0, 1]])
    return Camera(config.width, config.height, K, np.zeros(5))


def place(seed: int, rng: np.random.Generator, config: ViewConfig) -> tuple[PlacedObject, Float[np.ndarray, "4 4"]]:
    """A random placement and T_world_camera."""
    placed = PlacedObject(seed, rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(-np.pi, np.pi))
    return placed, stand(placed.T_world_object[:3, 3], placed.half_extent, rng, config)


def stand(
    middle: Float[np.ndarray, "3"], half_extent: float, rng: np.random.Generator, config: ViewConfig
) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of a random camera that looks at an object about `middle` (world frame, m)."""
    azimuth, elevation = rng.uniform(-0.3, 0.3), np.deg2rad(rng.uniform(*config.elevation))  # it faces the wall
    distance = max(rng.uniform(*config.distance), config.nearest * half_extent)
    towards = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    position, target = middle + distance * towards, middle + rng.normal(0.0, config.aim, 3)
    return place_camera(tuple(position), tuple(target))


def shows_handle(placed: PlacedObject, T_world_camera: Float[np.ndarray, "4 4"], size: int = 96) -> bool:
    """Whether a small picture of the whole object shows its handle."""
    T_object_camera = np.linalg.inv(placed.T_world_object) @ T_world_camera
    T_object_camera[:3, 3] /= placed.half_extent
    distance = float(np.linalg.norm(T_object_camera[:3, 3]))
    origin, direction = pinhole_rays(T_object_camera, 0.5 * size * distance / 1.5, size)
    hit, length, _ = (np.asarray(a) for a in trace(placed.shape, origin, direction))
    return bool(np.any(_on_handle(placed.shape, origin + np.where(hit, length, 0.0)[:, None] * direction)[hit]))


def pixels_of_handle(view: VesselPicture) -> int:
    """How many pixels of the faultless picture show the handle."""
    v, u = np.nonzero(view.picture.label == 1)
    rays = view.camera.rays(np.column_stack([u, v]))
    points = rays / rays[:, 2:] * view.picture.depth[v, u][:, None]
    T = view.T_camera_object
    points = (points - T[:3, 3]) @ T[:3, :3] / view.placed.half_extent
    return int(_on_handle(view.placed.shape, points.astype(np.float32)).sum())


_part_distances = jax.jit(part_distances)


def _on_handle(obj: TabletopObject, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which surface points belong to the handle: it is the nearer part, by more than rounding."""
    count = len(points)
    padded = np.resize(points, (1 << max(count - 1, 0).bit_length(), 3))  # few compiled sizes
    body, handle = (np.asarray(a)[:count] for a in _part_distances(obj, padded))
    return (handle < body) & (body > 0.004)


def _affine(
    cube: ObjectFrame, T_camera_object: Float[np.ndarray, "4 4"], half_extent: float
) -> Float[np.ndarray, "4 4"]:
    """p_canonical (cube units) = A @ p_view (cube units)."""
    T = np.linalg.inv(T_camera_object) @ cube.T_camera_object  # metres
    A = np.eye(4)
    A[:3, :3] = T[:3, :3] * cube.half_extent / half_extent
    A[:3, 3] = T[:3, 3] / half_extent
    return A


def _half_lattice(A: Float[Array, "4 4"], grid: int) -> Float[Array, "m m m 3"]:
    """Corners, edge, face and centre points of all voxels of the view's cube, in canonical cube units."""
    axis = jnp.linspace(-1.0, 1.0, 2 * grid + 1)
    points = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return points @ A[:3, :3].T + A[:3, 3]


def _any_in_voxel(inside: Bool[Array, "m m m"]) -> Bool[Array, "g g g"]:
    return jax.lax.reduce_window(inside, False, jax.lax.bitwise_or, (3, 3, 3), (2, 2, 2), "valid")


@partial(jax.jit, static_argnames="grid")
def _parts(obj: TabletopObject, A: Float[Array, "4 4"], grid: int) -> tuple[Array, Array]:
    """Voxels that meet the body, and the handle."""
    body, handle = part_distances(obj, _half_lattice(A, grid))
    return _any_in_voxel(body <= 0.0), _any_in_voxel(handle <= 0.0)


@partial(jax.jit, static_argnames="grid")
def _swept(obj: TabletopObject, A: Float[Array, "4 4"], grid: int) -> Bool[Array, "g g g"]:
    """Voxels that the handle meets at some yaw. It lies about azimuth 0, so half a radian of turns covers it."""
    x, y, z = to_canonical(obj, _half_lattice(A, grid))
    r = jnp.sqrt(x * x + y * y)

    def at(angle: Array) -> Array:
        return canonical_parts(obj, r * jnp.cos(angle), r * jnp.sin(angle), z)[1]

    return _any_in_voxel(jnp.min(jax.lax.map(at, jnp.linspace(0.0, 0.5, 11)), axis=0) <= 0.0)


@partial(jax.jit, static_argnames="grid")
def _frequency(objects: TabletopObject, poses: Pose, grid: int) -> Float[Array, "g g g"]:
    """Share of objects, each at its pose, that occupy a voxel of the view's cube."""

    def one(item: tuple[TabletopObject, Pose]) -> Array:
        points = _half_lattice(jnp.eye(4), grid)
        body, handle = part_distances(item[0], item[1].to_object(points))
        return _any_in_voxel(jnp.minimum(body, handle) <= 0.0)

    def add(total: Array, item: tuple[TabletopObject, Pose]) -> tuple[Array, None]:
        return total + one(item), None

    total, _ = jax.lax.scan(add, jnp.zeros((grid, grid, grid)), (objects, poses))
    return total / poses.yaw.shape[0]


def base_rate(
    objects: int = 1024, grid: int = GRID, config: ObserveConfig | None = None, pose_known: bool = False
) -> Float[np.ndarray, "g g g"]:
    """Training-set frequency of occupancy in the view frame: family objects at any yaw, placed by perception's widths.

    With `pose_known` in their own cubes. Otherwise all stand on the plane (z = 0), and the law has the cube's
    symmetries about the vertical (quarter turns, a mirror), so the estimate is averaged over all eight.
    """
    config = config or ObserveConfig()
    if pose_known:
        own = Pose(*[jnp.zeros(objects)] * 5)
        return np.asarray(_frequency(sample_objects(TRAIN_SEEDS[:objects]), own, grid), np.float64)
    rng = np.random.default_rng(29)
    yaw, spread = rng.uniform(-np.pi, np.pi, objects), rng.standard_normal((3, objects))
    x, y, log_scale = spread * np.array([[config.xy_sigma], [config.xy_sigma], [config.log_scale_sigma]])
    poses = Pose(*(jnp.asarray(a, jnp.float32) for a in (yaw, x, y, log_scale, np.zeros(objects))))
    rate = np.asarray(_frequency(sample_objects(TRAIN_SEEDS[:objects]), poses, grid), np.float64)
    turned = [np.rot90(r, k) for r in (rate, rate[:, ::-1]) for k in range(4)]
    return np.mean(turned, axis=0)
