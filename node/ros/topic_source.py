"""Frames from any ROS 2 camera driver, over the bus: image, depth and camera_info topics, paired by their stamps.

Detections of another node, if wanted, become the frames' label maps."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from node.ros.bus import Bus
from node.ros.detections import DETECTIONS_IN, BoxPx, boxes_of, kept_ids
from node.ros.settings import TopicConfig
from perception.observation.segmentation import label_boxes
from perception.observation.settings import SegmentConfig
from perception.sources.frame import Frame
from perception.sources.ros_camera import is_empty, to_camera
from perception.sources.ros_images import stamp_ns, to_depth, to_rgb
from perception.sources.stamp_matcher import Match, StampMatcher
from perception.sources.topic_names import is_rectified
from perception.sources.topics import doubt, frame_of, not_aligned, other_camera

_IMAGE, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))

_DETECTING = 6  # times as many images wait where a detector takes its time


class TopicSource:
    """A live source: iterate over it for the newest frames. Frames that arrive while one is processed are skipped.

    `notes` reports what was missing or wrong, once a kind and how often. `dropped` counts the colour images without
    depth, `skipped` the frames that came too fast, or that have no detections where these are wanted. It listens until
    `bus` ends; `close` ends an iteration.
    """

    live = True

    def __init__(self, bus: Bus, config: TopicConfig | None = None, segment: SegmentConfig | None = None) -> None:
        self.config = c = config or TopicConfig()
        self._notes: dict[str, tuple[str, int]] = {}  # by kind: the last one, and how many
        self.dropped = self.skipped = 0
        self._changed = threading.Condition()
        self._segment = segment
        streams = tuple(filter(None, (c.depth, c.detections)))
        waiting = c.waiting if c.detections is None else _DETECTING * c.waiting
        self._matcher: StampMatcher[Any, Any] = StampMatcher(streams, round(c.tolerance_ms * 1e6), waiting, 2 * waiting)
        # the number of the newest pair, its colour, its depth and detections
        self._matched: tuple[int, Any, dict[str, Any]] | None = None
        self._order = self._made = 0  # numbers of the newest pair and of the newest that became a frame
        self._info: Any = None
        self._by_arrival = False  # some stream has no stamps
        self._boxes: dict[int, BoxPx] = {}  # of the last detections, by id
        self._heard: dict[str, int] = {}  # topics on which something came since the last frame, with the newest stamp
        self._gaps: dict[str, float] = {}  # by topic: how near (ns) the nearest came to a colour image since then
        self._newest: tuple[Frame, list[BoxPx] | None] | None = None
        self._closed = False
        compressed = c.colour.endswith("/compressed")
        self._names = [bus.subscribe(c.info, _INFO, self._take_info, depth=1)]
        self._names.append(bus.subscribe(c.colour, _COMPRESSED if compressed else _IMAGE, self._take_colour, depth=3))
        if c.depth is not None:
            packed = c.depth.endswith("/compressed") or c.depth.endswith("/compressedDepth")
            self._names.append(bus.subscribe(c.depth, _COMPRESSED if packed else _IMAGE, self._take_depth, depth=3))
        if c.detections is not None:
            self._names.append(bus.subscribe(c.detections, DETECTIONS_IN, self._take_detections, depth=10))

    @property
    def notes(self) -> list[str]:
        """What was missing or wrong so far."""
        with self._changed:
            return [text + (f" ({count} times)" if count > 1 else "") for text, count in self._notes.values()]

    def close(self) -> None:
        """End the iteration, from any thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        heard = noted = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._closed, timeout=0.1)
                if self._closed:
                    return
                newest, self._newest = self._newest, None
            now = time.monotonic()
            frame = None if newest is None else self._labelled(*newest)
            if frame is not None:
                yield frame
                heard = noted = time.monotonic()
            elif self.config.end_s is not None and now - heard > self.config.end_s:
                return
            elif now - noted > self.config.silence_s:
                noted = float("inf")  # said once, until a frame comes
                self._note("silent", self._why_silent(now - heard))

    def _why_silent(self, seconds: float) -> str:
        c, silent = self.config, f"no frame for {seconds:.1f} s"
        partners = [topic for topic in (c.detections, c.depth) if topic]
        with self._changed:
            heard = {**self._heard, **({} if self._info is None else {c.info: 0})}
            wanted = (c.info, c.colour, *reversed(partners))  # as `_names`
            missing = [name for name, topic in zip(self._names, wanted, strict=True) if topic not in heard]
            gaps = {} if missing else {topic: float(abs(heard[topic] - heard[c.colour])) for topic in partners}
            gaps |= self._gaps
        if missing:
            what = f"nothing came on {', '.join(missing)}"
            return f"{silent}: {what}; is the driver up, on this domain and with these topic names?"
        far = [topic for topic in partners if gaps[topic] > c.tolerance_ms * 1e6]
        if not far:
            return f"{silent}: nothing is to be inferred from what came; the other notes say why"
        remedy = "synchronise the streams, or raise tolerance_ms"
        if far[0] == c.detections:
            remedy = (
                "have the detector copy header.stamp of its image, or raise tolerance_ms; if it is more than"
                f" {_DETECTING * c.waiting} images late, raise waiting"
            )
        within, nearest = f"within {c.tolerance_ms:g} ms", f"the nearest is {gaps[far[0]] / 1e6:.1f} ms away"
        return f"{silent}: nothing on {far[0]} has the stamp of a colour image {within} ({nearest}); {remedy}"

    def _take_info(self, info: Any) -> None:
        if is_empty(info):
            self._note("empty", f"camera_info on {self.config.info} is empty: the camera is not calibrated")
            return
        with self._changed:
            self._info = info
        self._make_frame()

    def _take_colour(self, message: Any) -> None:
        with self._changed:
            c = self.config
            stamp = self._heard[c.colour] = self._stamp(c.colour, message)
            self._settle(self._matcher.push_lead(stamp, (stamp, message)))
        self._make_frame()

    def _take_depth(self, message: Any) -> None:
        depth = self.config.depth
        assert depth is not None
        with self._changed:
            stamp = self._heard[depth] = self._stamp(depth, message)
            self._settle(self._matcher.push_partner(depth, stamp, message))
        self._make_frame()

    def _take_detections(self, message: Any) -> None:
        topic = self.config.detections
        assert topic is not None
        with self._changed:
            stamp = self._heard[topic] = self._stamp(topic, message)
            self._settle(self._matcher.push_partner(topic, stamp, message))
        self._make_frame()

    def _labelled(self, frame: Frame, boxes: list[BoxPx] | None) -> Frame | None:
        """The frame with the things in the boxes as its label map; None: nothing is to be seen in them. Without a box
        the map names nothing.
        """
        if boxes is None:
            return frame
        try:
            label, why = label_boxes(frame, boxes, self._segment)
        except ValueError as error:
            self._note("detections", f"detections are left out: {error}")
            return None
        for reason in why:
            self._note("a detection", f"a detection is left out: {reason}")
        ids = kept_ids(boxes, self._boxes)
        self._boxes = dict(zip(ids, boxes, strict=True))
        if boxes and not label.any():  # said, as silence would mean that the camera is down
            self.skipped += 1
            self._note("no detection", "a frame is passed over: nothing is to be seen in the boxes of its detections")
            return None
        return replace(frame, label=np.array([0, *ids], np.int32)[label])

    def _settle(self, matches: list[Match[Any, Any]]) -> None:
        """Keep the newest pair, and count dropped pairs. The caller holds the lock."""
        depth = self.config.depth
        for match in matches:
            for topic, gap in match.gaps_ns.items():
                if gap < self._gaps.get(topic, float("inf")):
                    self._gaps[topic] = gap
            if depth is None or match.partners[depth] is not None:
                if self.config.detections is not None and match.partners[self.config.detections] is None:
                    self.skipped += 1
                    continue
                self.skipped += self._matched is not None and self._info is not None
                self._order += 1
                self._matched = self._order, match.lead, match.partners
                continue
            self.dropped += 1
            if (gap := match.gaps_ns[depth]) < float("inf"):
                self._note(
                    "dropped",
                    f"colour images are dropped for want of depth within {self.config.tolerance_ms:g} ms (the nearest"
                    f" was {gap / 1e6:.1f} ms away); synchronise the streams, or raise tolerance_ms",
                )

    def _make_frame(self) -> None:
        """The newest frame from the complete pair, if there is one."""
        with self._changed:
            if self._info is None or self._matched is None:
                return
            (order, (stamp, colour), partners), self._matched = self._matched, None
            info, c = self._info, self.config
        try:
            frame = self._frame(stamp, colour, None if c.depth is None else partners[c.depth], info)
            boxes = None
            if c.detections is not None:
                size = frame.camera.width, frame.camera.height
                boxes = boxes_of(partners[c.detections], frame.frame_id, size, c.least_score)
        except ValueError as error:
            self._note("left out", f"frames are left out: {error}")
            raise ValueError(f"a frame is left out: {error}") from None  # the bus counts it
        with self._changed:
            self._heard.clear()
            self._gaps.clear()
            late = order < self._made  # another thread was quicker with a newer one, which may be in use
            self.skipped += late or self._newest is not None
            if not late and (self._newest is None or frame.stamp_ns > self._newest[0].stamp_ns):
                self._made, self._newest = order, (frame, boxes)
            self._changed.notify_all()

    def _frame(self, stamp: int, colour: Any, depth: Any, info: Any) -> Frame:
        c = self.config
        if why := other_camera(info, colour):
            raise ValueError(f"camera_info on {c.info} {why} ({c.colour}); give the camera_info of that camera as info")
        camera = to_camera(info, is_rectified(c.colour) if c.rectified is None else c.rectified)
        metres = None
        if depth is not None:
            if not c.aligned and (why := not_aligned(depth, colour)):
                raise ValueError(f"depth on {c.depth} {why} to {c.colour}; give the aligned one, or say aligned: true")
            metres = to_depth(depth)
            if why := doubt(metres):
                raise ValueError(f"{c.depth} is no depth: {why}; give the camera's depth image, in m (32FC1) or mm")
        return Frame(to_rgb(colour), metres, camera, stamp_ns=stamp, frame_id=frame_of(colour))

    def _stamp(self, topic: str, message: Any) -> int:
        """The stamp of an image (ns), or its time of arrival once one came without a stamp. The lock is held."""
        stamp = stamp_ns(message)
        if not stamp:
            self._by_arrival = True
            self._note(
                f"unstamped {topic}",
                f"stamps on {topic} are empty; all images have the time of their arrival, by which they may be paired"
                " wrongly: set header.stamp in the driver",
            )
        return time.time_ns() if self._by_arrival else stamp

    def _note(self, kind: str, text: str) -> None:
        """Keep the newest text of a kind, and count."""
        with self._changed:
            self._notes[kind] = text, self._notes.get(kind, ("", 0))[1] + 1
