"""Recorded logs: Frames out of MCAP, ROS 2 and ROS 1 recordings."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from calibration.camera import Camera
from foundation.one_line import one_line
from perception.sources.frame import Frame
from perception.sources.ros_images import (
    POSE_TOPIC,
    stamp_ns,
    to_camera,
    to_depth,
    to_label,
    to_rgb,
    to_transform,
)
from perception.sources.schedule_entry import SCHEDULE_TOPIC, Scheduled
from perception.sources.stamp_matcher import Match, StampMatcher
from perception.sources.topic_names import TopicNames, is_rectified
from perception.sources.topics import choose, frame_of, other_camera

_KINDS = tuple(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_IMAGE, _COMPRESSED, _INFO = _KINDS
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class _Received:
    """One message of a log."""

    topic: str
    kind: str  # message type
    log_time: int  # ns
    message: Any
    by_log_time: bool = False  # some stream of its log has no stamps

    @property
    def stamp(self) -> int:
        """The header's stamp (ns), or the time of recording where the driver left it empty."""
        return self.log_time if self.by_log_time else stamp_ns(self.message) or self.log_time


_Read = Callable[[set[str]], Iterator[_Received]]  # the messages of these topics, in order


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
        self._read, kinds, self._notes = open_log(self.path)
        firsts = first_messages(self._read, kinds)
        images = {topic: first.message for topic, first in firsts.items() if first.kind != _INFO}
        infos = {topic: first.message for topic, first in firsts.items() if first.kind == _INFO and camera is None}
        chosen = choose(self.path, images, infos, names or TopicNames())
        self.colour_topic, self.depth_topic, self.label_topic = chosen.colour, chosen.depth, chosen.label
        self.info_topic = chosen.info
        self._notes += chosen.notes
        self._colour = images[chosen.colour]  # the first one
        if camera is not None:
            self._first_camera = camera
        elif self.info_topic is not None:
            self._first_camera = self._camera(firsts[self.info_topic])
        else:
            raise ValueError(
                f"{self.path} has no camera_info; record the camera_info topic beside {self.colour_topic}, or give a"
                " camera file (--camera)"
            )
        self._pose_topic = POSE_TOPIC if POSE_TOPIC in kinds else None
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
        return self._notes + self._pairing_notes

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
        self._pairing_notes = []
        frames, unlabelled, first_ns, at = 0, 0, None, 0.0
        gaps: list[float] = []  # of the colour images that found no depth, ms
        for match in self._matches():
            colour, camera = match.lead
            first_ns = colour.stamp if first_ns is None else first_ns
            at = (colour.stamp - first_ns) / 1e9
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
            frames += 1
            unlabelled += self.label_topic is not None and label is None
            yield self._frame(colour, depth, label, pose, camera)
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
        if unlabelled:
            self._pairing_notes.append(f"{self.path.name}: {unlabelled} of {frames} frames have no label image")

    def _matches(self) -> Iterator[Match[tuple[_Received, Camera], _Received]]:
        """Every colour image with its camera and, by topic, the partner nearest in stamp."""
        streams = [topic for topic in (self.depth_topic, self.label_topic, self._pose_topic) if topic]
        matcher: StampMatcher[tuple[_Received, Camera], _Received] = StampMatcher(streams, self.tolerance_ns)
        camera = self._first_camera
        for received in self._read({self.colour_topic, *filter(None, [self.info_topic]), *streams}):
            received = replace(received, by_log_time=self._by_log_time)
            if received.topic == self.info_topic:
                camera = self._camera(received)
            elif received.topic == self.colour_topic:
                yield from matcher.push_lead(received.stamp, (received, camera))
            else:
                yield from matcher.push_partner(received.topic, received.stamp, received)
        yield from matcher.rest()

    def _frame(
        self,
        colour: _Received,
        depth: _Received | None,
        label: _Received | None,
        pose: _Received | None,
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

    def _camera(self, received: _Received) -> Camera:
        try:
            if why := other_camera(received.message, self._colour):
                raise ValueError(f"it {why}; record one camera's, or give a camera file (--camera)")
            return to_camera(received.message, is_rectified(self.colour_topic))
        except ValueError as error:
            raise ValueError(f"{self.path}: {received.topic}: {error}") from None


def first_messages(read: _Read, kinds: dict[str, str]) -> dict[str, _Received]:
    """The first message of each topic of images and camera_info."""
    wanted = {topic for topic, kind in kinds.items() if kind in _KINDS}
    firsts: dict[str, _Received] = {}
    for received in read(wanted):
        firsts.setdefault(received.topic, received)
        if len(firsts) == len(wanted):
            break
    return firsts


def open_log(path: Path) -> tuple[_Read, dict[str, str], list[str]]:
    """A function that reads messages, the type of each topic that holds any, and notes."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give a recording (.mcap, .bag, ROS 2 bag folder)")
    if path.is_dir() and not (path / "metadata.yaml").exists():  # as a recorder leaves it that was killed
        inside = sorted(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
        if len(inside) != 1:
            raise ValueError(f"{path} holds neither color.png nor one recording; give a frame folder or a recording")
        path = inside[0]

    def read(topics: set[str]) -> Iterator[_Received]:
        try:
            with AnyReader([path], default_typestore=_TYPES) as reader:
                wanted = [c for c in reader.connections if c.topic in topics]
                for connection, time, raw in reader.messages(wanted) if wanted else ():
                    kind = connection.msgtype
                    message: Any = reader.deserialize(raw, kind)
                    if lacks := _fields(kind) - {name.lower() for name in message.__dataclass_fields__}:
                        raise ValueError(f"its definition of {kind} lacks {', '.join(sorted(lacks))}")
                    yield _Received(connection.topic, kind, time, message)
        except Exception as error:  # whichever parser meets the damage first; the caller's own errors do not pass here
            raise ValueError(f"{path} is damaged ({one_line(error)}); record it again") from None

    try:
        with AnyReader([path], default_typestore=_TYPES) as reader:
            return read, {c.topic: c.msgtype for c in reader.connections if c.msgcount}, []
    except Exception as error:
        mcaps = sorted(path.glob("*.mcap")) if path.is_dir() else [path] if path.suffix == ".mcap" else []
        if mcaps:
            return _open_cut(mcaps)
        remedy = (
            "repair it with `rosbag reindex`" if path.suffix == ".bag" else "give a .mcap, .bag or ROS 2 bag folder"
        )
        raise ValueError(f"{path} cannot be read as a recording ({one_line(error)}); {remedy}") from None


@cache
def _fields(kind: str) -> frozenset[str]:
    """The fields of a standard type, in small letters (ROS 1 wrote K, D, P); none of another type."""
    return frozenset(name.lower() for name, _ in _TYPES.fielddefs[kind][1]) if kind in _TYPES.fielddefs else frozenset()


def _open_cut(paths: list[Path]) -> tuple[_Read, dict[str, str], list[str]]:
    """The same for MCAP files that the indexed reader refuses, read from the front for as long as they last."""

    def records(path: Path) -> Iterator[tuple[str, str, Message]]:
        """Topic, type and message of every record of one file that is whole."""
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream, validate_crcs=True).records:
                    if isinstance(record, Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, Channel) and record.message_encoding == "cdr":
                        channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
                    elif isinstance(record, Message) and record.channel_id in channels:
                        yield *channels[record.channel_id], record
            except Exception:  # the file's end, or a record that makes no sense: nothing more is there to read
                return

    def read(topics: set[str]) -> Iterator[_Received]:
        for path in paths:
            for topic, kind, message in records(path):
                if topic in topics:
                    yield _Received(topic, kind, message.log_time, _TYPES.deserialize_cdr(message.data, kind))

    kinds: dict[str, str] = {}
    notes = []
    for path in paths:
        count = 0
        for topic, kind, _ in records(path):
            kinds[topic] = kind
            count += 1
        with path.open("rb") as stream:
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(size - len(_MAGIC), 0))
            if stream.read() != _MAGIC:
                notes.append(f"{path.name} is cut short at byte {size}; {count} messages recovered")
    if not kinds:
        raise ValueError(f"{paths[0]} holds no readable message; record it again")
    return read, kinds, notes
