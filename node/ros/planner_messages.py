"""Messages that planners know: MoveIt's planning scene, OctoMap's octrees, detections, and distances as of nvblox."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from node.ros.messages import header, make, pose, types
from node.ros.octree import ID, octree_data
from node.ros.scene_messages import object_frame_id
from node.ros.settings import PlannerConfig
from perception.answers.hypotheses import Hypotheses
from perception.answers.occupied_space import DistanceField, cells, edge_lengths, ends, risky_surface
from perception.answers.query import marginal

PLANNING_SCENE = "moveit_msgs/msg/PlanningScene"
OCTOMAP = "octomap_msgs/msg/Octomap"
DETECTIONS = "vision_msgs/msg/Detection3DArray"
ESDF = "nvblox_msgs/srv/EsdfAndGradients"
_ADD, _REMOVE = 0, 1  # operations of a CollisionObject
_REMOVALS = 3  # messages that say so: one may be lost, and nobody asks for it again
_SURE = 1e-3  # probabilities nearer to 0 or 1 are written as this near: log-odds are finite


class SceneDifferences:
    """MoveIt's planning scene, kept up to date: objects are added or replaced, and those that are gone removed."""

    def __init__(self, node: str, config: PlannerConfig) -> None:
        """`node` is the node's full name, such as /farside."""
        self._node, self._config = node, config
        self._told: dict[str, str] = {}  # names of objects that MoveIt knows, with their frames
        self._next: dict[str, str] = {}
        self._removed: dict[str, tuple[str, int]] = {}  # names with their frames, and in how many messages yet
        self._removing: dict[str, tuple[str, int]] = {}

    def message(self, objects: Sequence[Hypotheses]) -> Any | None:
        """A moveit_msgs/PlanningScene with `is_diff`, from what was `sent` last to `objects`; None: there is nothing to
        say.

        An object's mesh is the surface of its space with P(occupied) > risk. One without such space is removed; the
        next messages repeat that, as one may be lost.
        """
        shapes = [collision_object(h, self._node, self._config) for h in objects]
        shapes = [shape for shape in shapes if shape.meshes]
        self._next = {shape.id: shape.header.frame_id for shape in shapes}
        removing = self._removed | {name: (frame, _REMOVALS) for name, frame in self._told.items()}
        self._removing = {name: it for name, it in removing.items() if name not in self._next}
        if not self._removing and not self._next:
            return None
        gone = [
            make("moveit_msgs/msg/CollisionObject", header=header(0, frame), id=name, operation=_REMOVE)
            for name, (frame, _) in self._removing.items()
        ]
        world = {"collision_objects": [*gone, *shapes]}
        if self._config.scene_octomap:
            world["octomap"] = self._octomap(objects)
        return make(
            PLANNING_SCENE,
            robot_state=make("moveit_msgs/msg/RobotState", is_diff=True),  # keeps what the robot holds
            world=make("moveit_msgs/msg/PlanningSceneWorld", **world),
            is_diff=True,
        )

    def sent(self) -> None:
        """The last message went out: the next one is a difference to it."""
        self._told = self._next
        self._removed = {name: (frame, left - 1) for name, (frame, left) in self._removing.items() if left > 1}

    def _octomap(self, objects: Sequence[Hypotheses]) -> Any:
        """An octomap_msgs/OctomapWithPose. MoveIt keeps the one that it has where another one has no data: without
        objects the data are one free voxel, in the camera.
        """
        if objects:
            first = objects[0]
            frame, T, stamp = first.frame_id, first.object_frame.T_camera_object, first.stamp_ns
            octomap = octomap_message(objects, self._node, self._config.octomap_m)
        else:
            frame, T, stamp = next(iter(self._removing.values()))[0], np.eye(4), 0
            octomap = _octomap(np.zeros((1, 3), int), np.zeros(1), self._config.octomap_m, header(0, frame))
        return make("octomap_msgs/msg/OctomapWithPose", header=header(stamp, frame), origin=pose(T), octomap=octomap)


def object_name(node: str, object_id: int) -> str:
    """An object's id in MoveIt's scene, where a slash would begin the name of a part."""
    return object_frame_id(node, object_id).replace("/", "_")


def collision_object(h: Hypotheses, node: str, config: PlannerConfig) -> Any:
    """An object as moveit_msgs/CollisionObject to add, in the camera's frame; without a mesh where nothing of it is
    above the risk.
    """
    vertices, faces = risky_surface(h, config.risk, config.mesh_grid)
    point, triangle = types().types["geometry_msgs/msg/Point"], types().types["shape_msgs/msg/MeshTriangle"]
    mesh = make(
        "shape_msgs/msg/Mesh",
        triangles=[triangle(vertex_indices=face) for face in faces.astype(np.uint32)],
        vertices=[point(x=x, y=y, z=z) for x, y, z in vertices.tolist()],
    )
    return make(
        "moveit_msgs/msg/CollisionObject",
        header=header(h.stamp_ns, h.frame_id),
        pose=pose(h.object_frame.T_camera_object),
        id=object_name(node, h.object_id),
        meshes=[mesh] if len(faces) else [],
        mesh_poses=[pose(np.eye(4))] if len(faces) else [],
        operation=_ADD,
    )


def octomap_message(objects: Sequence[Hypotheses], node: str, width: float) -> Any:
    """P(occupied) of the objects' unseen space as octomap_msgs/Octomap, in the first object's frame.

    A voxel is `width` (m) wide, but no narrower than those of the objects, and has the largest probability of what it
    covers. Space that was seen, or is in no object's cube, is left out: unknown.
    """
    width = max(width, *(h.voxel_m for h in objects))
    found: list[tuple[np.ndarray, np.ndarray]] = []
    T_frame_camera = np.linalg.inv(objects[0].object_frame.T_camera_object)
    for h in objects:
        where, voxel = cells(h, h.unseen.ravel(), T_frame_camera, width)
        found.append((where, marginal(h)[voxel]))
    top = header(objects[0].stamp_ns, object_frame_id(node, objects[0].object_id))
    return _octomap(np.concatenate([c for c, _ in found]), np.concatenate([p for _, p in found]), width, top)


def _octomap(where: Int[np.ndarray, "n 3"], p: Float[np.ndarray, "n"], width: float, top: Any) -> Any:
    p = np.clip(p, _SURE, 1.0 - _SURE)
    data = octree_data(where, np.log(p / (1.0 - p)))
    return make(OCTOMAP, header=top, id=ID, resolution=width, data=np.frombuffer(data, np.int8))


def detections_message(objects: Sequence[Hypotheses]) -> Any:
    """The objects as vision_msgs/Detection3DArray, in the camera's frame.

    A box is upright, as large as the `Summary` says, in the middle of the weighted medians of the hypotheses' ends; the
    covariance is that of their middles (m^2).
    Results are what kind of thing it may be, with probabilities; none where the prior does not tell.
    """
    top = header(objects[0].stamp_ns, objects[0].frame_id)
    return make(DETECTIONS, header=top, detections=[_detection(h, top) for h in objects])


def _detection(h: Hypotheses, top: Any) -> Any:
    low, high = ends(h)
    middle = 0.5 * (low + high)
    place = h.object_frame.T_camera_object.copy()
    box = [np.quantile(end, 0.5, axis=0, weights=h.weights, method="inverted_cdf") for end in (low, high)]
    place[:3, 3] += place[:3, :3] @ (0.5 * (box[0] + box[1]))
    spread = np.zeros((6, 6))
    R, offset = place[:3, :3], middle - h.weights @ middle
    spread[:3, :3] = R @ ((h.weights * offset.T) @ offset) @ R.T
    where = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(place), covariance=spread.ravel())
    results = [
        make(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id=kind, score=float(p)),
            pose=where,
        )
        for kind, p in sorted(h.kinds.items(), key=lambda item: -item[1])
    ]
    edges = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", edge_lengths(h).tolist(), strict=True)))
    return make(
        "vision_msgs/msg/Detection3D",
        header=top,
        results=results,
        bbox=make("vision_msgs/msg/BoundingBox3D", center=pose(place), size=edges),
        id=str(h.object_id),
    )


def esdf_response(field: DistanceField, stamp_ns: int, frame_id: str, unknown: float) -> Any:
    """The response of nvblox_msgs/EsdfAndGradients. nvblox has no gradients in it, in spite of its name.

    nvblox measures to the centres of the outermost occupied voxels, where the distance is 0: half a voxel beyond their
    border.
    """
    distance = field.distance + np.float32(0.5 * field.width)
    count = distance.shape
    strides = (int(np.prod(count)), count[1] * count[2], count[2])
    dim = [
        make("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=stride)
        for label, size, stride in zip("xyz", count, strides, strict=True)
    ]
    corner = dict(zip("xyz", (field.first * field.width).tolist(), strict=True))
    return make(
        f"{ESDF}_Response",
        header=header(stamp_ns, frame_id),
        origin_m=make("geometry_msgs/msg/Point", **corner),
        voxel_size_m=field.width,
        esdf_and_gradients=make(
            "std_msgs/msg/Float32MultiArray",
            layout=make("std_msgs/msg/MultiArrayLayout", dim=dim),
            data=np.where(np.isnan(distance), np.float32(unknown), distance).ravel(),
        ),
        success=True,
    )
