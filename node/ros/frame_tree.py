"""The frames of a robot, from /tf and /tf_static, as tf2 keeps them: where one lay in another at a time."""

import threading
from bisect import bisect_left
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.pose_files import Mounting
from node.ros.bus import Bus
from node.ros.messages import make, matrix
from node.ros.scene_messages import transform_message

TRANSFORMS = "tf2_msgs/msg/TFMessage"
KEPT_NS = 10_000_000_000  # of each moving frame; as tf2
GAP_NS = 100_000_000  # by which a time may lie outside of what came
MAX_FRAMES = 2000

Matrix = Float[np.ndarray, "4 4"]


@dataclass
class _Edge:
    """Where a frame lies in its parent: p_parent = T @ p_child."""

    parent: str
    stamps: list[int] = field(default_factory=list)  # ns, rising; none: it does not move
    places: list[Matrix] = field(default_factory=list)
    pinned: tuple[int, Matrix] | None = None  # at a time that is asked for again, when `stamps` have moved on

    def add(self, stamp: int, T: Matrix) -> None:
        if self.stamps and stamp < self.stamps[-1] - KEPT_NS:  # a recording that began again
            self.stamps, self.places = [], []
        at = bisect_left(self.stamps, stamp)
        if at < len(self.stamps) and self.stamps[at] == stamp:
            self.places[at] = T
            return
        self.stamps.insert(at, stamp)
        self.places.insert(at, T)
        old = bisect_left(self.stamps, self.stamps[-1] - KEPT_NS)
        del self.stamps[:old], self.places[:old]

    def at(self, stamp: int) -> Matrix | None:
        """The place at a time, between its neighbours; None where nothing came near it."""
        if not self.stamps:
            return self.places[0]
        after = bisect_left(self.stamps, stamp)
        near = [i for i in (after - 1, after) if 0 <= i < len(self.stamps)]
        if len(near) == 2:
            low, high = self.stamps[near[0]], self.stamps[near[1]]
            return _between(self.places[near[0]], self.places[near[1]], (stamp - low) / (high - low))
        if abs(self.stamps[near[0]] - stamp) <= GAP_NS:
            return self.places[near[0]]
        return self.pinned[1] if self.pinned is not None and self.pinned[0] == stamp else None


def _between(first: Matrix, second: Matrix, share: float) -> Matrix:
    """A rigid transform between two that are near each other: the rotation nearest to their weighted mean."""
    T = (1.0 - share) * first + share * second
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ Vt
    return T


class FrameTree:
    """The frames on /tf and /tf_static. All methods may be called from any thread."""

    def __init__(self, bus: Bus | None = None) -> None:
        """With a bus it listens to the two topics."""
        self._edges: dict[str, _Edge] = {}
        self._own = plain(bus.node.resolve("~/object_")) if bus is not None else None  # frames that the node publishes
        self._lock = threading.Lock()
        if bus is not None:
            bus.subscribe("/tf", TRANSFORMS, self.take, depth=100)
            bus.subscribe("/tf_static", TRANSFORMS, lambda m: self.take(m, static=True), latched=True, depth=100)

    def take(self, message: Any, static: bool = False) -> None:
        """Keep the transforms of a tf2_msgs/TFMessage. Raises ValueError for a wrong one; the others are kept."""
        trouble = ""
        for it in message.transforms:
            child, parent = plain(it.child_frame_id), plain(it.header.frame_id)
            if self._own is not None and child.startswith(self._own):
                continue
            try:
                T = matrix(SimpleNamespace(position=it.transform.translation, orientation=it.transform.rotation))
            except ValueError as error:
                trouble = f"the transform of frame {child!r} is left out: {error}"
                continue
            with self._lock:
                edge = self._edges.get(child)
                if edge is None and len(self._edges) >= MAX_FRAMES:
                    trouble = f"frame {child!r} is left out: there are {MAX_FRAMES} already"
                    continue
                if edge is None or edge.parent != parent or static or not edge.stamps:
                    edge = self._edges[child] = _Edge(parent)
                if static:
                    edge.places = [T]
                else:
                    edge.add(it.header.stamp.sec * 1_000_000_000 + it.header.stamp.nanosec, T)
        if trouble:
            raise ValueError(trouble)

    def mount(self, bus: Bus, camera: Mounting) -> None:
        """Keep where a camera is on the robot, and publish it on /tf_static for all."""
        message = make(
            TRANSFORMS, transforms=[transform_message(camera.T_parent_camera, 0, camera.parent, camera.camera)]
        )
        self.take(message, static=True)
        bus.publisher("/tf_static", TRANSFORMS, latched=True).publish(message)

    def pin(self, stamp: int) -> None:
        """Keep all places at this time (ns), of the picture that questions are about, until the next is pinned."""
        with self._lock:
            for edge in self._edges.values():
                if edge.stamps and (T := edge.at(stamp)) is not None:
                    edge.pinned = stamp, T

    def knows(self, frame: str) -> bool:
        """Whether a frame has been named."""
        with self._lock:
            return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def T(self, target: str, source: str, stamp: int) -> Matrix:
        """p_target = T @ p_source (metres) at a time (ns).

        Raises ValueError where the two are not connected, or where nothing came near that time.
        """
        with self._lock:
            above_target, above_source = self._upward(target), self._upward(source)
            shared = next((frame for frame in above_source if frame in above_target), None)
            if shared is None:
                raise ValueError(
                    f"frame_id is {source!r}, which /tf does not connect to {target!r}; is its publisher up?"
                )
            T_target, T_source = (
                self._down(above[: above.index(shared)], stamp) for above in (above_target, above_source)
            )
        return np.linalg.inv(T_target) @ T_source

    def _upward(self, frame: str) -> list[str]:
        """A frame and those above it."""
        found = [frame]
        while (edge := self._edges.get(found[-1])) is not None and edge.parent not in found:
            found.append(edge.parent)
        return found

    def _down(self, frames: list[str], stamp: int) -> Matrix:
        """p_above = T @ p_first, of frames each of which lies in the next, and the last in `above`."""
        T = np.eye(4)
        for frame in frames:
            if (step := self._edges[frame].at(stamp)) is None:
                raise ValueError(
                    f"/tf has no place of frame {frame!r} within {GAP_NS / 1e9:g} s of the picture's time"
                    f" ({stamp / 1e9:.3f} s); do the clocks of camera and robot agree?"
                )
            T = step @ T
        return T


def plain(frame: str) -> str:
    """A frame's name without the slash that ROS 1 allowed before it."""
    return frame.removeprefix("/")
