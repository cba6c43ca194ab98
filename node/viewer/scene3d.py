"""What the page shows, computed: places, meshes, clouds and answers, in metres in one frame, the page's.

The page's frame is the world where all objects know it, else the frame of the only object, else that of the first one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from node.figures import voxel_renderer
from perception.answers.hypotheses import FrameName, Hypotheses, binary_entropy, by_weight, mesh
from perception.answers.query import QueryResult, query
from perception.answers.regions import Box, Points
from perception.inference.settings import TrackConfig
from perception.observation.object_frame import object_frame
from perception.observation.segmentation import Segment, backproject, segment
from perception.observation.settings import ObserveConfig
from perception.sources.frame import Frame
from probnerf.rendering.occupancy import voxel_centres

AROUND = 2.2  # half extents of its cube; the part of the scene that is shown around each object
MAX_POINTS = 60_000  # of the seen surface
BOX_EDGES = np.array(  # of the unit cube about the origin: [12 edges, 2 ends, 3]
    [
        [np.roll([x, y, z], axis) for z in (-0.5, 0.5)]
        for axis in range(3)
        for x, y in ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5))
    ]
)
REACH = TrackConfig().reach  # half extents between an object's cube and that of its segment
LEAST_P = 0.02  # less probable voxels are not shown


@dataclass(frozen=True, eq=False)
class CameraView:
    """The frame that a scene was inferred from, and the segment of each object found in it (by id)."""

    frame: Frame
    segments: Mapping[int, Segment]


@dataclass(frozen=True, eq=False)
class PageScene:
    """A scene in the page's frame, ready for queries in that frame."""

    objects: tuple[Hypotheses, ...]
    frame: FrameName  # the name of the page's frame in questions to `objects`
    title: str  # that frame in words
    T_page_camera: Float[np.ndarray, "4 4"]

    def T_page_object(self, h: Hypotheses) -> Float[np.ndarray, "4 4"]:
        """p_page = T_page_object @ p_object, metres."""
        return np.linalg.inv(h.T_object_from(self.frame))

    @property
    def distance(self) -> float:
        """From the camera to the first object (m)."""
        return float(np.linalg.norm(self.objects[0].object_frame.T_camera_object[:3, 3]))

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """The first support plane's normal."""
        return self.T_page_object(self.objects[0])[:3, 2]


def camera_view(frame: Frame, scene: Sequence[Hypotheses]) -> CameraView:
    """A frame with the statuses of its pixels for the scene's objects, recomputed with the usual segmentation.

    Segments belong to objects by the frame's label map. Without one they are numbered by size, not by the
    objects' ids; then a segment belongs to the object at its place. An object without a segment has no statuses.
    Raises ValueError if the frame is not the scene's.
    """
    for h in scene:
        if (h.stamp_ns, h.frame_id) != (frame.stamp_ns, frame.frame_id):
            raise ValueError(
                f"the frame beside it is '{frame.frame_id}' at {frame.stamp_ns} ns, but object {h.object_id} is of "
                f"'{h.frame_id}' at {h.stamp_ns} ns"
            )
    try:
        segments = segment(frame)
    except ValueError:  # the node may have segmented it otherwise
        return CameraView(frame, {})
    if frame.label is not None:
        ids = {h.object_id for h in scene}
        return CameraView(frame, {found.id: found for found in segments if found.id in ids})
    return CameraView(frame, _by_place(frame, segments, scene))


def _by_place(frame: Frame, segments: Sequence[Segment], scene: Sequence[Hypotheses]) -> dict[int, Segment]:
    """Each object's segment: of all pairs the nearest first, as far apart as a `Tracker` allows one object to be."""
    pairs = []
    for i, found in enumerate(segments):
        try:
            at = object_frame(frame, found, ObserveConfig()).T_camera_object[:3, 3]
        except ValueError:  # not of a size that is inferred
            continue
        for h in scene:
            cube = h.object_frame
            apart = float(np.linalg.norm(cube.T_camera_object[:3, 3] - at)) / cube.half_extent
            if apart < REACH:
                pairs.append((apart, i, h.object_id))
    chosen: dict[int, int] = {}
    for _, i, name in sorted(pairs):
        if name not in chosen and i not in chosen.values():
            chosen[name] = i
    return {name: replace(segments[i], id=name) for name, i in chosen.items()}


def place(scene: Sequence[Hypotheses]) -> PageScene:
    """The scene in the page's frame. Raises ValueError for an empty scene, or objects of different frames."""
    if not scene:
        raise ValueError("there is no object to show; give at least one object's hypotheses")
    first = scene[0]
    T_object_camera = np.linalg.inv(first.object_frame.T_camera_object)
    if all(h.T_world_camera is not None for h in scene):
        placed = PageScene(tuple(scene), "world", "world", np.asarray(first.T_world_camera))
    elif len(scene) == 1:
        placed = PageScene((first,), "object", f"object {first.object_id}", T_object_camera)
    else:  # the first object's frame becomes the world: queries about several objects need one
        moved = tuple(replace(h, T_world_camera=T_object_camera) for h in scene)
        placed = PageScene(moved, "world", f"object {first.object_id}", T_object_camera)
    ask(placed, np.zeros(3), np.full(3, 1e-3))  # raises if the objects are not of one frame
    return placed


def ask(placed: PageScene, centre: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"]) -> QueryResult:
    """The joint answer of all objects about an axis-aligned box of the page's frame (m)."""
    centre, size = np.asarray(centre, np.float64), np.asarray(size, np.float64)
    low, high = (tuple(float(v) for v in centre + side * size) for side in (-0.5, 0.5))
    return query(placed.objects, Box(low, high), placed.frame)  # type: ignore[arg-type]


def transform(T: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """T @ p of points."""
    return points @ T[:3, :3].T + T[:3, 3]


@dataclass(frozen=True, eq=False)
class Shape:
    """One hypothesis' surface in the page's frame, parted by whether the camera saw it."""

    vertices: Float[np.ndarray, "v 3"]  # m
    seen: Int[np.ndarray, "a 3"]  # triangles
    unseen: Int[np.ndarray, "b 3"]


def weights_in_order(h: Hypotheses) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distinct hypotheses from the heaviest on: their indices and weights (those of identical ones added)."""
    order = by_weight(h)
    return order, np.bincount(h.twins, weights=h.weights, minlength=len(h.weights))[order]


def shape(placed: PageScene, h: Hypotheses, index: int) -> Shape:
    """The surface of hypothesis `index`. A triangle is seen where space just in front of it was."""
    vertices, faces = mesh(h, index)
    corners = vertices[faces]  # [f, 3, 3]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # The surface itself is within the noise of depth: look two and a half half-voxels out, as the pictures do.
    front = corners.mean(axis=1) + 2.5 * h.object_frame.half_extent / h.grid * normals
    voxel = h.voxels("object", *front.T)
    seen = (voxel < 0) | h.seen.ravel()[voxel]
    return Shape(transform(placed.T_page_object(h), vertices), faces[seen], faces[~seen])


@dataclass(frozen=True, eq=False)
class Cloud:
    """Space above the plane that no pixel has seen, a point for each voxel that may be occupied."""

    points: Float[np.ndarray, "n 3"]  # m
    p_occupied: Float[np.ndarray, "n"]  # by `query`: of all objects together
    voxel_m: float

    @property
    def disagreement(self) -> Float[np.ndarray, "n"]:
        """Binary entropy of `p_occupied`, in shares of log 2: 1 where the hypotheses are evenly split."""
        return binary_entropy(self.p_occupied) / np.log(2.0)


def cloud(placed: PageScene) -> Cloud:
    """The unseen space of all objects."""
    points = []
    for h in placed.objects:
        hidden = voxel_centres(h.grid)[h.unseen].astype(np.float64)
        points.append(transform(placed.T_page_object(h), hidden * h.object_frame.half_extent))
    where = np.concatenate(points)
    p = np.asarray(query(placed.objects, Points(where), placed.frame).p_occupied) if len(where) else np.zeros(0)
    keep = p >= LEAST_P
    return Cloud(where[keep], p[keep], min(h.voxel_m for h in placed.objects))


def first_box(placed: PageScene, unseen: Cloud) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Centre and size (m) of an informative first box: around space that about half of the hypotheses occupy. Both are
    rounded to millimetres.
    """
    sides = [share * placed.objects[0].object_frame.half_extent for share in (0.3, 0.15, 0.075)]
    sizes = [np.maximum(np.round(np.full(3, side), 3), 1e-3) for side in sides]
    if not len(unseen.points):
        return np.round(placed.T_page_object(placed.objects[0])[:3, 3], 3), sizes[0]
    split = unseen.points[unseen.disagreement >= 0.5 * unseen.disagreement.max()]
    tried = np.round(split[:: max(1, len(split) // 40)], 3)
    best, size = 0, sizes[0]
    for size in sizes:  # a smaller one where a wall that all agree on is in every larger one
        answers = [ask(placed, point, size) for point in tried]
        odds = np.nan_to_num([answer.p_free for answer in answers], nan=1.0)
        worth = [(answer.outside_fraction > 0, abs(p - 0.5)) for answer, p in zip(answers, odds, strict=True)]
        best = min(range(len(tried)), key=lambda i: worth[i])
        if worth[best] < (False, 0.3):
            break
    return tried[best], size


def seen_surface(placed: PageScene, view: CameraView) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """The points that the depth measured around the objects (m), with their colours: none without depth."""
    if view.frame.depth is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    points = backproject(view.frame)
    near = np.zeros(points.shape[:2], bool)
    for h in placed.objects:
        with np.errstate(invalid="ignore"):
            near |= (np.abs(h.object_frame.to_cube(points)) < AROUND).all(axis=-1)
    chosen = np.flatnonzero(near)
    chosen = chosen[:: max(1, len(chosen) // MAX_POINTS)]
    return transform(placed.T_page_camera, points.reshape(-1, 3)[chosen]), view.frame.rgb.reshape(-1, 3)[chosen]


def picture(view: CameraView, object_id: int, tinted: bool) -> UInt8[np.ndarray, "h w 3"]:
    """The frame's colours, or its grey picture tinted by each pixel's status for the object (`shade.STATUS`)."""
    found = view.segments.get(object_id)
    if not tinted or found is None:
        return view.frame.rgb
    paint = np.zeros(view.frame.rgb.shape)
    for value, (_, colour) in voxel_renderer.STATUS.items():
        paint[found.status == value] = tuple(bytes.fromhex(colour[1:]))
    return np.round(0.5 * view.frame.rgb.mean(axis=2, keepdims=True) + 0.5 * paint).astype(np.uint8)


def field_of_view(frame: Frame) -> tuple[float, float]:
    """Vertical field of view (rad) and width over height, of the pinhole without its distortion."""
    height, width = frame.rgb.shape[:2]
    fy, fx = frame.camera.K[1, 1], frame.camera.K[0, 0]
    return float(2.0 * np.arctan(0.5 * height / fy)), float(width / fx / (height / fy))


def onlooker(placed: PageScene) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Where to look from and at (m): beside the objects and a little behind, so that both sides are in sight."""
    frames = [placed.T_page_object(h) for h in placed.objects]
    middle = np.mean([T[:3, 3] for T in frames], axis=0)
    reach = max(
        float(np.linalg.norm(T[:3, 3] - middle)) + h.object_frame.half_extent
        for T, h in zip(frames, placed.objects, strict=True)
    )
    x, y, z = frames[0][:3, :3].T  # x to the camera
    return middle + reach * (-1.0 * x - 3.6 * y + 2.1 * z), middle + reach * (0.4 * x + 0.15 * z)


def colours(values: Float[np.ndarray, "n"], ramp: Sequence[str]) -> UInt8[np.ndarray, "n 3"]:
    """Values 0 to 1 along a ramp of hexadecimal colours."""
    stops = np.array([tuple(bytes.fromhex(colour[1:])) for colour in ramp], np.float64)
    at = np.clip(values, 0.0, 1.0) * (len(stops) - 1)
    channels = [np.interp(at, np.arange(len(stops)), stop) for stop in stops.T]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)
