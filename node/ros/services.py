"""The node's services: requests become questions to `perception`, answers become responses."""

import time
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np

from node.ros.bus import Bus
from node.ros.messages import NEXT_VIEW, QUERY_REGION, make, matrix, pose, time_message
from node.ros.scene_messages import object_frame_id
from perception.answers.hypotheses import FrameName, Hypotheses
from perception.answers.query import query
from perception.answers.regions import Box, Points, Region, Swept
from perception.answers.scene import Scene

BOX, POINTS, SWEPT = 0, 1, 2  # kinds of a QueryRegion request
MAX_BOXES = 256
RING = 5  # poses about the object, where a request names no number
MAX_VIEWS = 100


class Answers:
    """The newest scene. Every answer reads it whole: inference may replace it at any time, from any thread."""

    def __init__(self, node: str = "/farside") -> None:
        """`node` is the node's full name. The names of its objects' frames begin with it."""
        self.node = node
        self._scene: Scene | None = None

    def update(self, objects: Sequence[Hypotheses]) -> None:
        """Replace the scene. What answers need is computed first, so that they do not wait."""
        for h in objects:
            _ = h.p_occupied, h.twins  # cached; p_occupied fills `solid`
        self._scene = Scene(tuple(objects)) if objects else None

    @property
    def scene(self) -> Scene:
        """The newest scene. Raises ValueError before the first."""
        if (scene := self._scene) is None:
            raise ValueError("there are no hypotheses yet; ask again when the node has seen an object")
        return scene

    def serve(self, bus: Bus) -> None:
        """Offer ~/query_region and ~/next_view."""
        bus.serve("~/query_region", QUERY_REGION, self.query_region)
        bus.serve("~/next_view", NEXT_VIEW, self.next_view)

    def query_region(self, request: Any) -> Any:
        """Answer a farside_msgs/QueryRegion request. Raises ValueError in one line for an invalid request."""
        scene = self._asked(request)
        objects = scene.objects
        found = query(objects, _region(request), self._frame(request.header.frame_id, objects))
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
        T_object_frame = objects[0].T_object_from(self._frame(request.header.frame_id, objects))
        candidates = len(request.candidates)
        if max(candidates, request.count) > MAX_VIEWS:
            raise ValueError(f"{max(candidates, request.count)} views are too many; give at most {MAX_VIEWS}")
        cameras = np.stack([T_object_frame @ matrix(p) for p in request.candidates]) if candidates else None
        rank_views = import_module(
            "perception.answers.next_view"
        ).rank_views  # imported here: it is heavy and rarely needed
        ranked = rank_views(objects, cameras, request.count or candidates or RING)
        T_frame_object = np.linalg.inv(T_object_frame)
        return make(
            f"{NEXT_VIEW}_Response",
            success=True,
            **_about(scene, (time.time_ns() - min(h.stamp_ns for h in scene)) * 1e-9),
            poses=[pose(T_frame_object @ T) for T in ranked.T_object_camera],
            gain_nats=np.asarray(ranked.gain_nats, np.float64),
        )

    def _asked(self, request: Any) -> Scene:
        """The newest scene, or the one object of it that a request names."""
        scene = self.scene
        if not request.object_id:
            return scene
        return Scene((scene.by_id(request.object_id),))

    def _frame(self, name: str, objects: Sequence[Hypotheses]) -> FrameName:
        """The frame that a request's frame_id names. Raises ValueError for an unknown one, and for an object's frame if
        the request is about several objects.
        """
        own = [object_frame_id(self.node, h.object_id) for h in objects]
        aliases: dict[str, FrameName] = {"object": "object", "camera": "camera", "world": "world"}
        aliases |= {objects[0].frame_id: "camera", **dict.fromkeys(own, "object")}
        if name not in aliases:
            raise ValueError(f"frame_id is {name!r}; give one of {', '.join(aliases)}")
        if aliases[name] == "object" and len(objects) > 1:
            raise ValueError(
                f"frame_id {name!r} is ambiguous with {len(objects)} objects; give the object_id of one,"
                " or ask in the frame camera or world"
            )
        return aliases[name]


def _about(scene: Scene, age_s: float) -> dict[str, Any]:
    """The stamp of the oldest picture, and the stage of the object that was sampled least."""
    return {"stamp": time_message(min(h.stamp_ns for h in scene)), "stage": min(h.stage for h in scene), "age": age_s}


def _region(request: Any) -> Region:
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
