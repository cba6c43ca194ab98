"""Recorded logs: Frames out of MCAP, ROS 2 and ROS 1 recordings."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.log_messages import INFO, Received, first_messages, open_log
from perception.sources.ros_camera import other_size, to_camera
from perception.sources.ros_images import (
    POSE_TOPIC,
    stamp_ns,
    to_depth,
    to_label,
    to_rgb,
    to_transform,
)
from perception.sources.schedule_entry import SCHEDULE_TOPIC, Scheduled
from perception.sources.stamp_matcher import Match, StampMatcher
from perception.sources.topic_names import TopicNames, is_rectified
from perception.sources.topics import choose, frame_of, other_camera

_NOT_READ = (
    "FFMPEGPacket",
    "CompressedVideo",
    "theora_image_transport/msg/Packet",
    "foxglove_msgs/msg/RawImage",
    "foxglove_msgs/msg/CompressedImage",
)
# Colour images that may wait for depth which is recorded late: so many, or what fills so many bytes, but some always.
_WAITING, _WAITING_BYTES, _WAITING_LEAST = 150, 1 << 28, 30


class Log:
    """The frames of a recording: `.mcap`, `.db3`, a ROS 2 bag folder or a ROS 1 `.bag`.

    Topics are chosen as `topics` says, or given as `names`: colour, depth of the same size and camera, the camera_info
    of that camera, and labels. Each colour image gets the depth (and label) nearest in stamp within `tolerance_ns`,
    and the latest camera_info before it, else the first. With `camera` no camera_info is needed. A log without depth
    gives frames whose depth is None. A truncated MCAP gives the frames that it holds. T_world_camera is the one that
    `Recorder` wrote, else None. `notes` lists what was missing. Raises `FileNotFoundError`
    or `ValueError`, one line with the file and the remedy.
    """

    live = False

    def __init__(
        self,
        path: Path | str,
        tolerance_ns: int = 10_000_000,
        camera: Camera | None = None,
        names: TopicNames | None = None,
    ) -> None:
        self.path = Path(path)
        self.tolerance_ns = tolerance_ns
        self._pairing_notes: list[str] = []
        self._broken: list[str] = []  # why an image cannot be read, so far
        self._other_size: str | None = None  # why no camera may fit
        self._unread_infos: dict[str, None] = {}  # why, in the order of their coming
        self._read, kinds, self._notes = open_log(self.path)
        firsts = first_messages(self._read, kinds)
        images = {topic: first.message for topic, first in firsts.items() if first.kind != INFO}
        infos = {topic: first.message for topic, first in firsts.items() if first.kind == INFO and camera is None}
        try:
            chosen = choose(self.path, images, infos, names or TopicNames())
        except ValueError as error:
            others = [f"{topic} ({kind})" for topic, kind in kinds.items() if kind.endswith(_NOT_READ)]
            if others:
                error = ValueError(f"{error}; video packets and Foxglove's images are not read: {', '.join(others)}")
            raise ValueError("; ".join([str(error), *self._notes])) from None
        self.colour_topic, self.depth_topic, self.label_topic = chosen.colour, chosen.depth, chosen.label
        self.info_topic = chosen.info
        self._notes += chosen.notes
        self._colour = images[chosen.colour]  # the first one
        if camera is not None:
            self._first_camera = camera
        elif self.info_topic is not None:
            self._first_camera = self._camera(firsts[self.info_topic])
            self._other_size = other_size(firsts[self.info_topic].message, self._first_camera, self._colour)
        else:
            why = f"{self.path} has no camera_info; record the camera_info topic beside {self.colour_topic}, or give a"
            raise ValueError("; ".join([f"{why} camera file (--camera)", *self._notes]))
        self._pose_topic = POSE_TOPIC if kinds.get(POSE_TOPIC) == "geometry_msgs/msg/PoseStamped" else None
        paired = [topic for topic in (chosen.colour, chosen.depth, chosen.label) if topic]
        unstamped = [topic for topic in paired if not stamp_ns(firsts[topic].message)]
        self._by_log_time = bool(unstamped)
        if unstamped:
            self._notes.append(
                f"{self.path.name}: stamps on {', '.join(unstamped)} are empty; all images have the time of recording,"
                " by which they may be paired wrongly: set header.stamp in the driver"
            )

    @property
    def notes(self) -> list[str]:
        """What was missing; those about pairing are there when an iteration has ended."""
        lost = []
        if self._broken:
            count = "1 image" if len(self._broken) == 1 else f"{len(self._broken)} images"
            lost = [f"{count} that cannot be read left out; the first: {self._broken[0]}"]
        return self._notes + lost + self._pairing_notes

    def close(self) -> None:
        """Nothing to do: a recording is open only while it is read."""

    def schedule(self) -> list[Scheduled]:
        """The inferences in the recording's schedule, in the order of their frames; none if it has no schedule.

        Raises `ValueError` if an entry cannot be read, or is of a newer version.
        """
        texts = [received.message.data for received in self._read({SCHEDULE_TOPIC})]
        try:
            return [Scheduled.from_json(text) for text in texts]
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def frames(self, start_s: float = 0.0, end_s: float = np.inf) -> Iterator[Frame]:
        """The frames whose stamp lies from `start_s` to `end_s`, both included, after the first colour image's (s).

        Raises `ValueError`, with the log's actual range, if it has no such frame.
        """
        self._pairing_notes, self._unread_infos, self._broken = [], {}, []
        frames, unlabelled, first_ns, at = 0, 0, None, 0.0
        fallen = 0.0  # s; largest jump back of the stamps
        gaps: list[float] = []  # of the colour images that found no depth, ms
        for match in self._matches():
            colour, camera = match.lead
            first_ns = colour.stamp if first_ns is None else first_ns
            fallen = max(fallen, at - (colour.stamp - first_ns) / 1e9)
            at = max(at, (colour.stamp - first_ns) / 1e9)  # a camera's clock may be set back
            if not start_s <= at <= end_s:
                if frames and at > end_s:
                    break
                continue
            depth = match.partners[self.depth_topic] if self.depth_topic else None
            label = match.partners[self.label_topic] if self.label_topic else None
            pose = match.partners[self._pose_topic] if self._pose_topic else None
            if self.depth_topic and depth is None:
                gaps.append(match.gaps_ns[self.depth_topic] / 1e6)
                continue
            try:
                frame = self._frame(colour, depth, label, pose, camera)
            except ValueError as error:
                self._broken.append(str(error))
                continue
            frames += 1
            unlabelled += self.label_topic is not None and label is None
            yield frame
        if self._broken and not frames:
            raise ValueError("; ".join(filter(None, [self._broken[0], self._other_size])))
        limit = f"{self.tolerance_ns / 1e6:g} ms"
        if gaps and not frames:
            raise ValueError(
                f"{self.path}: none of {len(gaps)} images on {self.colour_topic} has depth within {limit} (the nearest"
                f" is {min(gaps):.1f} ms away); synchronise the streams, or raise the tolerance"
            )
        if not frames:
            until = "on" if end_s == np.inf else f"to {end_s:g} s"
            raise ValueError(f"{self.path} has no frame from {start_s:g} s {until}; it runs from 0 to {at:.3f} s")
        if gaps:
            self._pairing_notes.append(
                f"{self.path.name}: {len(gaps)} colour images without depth within {limit} skipped"
            )
        if self._unread_infos:
            self._pairing_notes.append(f"a camera_info is left out: {next(iter(self._unread_infos))}")
        if fallen > 0.0:
            self._pairing_notes.append(f"{self.path.name}: stamps jump back by {fallen:.3g} s; frames keep their order")
        if unlabelled:
            self._pairing_notes.append(f"{self.path.name}: {unlabelled} of {frames} frames have no label image")

    def _matches(self) -> Iterator[Match[tuple[Received, Camera], Received]]:
        """Every colour image with its camera and, by topic, the partner nearest in stamp."""
        streams = [topic for topic in (self.depth_topic, self.label_topic, self._pose_topic) if topic]
        waiting = max(_WAITING_LEAST, min(_WAITING, _WAITING_BYTES // max(len(self._colour.data), 1)))
        matcher: StampMatcher[tuple[Received, Camera], Received] = StampMatcher(streams, self.tolerance_ns, waiting)
        camera = self._first_camera
        for received in self._read({self.colour_topic, *filter(None, [self.info_topic]), *streams}):
            received = replace(received, by_log_time=self._by_log_time)
            if received.topic == self.info_topic:
                try:
                    camera = self._camera(received)
                except ValueError as error:  # the one before is good still
                    self._unread_infos[str(error)] = None
            elif received.topic == self.colour_topic:
                yield from matcher.push_lead(received.stamp, (received, camera))
            else:
                yield from matcher.push_partner(received.topic, received.stamp, received)
        yield from matcher.rest()

    def _frame(
        self,
        colour: Received,
        depth: Received | None,
        label: Received | None,
        pose: Received | None,
        camera: Camera,
    ) -> Frame:
        try:
            z = to_depth(depth.message) if depth else None  # Frame turns 0 into NaN
            ids = to_label(label.message) if label else None
            T = to_transform(pose.message) if pose else None
            return Frame(
                to_rgb(colour.message),
                z,
                camera,
                label=ids,
                stamp_ns=colour.stamp,
                frame_id=frame_of(colour.message),
                T_world_camera=T,
            )
        except ValueError as error:
            raise ValueError(f"{self.path}: frame at {colour.stamp} ns: {error}") from None

    def _camera(self, received: Received) -> Camera:
        try:
            if why := other_camera(received.message, self._colour):
                raise ValueError(f"it {why}; record one camera's, or give a camera file (--camera)")
            return to_camera(received.message, is_rectified(self.colour_topic))
        except ValueError as error:
            raise ValueError(f"{self.path}: {received.topic}: {error}") from None
