"""Messages for people and planners: a scene as point cloud, markers and picture; diagnostics; frames."""

import colorsys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from calibration.camera import Camera
from node.figures.summary import unexplained
from node.figures.voxel_renderer import Viewpoint, largest_along
from node.ros.messages import header, image_message, make, pose, types
from perception.answers.hypotheses import Hypotheses, binary_entropy, by_weight, meshes
from perception.answers.query import marginal
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import BASE_Z

CLOUD_FIELDS = ("x", "y", "z", "p_occupied", "seen", "disagreement", "weight")
LEAST_P = 0.05  # of a voxel in the cloud
MARKER_GRID = 32  # voxels per axis of a marker's shape, at most
MAX_TRIANGLES = 4000  # of a marker; a larger shape is drawn with wider voxels
MAX_RAYS = 64  # a side, of the picture of one object; a larger one is drawn with wider pixels
_FLOAT32, _TRIANGLES, _DELETEALL = 7, 11, 3  # constants of PointField and Marker


def object_frame_id(node: str, object_id: int) -> str:
    """The name of an object's frame in /tf; `node` is the node's full name, such as /farside."""
    return f"{node.strip('/')}/object_{object_id}"


def occupancy_message(scene: Sequence[Hypotheses], least_p: float = LEAST_P) -> Any:
    """Voxels that may be occupied as sensor_msgs/PointCloud2, in the camera's frame.

    Fields, float32: x y z of the centre (m), p_occupied (cautious for an object out of model, as in `query`), seen (1:
    some pixel saw the voxel), disagreement (nats) and weight (of the heaviest hypothesis that fills it).
    """
    rows = []
    for h in scene:
        p = marginal(h)
        index = np.flatnonzero(p >= least_p)
        points = h.object_frame.to_camera(voxel_centres(h.grid).reshape(-1, 3)[index])
        heaviest = np.zeros(len(index))
        for weight, shape in zip(h.weights, h.solid.reshape(len(h.weights), -1), strict=True):
            heaviest = np.where(shape[index], np.maximum(heaviest, weight), heaviest)
        seen = h.seen.ravel()[index]
        rows.append(np.column_stack([points, p[index], seen, binary_entropy(p[index]), heaviest]))
    data = np.concatenate(rows).astype(np.float32)
    step = 4 * len(CLOUD_FIELDS)
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(scene[0].stamp_ns, scene[0].frame_id),
        height=1,
        width=len(data),
        fields=[
            make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
            for i, name in enumerate(CLOUD_FIELDS)
        ],
        point_step=step,
        row_step=step * len(data),
        data=data.view(np.uint8).ravel(),
        is_dense=True,
    )


def markers_message(scene: Sequence[Hypotheses], count: int = 3) -> Any:
    """The `count` heaviest distinct shapes of each object as visualization_msgs/MarkerArray, surer ones more opaque.

    Each array is complete: its first marker deletes all earlier ones. Namespaces are object_<id>, ids the ranks.
    """
    array = [make("visualization_msgs/msg/Marker", action=_DELETEALL)]
    for h in scene:
        array[0].header = top = header(h.stamp_ns, h.frame_id)
        total = np.bincount(h.twins, weights=h.weights)
        red, green, blue = colorsys.hsv_to_rgb(0.618 * h.object_id % 1.0, 0.7, 0.95)
        for rank, index in enumerate(by_weight(h)[:count]):
            corners = _triangles(h, int(index))
            if not len(corners):
                continue
            alpha = float(np.clip(0.2 + 0.8 * total[index], 0.2, 0.9))
            array.append(
                make(
                    "visualization_msgs/msg/Marker",
                    header=top,
                    ns=f"object_{h.object_id}",
                    id=rank,
                    type=_TRIANGLES,
                    pose=pose(h.object_frame.T_camera_object),
                    scale=make("geometry_msgs/msg/Vector3", x=1.0, y=1.0, z=1.0),
                    color=make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
                    points=_points(corners),
                )
            )
    return make("visualization_msgs/msg/MarkerArray", markers=array)


def _triangles(h: Hypotheses, index: int) -> np.ndarray:
    """Corners [3 n, 3] (m, object frame) of a shape's surface, drawn coarsely enough for `MAX_TRIANGLES`."""
    own = replace(
        h,
        opacity=h.opacity[index : index + 1],
        pose=h.pose[index : index + 1],
        weights=np.ones(1),
        population=np.zeros(1, int),
    )
    filled = h.solid[index]
    while True:
        if own.grid <= MARKER_GRID or own.grid % 2:
            vertices, faces = meshes(own, 1)[0]
            if len(faces) <= MAX_TRIANGLES or own.grid % 2:
                return vertices[faces[:MAX_TRIANGLES]].reshape(-1, 3)
        half = own.grid // 2
        filled = filled.reshape(half, 2, half, 2, half, 2).mean(axis=(1, 3, 5))
        opacity = np.rint(255 * filled).astype(np.uint8)[None]
        own = replace(own, opacity=opacity, seen=np.zeros((half, half, half), bool))


def _points(corners: np.ndarray) -> list[Any]:
    point = types().types["geometry_msgs/msg/Point"]
    return [point(x=x, y=y, z=z) for x, y, z in corners.tolist()]


def uncertainty_message(scene: Sequence[Hypotheses], camera: Camera) -> Any:
    """Per pixel of the camera the largest disagreement (nats) along its ray in unseen space: 32FC1."""
    return image_message(scene[0].stamp_ns, scene[0].frame_id, uncertainty(scene, camera), "32FC1")


def uncertainty(scene: Sequence[Hypotheses], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """The picture of `uncertainty_message`; 0 where no object's cube lies behind the pixel."""
    image = np.zeros((camera.height, camera.width), np.float32)
    for h in scene:
        cube = h.object_frame
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [BASE_Z, 1])).reshape(3, -1).T.astype(np.float64)
        px = camera.project(cube.to_camera(corners))
        if np.isnan(px).any():
            continue  # the camera is inside the cube
        low = np.maximum(np.floor(px.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(px.max(axis=0)) + 1, [camera.width, camera.height]).astype(int)
        if (high <= low).any():
            continue
        step = -(-int((high - low).max()) // MAX_RAYS)
        size = -(-int((high - low).max()) // step)
        v, u = step * np.mgrid[:size, :size] + 0.5 * (step - 1)
        pixels = np.column_stack([u.ravel(), v.ravel()]) + low
        T_cube_camera = np.linalg.inv(cube.T_camera_object)
        T_cube_camera[:3, 3] /= cube.half_extent
        directions = np.nan_to_num(camera.rays(pixels), nan=0.0) @ T_cube_camera[:3, :3].T
        hidden = np.where(h.seen, 0.0, binary_entropy(marginal(h)).reshape(h.seen.shape))
        found = largest_along(hidden, Viewpoint(T_cube_camera, directions, size))
        part = np.repeat(np.repeat(found, step, axis=0), step, axis=1)[: high[1] - low[1], : high[0] - low[0]]
        where = image[low[1] : high[1], low[0] : high[0]]
        np.maximum(where, part, out=where)
    return image


Level = Literal["ok", "warn", "error", "stale"]


@dataclass(frozen=True)
class DiagnosticStatus:
    """One line of /diagnostics."""

    name: str  # such as "farside: camera"
    level: Level
    message: str
    values: Mapping[str, object]
    hardware_id: str = ""


def diagnostics_message(stamp_ns: int, statuses: Sequence[DiagnosticStatus]) -> Any:
    """A diagnostic_msgs/DiagnosticArray."""
    levels = ("ok", "warn", "error", "stale")
    return make(
        "diagnostic_msgs/msg/DiagnosticArray",
        header=header(stamp_ns, ""),
        status=[
            make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=levels.index(s.level),
                name=s.name,
                message=s.message,
                hardware_id=s.hardware_id,
                values=[
                    make("diagnostic_msgs/msg/KeyValue", key=k, value=f"{v:.6g}" if isinstance(v, float) else str(v))
                    for k, v in s.values.items()
                ],
            )
            for s in statuses
        ],
    )


def sampler_status(h: Hypotheses, now_ns: int) -> DiagnosticStatus:
    """The sampler's state for one object."""
    message = h.result if not h.out_of_model else f"{h.result}; {unexplained(h)}"
    age = (now_ns - h.stamp_ns) * 1e-9
    values = {"age (s)": age, "stage": h.stage, "monte carlo error": h.monte_carlo_error}
    values |= {"effective hypotheses": h.effective_hypotheses, **h.diagnostics.as_mapping()}
    return DiagnosticStatus(f"farside: object {h.object_id}", "warn" if h.out_of_model else "ok", message, values)


def counts_status(counts: Mapping[str, Mapping[str, int]]) -> DiagnosticStatus:
    """Counts of messages sent, received and dropped, by topic or service."""
    values = {f"{name} {fate}": n for name, fates in sorted(counts.items()) for fate, n in sorted(fates.items())}
    trouble = sum(n for fates in counts.values() for fate, n in fates.items() if fate not in ("sent", "received"))
    message = f"{trouble} messages dropped or refused" if trouble else "all messages passed"
    return DiagnosticStatus("farside: bus", "warn" if trouble else "ok", message, values)


def transforms_message(scene: Sequence[Hypotheses], node: str) -> Any:
    """A tf2_msgs/TFMessage: each object's frame in the camera's."""
    places = (
        (h.object_frame.T_camera_object, h.stamp_ns, h.frame_id, object_frame_id(node, h.object_id)) for h in scene
    )
    return make("tf2_msgs/msg/TFMessage", transforms=[transform_message(*place) for place in places])


def transform_message(T: Float[np.ndarray, "4 4"], stamp_ns: int, frame: str, child: str) -> Any:
    """A geometry_msgs/TransformStamped: p_frame = T @ p_child, metres."""
    place = pose(T)
    p = place.position
    moved = make("geometry_msgs/msg/Vector3", x=p.x, y=p.y, z=p.z)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, frame),
        child_frame_id=child,
        transform=make("geometry_msgs/msg/Transform", translation=moved, rotation=place.orientation),
    )
