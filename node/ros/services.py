"""The node's services: requests become questions to `perception`, answers become responses."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from node.ros.bus import Bus
from node.ros.clock import Clock
from node.ros.frame_tree import FrameTree, plain
from node.ros.messages import NEXT_VIEW, QUERY_REGION, make, matrix, pose, time_message
from node.ros.planner_messages import ESDF, esdf_response
from node.ros.scene_messages import object_frame_id
from node.ros.settings import PlannerConfig
from perception.answers.hypotheses import FrameName, Hypotheses
from perception.answers.occupied_space import distance_field
from perception.answers.query import query
from perception.answers.regions import REACH, Box, Points, Swept, moved
from perception.answers.scene import Scene

BOX, POINTS, SWEPT = 0, 1, 2  # kinds of a QueryRegion request
MAX_BOXES = 256  # also of what is to be cleared
RING = 5  # poses about the object, where a request names no number
MAX_VIEWS = 100


class Answers:
    """The newest scene. Every answer reads it whole: inference may replace it at any time, from any thread."""

    def __init__(
        self,
        node: str = "/farside",
        planner: PlannerConfig | None = None,
        frames: FrameTree | None = None,
        clock: Clock | None = None,
    ) -> None:
        """`node` is the node's full name. The names of its objects' frames begin with it. `frames` are those of the
        robot, in which may be asked, too. Ages are by `clock`.
        """
        self.node, self.planner, self.frames = node, planner or PlannerConfig(), frames or FrameTree()
        self.clock = clock or Clock()
        self._scene: Scene | None = None

    def update(self, objects: Sequence[Hypotheses]) -> None:
        """Replace the scene. What answers need is computed first, so that they do not wait."""
        for h in objects:
            _ = h.p_occupied, h.twins  # cached; p_occupied fills `solid`
        if objects:
            self.frames.pin(objects[0].stamp_ns)
        self._scene = Scene(tuple(objects)) if objects else None

    @property
    def scene(self) -> Scene:
        """The newest scene. Raises ValueError while there is none."""
        if (scene := self._scene) is None:
            raise ValueError("there are no hypotheses; ask again when the node has seen an object")
        return scene

    def serve(self, bus: Bus) -> None:
        """Offer ~/query_region, ~/next_view and ~/get_esdf_and_gradient."""
        bus.serve("~/query_region", QUERY_REGION, self.query_region)
        bus.serve("~/next_view", NEXT_VIEW, self.next_view)
        bus.serve("~/get_esdf_and_gradient", ESDF, self.distances)

    def query_region(self, request: Any) -> Any:
        """Answer a farside_msgs/QueryRegion request. Raises ValueError in one line for an invalid request."""
        scene = self._asked(request)
        objects = scene.objects
        (frame, T_frame_asked), region = self._frame(request.header.frame_id, objects), _region(request)
        if T_frame_asked is not None:
            region = moved(region, T_frame_asked)
        found = query(objects, region, frame, self.clock.now_ns())
        blocked = np.array([(o, row) for o, rows in found.blocked_by.items() for row in rows], np.int64).reshape(-1, 2)
        return make(
            f"{QUERY_REGION}_Response",
            success=True,
            **_about(scene, found.age_s),
            objects=len(objects),
            out_of_model=any(h.out_of_model for h in objects),
            p_free=found.p_free,
            p_free_se=found.p_free_se,
            p_free_few=found.p_free_few,
            blocked_objects=blocked[:, 0].astype(np.int32),
            blocked_hypotheses=blocked[:, 1].astype(np.uint32),
            **{f"volume_{q}": v for q, v in found.volume_m3.items()},
            unseen_fraction=found.unseen_fraction,
            outside_fraction=found.outside_fraction,
            entropy_nats=found.entropy_nats,
            effective_hypotheses=found.effective_hypotheses,
            p_occupied=np.array(found.p_occupied or [], np.float64),
        )

    def next_view(self, request: Any) -> Any:
        """Answer a farside_msgs/NextView request. Raises ValueError in one line for an invalid request.

        Poses are transformed into the first object's frame and back.
        """
        scene = self._asked(request)
        objects = scene.objects
        T_object_frame = self._T_object(request.header.frame_id, objects)
        candidates = len(request.candidates)
        if max(candidates, request.count) > MAX_VIEWS:
            raise ValueError(f"{max(candidates, request.count)} views are too many; give at most {MAX_VIEWS}")
        cameras = np.stack([T_object_frame @ matrix(p) for p in request.candidates]) if candidates else None
        if cameras is not None and not (np.abs(cameras) <= REACH).all():
            raise ValueError(f"a candidate is beyond {REACH:g} m; give poses in metres")
        rank_views = import_module(
            "perception.answers.next_view"
        ).rank_views  # imported here: it is heavy and rarely needed
        ranked = rank_views(objects, cameras, request.count or candidates or RING)
        T_frame_object = np.linalg.inv(T_object_frame)
        return make(
            f"{NEXT_VIEW}_Response",
            success=True,
            **_about(scene, (self.clock.now_ns() - min(h.stamp_ns for h in scene)) * 1e-9),
            poses=[pose(T_frame_object @ T) for T in ranked.T_object_camera],
            gain_nats=np.asarray(ranked.gain_nats, np.float64),
        )

    def distances(self, request: Any) -> Any:
        """Answer an nvblox_msgs/EsdfAndGradients request, about all objects. The answer is always up to date, what is
        cleared is so for it alone, and nothing is visualised. Raises ValueError in one line for an invalid request.
        """
        objects = self.scene.objects
        T_frame_object = np.linalg.inv(self._T_object(request.frame_id, objects))
        T_frame_camera = T_frame_object @ np.linalg.inv(objects[0].object_frame.T_camera_object)
        low, c = _xyz(request.aabb_min_m), self.planner
        field = distance_field(
            objects,
            T_frame_camera,
            (low, low + _xyz(request.aabb_size_m)) if request.use_aabb else None,
            c.risk,
            c.distance_m,
            c.farthest_m,
            lambda points: _cleared(request, points),
        )
        return esdf_response(field, min(h.stamp_ns for h in objects), request.frame_id, c.unknown_m)

    def _asked(self, request: Any) -> Scene:
        """The newest scene, or the one object of it that a request names."""
        scene = self.scene
        if not request.object_id:
            return scene
        return Scene((scene.by_id(request.object_id),))

    def _T_object(self, name: str, objects: Sequence[Hypotheses]) -> Float[np.ndarray, "4 4"]:
        """p_object = T @ p_frame of the first object and the frame that a frame_id names; raises as `_frame`."""
        frame, T_frame_asked = self._frame(name, objects)
        T = objects[0].T_object_from(frame)
        T = T if T_frame_asked is None else T @ T_frame_asked
        if not (np.abs(T) <= REACH).all():
            raise ValueError(f"frame_id is {name!r}, whose origin /tf puts beyond {REACH:g} m")
        return T

    def _frame(self, name: str, objects: Sequence[Hypotheses]) -> tuple[FrameName, Float[np.ndarray, "4 4"] | None]:
        """The frame of hypotheses that a request's frame_id names; or the camera's, and p_camera = T @ p_asked, if it
        names one that /tf connects to the camera's.

        Raises ValueError for an unknown one, and for an object's frame if the request is about several objects.
        """
        name, camera = plain(name), plain(objects[0].frame_id)
        own = [object_frame_id(self.node, h.object_id) for h in objects]
        aliases: dict[str, FrameName] = {"object": "object", "camera": "camera", "world": "world"}
        if objects[0].T_world_camera is None and self.frames.knows("world"):
            del aliases["world"]
        aliases |= {camera: "camera", **dict.fromkeys(own, "object")}
        if name not in aliases:
            if self.frames.knows(name):
                return "camera", self.frames.T(camera, name, objects[0].stamp_ns)
            raise ValueError(f"frame_id is {name!r}; give one of {', '.join(aliases)}, or one that is on /tf")
        if aliases[name] == "object" and len(objects) > 1:
            raise ValueError(
                f"frame_id {name!r} is ambiguous with {len(objects)} objects; give the object_id of one,"
                " or ask in the frame camera or world"
            )
        return aliases[name], None


def _xyz(message: Any) -> Float[np.ndarray, "3"]:
    return np.array([message.x, message.y, message.z], np.float64)


def _cleared(request: Any, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points lie in the boxes and spheres that an EsdfAndGradients request wants cleared."""
    boxes, spheres = (request.aabbs_to_clear_min_m, request.aabbs_to_clear_size_m), request.spheres_to_clear_center_m
    if len(boxes[0]) != len(boxes[1]) or len(spheres) != len(request.spheres_to_clear_radius_m):
        raise ValueError(
            "of what is to be cleared, each box needs a corner and a size, each sphere a centre and a radius"
        )
    if len(boxes[0]) + len(spheres) > MAX_BOXES:
        raise ValueError(f"{len(boxes[0]) + len(spheres)} shapes are to be cleared; give at most {MAX_BOXES}")
    numbers = [*map(_xyz, (*boxes[0], *boxes[1], *spheres)), request.spheres_to_clear_radius_m]
    if not (np.abs(np.concatenate(numbers)) <= REACH).all():
        raise ValueError(f"of what is to be cleared, a number is not finite, or beyond {REACH:g} m")
    inside = np.zeros(len(points), bool)
    for low, size in zip(map(_xyz, boxes[0]), map(_xyz, boxes[1]), strict=True):
        inside |= np.all((points >= low) & (points <= low + size), axis=1)
    for centre, radius in zip(map(_xyz, spheres), request.spheres_to_clear_radius_m, strict=True):
        inside |= np.linalg.norm(points - centre, axis=1) <= radius
    return inside


def _about(scene: Scene, age_s: float) -> dict[str, Any]:
    """The stamp of the oldest picture, and the stage of the object that was sampled least."""
    return {"stamp": time_message(min(h.stamp_ns for h in scene)), "stage": min(h.stage for h in scene), "age": age_s}


def _region(request: Any) -> Box | Points | Swept:
    if request.kind == BOX:
        low, high = ((p.x, p.y, p.z) for p in (request.box_low, request.box_high))
        return Box(low, high)
    if request.kind == POINTS:
        if len(request.points) % 3:
            raise ValueError(f"points has {len(request.points)} numbers; give x y z of each")
        return Points(np.reshape(request.points, (-1, 3)))
    if request.kind == SWEPT:
        if not 0 < len(request.boxes) <= MAX_BOXES:
            raise ValueError(f"there are {len(request.boxes)} boxes; give 1 to {MAX_BOXES}")
        sizes = [(box.size.x, box.size.y, box.size.z) for box in request.boxes]
        return Swept(np.stack([matrix(box.pose) for box in request.boxes]), np.array(sizes))
    raise ValueError(f"kind is {request.kind}; give {BOX} (box), {POINTS} (points) or {SWEPT} (swept boxes)")
