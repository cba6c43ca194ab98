"""Recorded logs: Frames out of MCAP, ROS 2 and ROS 1 recordings, and into MCAP."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from calibration.camera import Camera
from perception.encoding import COLOURS, encoding_of, is_depth, samples, stamp_ns, to_camera, to_depth, to_label, to_rgb
from perception.source import Frame

_KINDS = tuple(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_IMAGE, _COMPRESSED, _INFO = _KINDS
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_MAGIC = b"\x89MCAP0\r\n"
# The topics that `write_log` writes, by message type.
_INFO_OUT, _COLOUR_OUT = "/camera/color/camera_info", "/camera/color/image_raw/compressed"
_DEPTH_OUT, _LABEL_OUT = "/camera/aligned_depth_to_color/image_raw", "/camera/color/label"
_WRITTEN = {_INFO: (_INFO_OUT,), _COMPRESSED: (_COLOUR_OUT,), _IMAGE: (_DEPTH_OUT, _LABEL_OUT)}
_CHUNK = 1 << 18  # bytes; what a cut file loses at its end
_WAITING = 30  # colour images that may wait for their depth before they are given up


@dataclass(frozen=True)
class _Received:
    """One message of a log."""

    topic: str
    kind: str  # message type
    log_time: int  # ns
    message: Any

    @property
    def stamp(self) -> int:
        """The header's stamp (ns), or the time of recording where the driver left it empty."""
        return stamp_ns(self.message) or self.log_time


_Read = Callable[[set[str]], Iterator[_Received]]  # the messages of these topics, in order


class Log:
    """The frames of a recording: `.mcap`, `.db3`, a ROS 2 bag folder or a ROS 1 `.bag`.

    Topics are found by type: the colour image, the depth image of the same size, the camera_info beside the colour, and
    a label image whose topic has a part named label or segmentation. Each colour image takes the depth (and label)
    nearest in stamp within `tolerance_ns`, and the latest camera_info before it, else the first. A log without depth
    gives frames whose depth is None; an MCAP that is cut short gives the frames that are there. T_world_camera is None.
    `notes` says what was missing. Raises `FileNotFoundError` or `ValueError`, one line with the file and the remedy.
    """

    def __init__(self, path: Path | str, tolerance_ns: int = 10_000_000) -> None:
        self.path = Path(path)
        self.tolerance_ns = tolerance_ns
        self._pairing_notes: list[str] = []
        self._read, kinds, self._notes = _open(self.path)
        wanted = {topic for topic, kind in kinds.items() if kind in _KINDS}
        by_topic: dict[str, _Received] = {}
        for received in self._read(wanted):
            by_topic.setdefault(received.topic, received)
            if len(by_topic) == len(wanted):
                break
        infos = [topic for topic, first in by_topic.items() if first.kind == _INFO]
        firsts = [first for first in by_topic.values() if first.kind != _INFO]
        labels = [f for f in firsts if {"label", "segmentation"} & set(f.topic.split("/"))]
        depths = [f for f in firsts if f not in labels and is_depth(f.message, f.topic)]
        colours = [f for f in firsts if f not in labels and encoding_of(f.message) in COLOURS]
        if not colours:
            seen = ", ".join(f"{f.topic} ({encoding_of(f.message)})" for f in firsts) or "none"
            raise ValueError(
                f"{self.path} has no colour image (images: {seen}); record one as {', '.join(COLOURS)} or JPEG"
            )
        # Infrared pictures are mono8 too; a raw picture needs no decoding.
        names = ("color", "colour", "rgb")
        colour = max(
            colours,
            key=lambda f: (encoding_of(f.message) != "mono8", any(n in f.topic for n in names), f.kind == _IMAGE),
        )
        self.colour_topic = colour.topic

        def kinship(topic: str) -> int:  # leading parts of the name shared with the colour topic
            pairs = zip(topic.split("/"), colour.topic.split("/"), strict=False)
            return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))

        if not infos:
            raise ValueError(f"{self.path} has no camera_info; record the camera_info topic beside {self.colour_topic}")
        self.info_topic = max(infos, key=kinship)
        self._first_camera = self._camera(by_topic[self.info_topic])
        size = self._size(colour)
        fitting = [f for f in depths if self._size(f) == size]
        if depths and not fitting:
            raise ValueError(
                f"{self.path}: depth on {depths[0].topic} is {self._size(depths[0])} px but colour on {colour.topic} is"
                f" {size}; record the depth that is aligned to colour"
            )
        depth = max(fitting, key=lambda f: ("aligned" in f.topic, kinship(f.topic)), default=None)
        label = max(labels, key=lambda f: kinship(f.topic), default=None)
        self.depth_topic = depth.topic if depth else None
        self.label_topic = label.topic if label else None
        if depth is None:
            self._notes.append(f"{self.path.name} has no depth image; its frames carry colour alone")
        elif (a := depth.message.header.frame_id) != (b := colour.message.header.frame_id):
            self._notes.append(f"{self.path.name}: depth is in frame {a!r} and colour in {b!r}; taken as aligned")

    @property
    def notes(self) -> list[str]:
        """What was missing; those about pairing are there when an iteration has ended."""
        return self._notes + self._pairing_notes

    def __iter__(self) -> Iterator[Frame]:
        self._pairing_notes = []
        frames, unlabelled = 0, 0
        gaps: list[float] = []  # of the colour images that found no depth, ms
        for colour, camera, found in self._matches():
            depth, gap = found[self.depth_topic] if self.depth_topic else (None, 0.0)
            label, _ = found[self.label_topic] if self.label_topic else (None, 0.0)
            if self.depth_topic and depth is None:
                gaps.append(gap)
                continue
            frames += 1
            unlabelled += self.label_topic is not None and label is None
            yield self._frame(colour, depth, label, camera)
        limit = f"{self.tolerance_ns / 1e6:g} ms"
        if gaps and not frames:
            raise ValueError(
                f"{self.path}: none of {len(gaps)} images on {self.colour_topic} has depth within {limit} (the nearest"
                f" is {min(gaps):.1f} ms away); synchronise the streams, or raise the tolerance"
            )
        if gaps:
            self._pairing_notes.append(
                f"{self.path.name}: {len(gaps)} colour images without depth within {limit} skipped"
            )
        if unlabelled:
            self._pairing_notes.append(f"{self.path.name}: {unlabelled} of {frames} frames have no label image")

    def _matches(self) -> Iterator[tuple[_Received, Camera, dict[str | None, tuple[_Received | None, float]]]]:
        """Every colour image with its camera and, by topic, the partner nearest in stamp with its distance (ms)."""
        camera = self._first_camera
        partners: dict[str | None, deque[_Received]] = {t: deque() for t in (self.depth_topic, self.label_topic) if t}
        waiting: deque[tuple[_Received, Camera]] = deque()

        def nearest(queue: deque[_Received], stamp: int) -> tuple[_Received | None, float]:
            while len(queue) > 1 and queue[0].stamp < stamp - self.tolerance_ns:
                queue.popleft()
            best = min(queue, key=lambda r: abs(r.stamp - stamp), default=None)
            gap = abs(best.stamp - stamp) if best else np.inf
            return (best if gap <= self.tolerance_ns else None), gap / 1e6

        def settled(
            stamp: int,
        ) -> bool:  # stamps rise within a topic: a partner no older than the colour ends the search
            return len(waiting) > _WAITING or all(q and q[-1].stamp >= stamp for q in partners.values())

        def take() -> tuple[_Received, Camera, dict[str | None, tuple[_Received | None, float]]]:
            colour, its_camera = waiting.popleft()
            return colour, its_camera, {topic: nearest(queue, colour.stamp) for topic, queue in partners.items()}

        for received in self._read({self.colour_topic, self.info_topic} | {t for t in partners if t}):
            if received.topic == self.info_topic:
                camera = self._camera(received)
            elif received.topic == self.colour_topic:
                waiting.append((received, camera))
            else:
                partners[received.topic].append(received)
            while waiting and settled(waiting[0][0].stamp):
                yield take()
        while waiting:
            yield take()

    def _frame(self, colour: _Received, depth: _Received | None, label: _Received | None, camera: Camera) -> Frame:
        try:
            z = to_depth(depth.message) if depth else None  # Frame turns 0 into NaN
            ids = to_label(label.message) if label else None
            return Frame(colour.stamp, colour.message.header.frame_id, to_rgb(colour.message), z, ids, camera)
        except ValueError as error:
            raise ValueError(f"{self.path}: frame at {colour.stamp} ns: {error}") from None

    def _camera(self, received: _Received) -> Camera:
        try:
            return to_camera(received.message, rectified="rect" in self.colour_topic)
        except ValueError as error:
            raise ValueError(f"{self.path}: {received.topic}: {error}") from None

    def _size(self, received: _Received) -> str:
        try:
            return "{1}x{0}".format(*samples(received.message).shape)
        except ValueError as error:
            raise ValueError(f"{self.path}: {received.topic}: {error}") from None


def _open(path: Path) -> tuple[_Read, dict[str, str], list[str]]:
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
                    yield _Received(connection.topic, kind, time, reader.deserialize(raw, kind))
        except Exception as error:  # whichever parser meets the damage first; the caller's own errors do not pass here
            raise ValueError(f"{path} is damaged ({_line(error)}); record it again") from None

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
        raise ValueError(f"{path} cannot be read as a recording ({_line(error)}); {remedy}") from None


def _open_cut(paths: list[Path]) -> tuple[_Read, dict[str, str], list[str]]:
    """The same for MCAP files that the indexed reader refuses, read from the front for as long as they last."""

    def records(path: Path) -> Iterator[tuple[str, str, Message]]:
        schemas: dict[int, str] = {}
        channels: dict[int, tuple[str, str]] = {}
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
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
        data = path.read_bytes()
        if not data.endswith(_MAGIC):
            notes.append(f"{path.name} is cut short at byte {len(data)}; {count} messages recovered")
    if not kinds:
        raise ValueError(f"{paths[0]} holds no readable message; record it again")
    return read, kinds, notes


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def write_log(path: Path | str, frames: Iterable[Frame]) -> int:
    """Writes frames to one `.mcap` (profile ros2) and returns their number.

    Colour is PNG, depth raw 16UC1 in whole millimetres (0 where unknown or beyond 65 m), the label mono8 or 16UC1, each
    with the frame's stamp; T_world_camera and the calibration's deviations have no place in these messages.
    The file appears whole or not at all. Raises `ValueError` where there is no frame or a label does not fit 16 bits.
    """
    path = Path(path)
    part = path.with_name(path.name + ".part")
    count = 0
    try:
        with part.open("wb") as stream:
            writer = Writer(stream, chunk_size=_CHUNK)
            writer.start(profile="ros2", library="farside")
            channels = {}
            for kind, topics in _WRITTEN.items():
                definition = _TYPES.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", definition.encode())
                for topic in topics:
                    channels[topic] = (
                        writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""}),
                        kind,
                    )
            for frame in frames:
                for topic, message in _to_messages(frame).items():
                    channel, kind = channels[topic]
                    data = bytes(_TYPES.serialize_cdr(message, kind))
                    writer.add_message(channel, frame.stamp_ns, data, frame.stamp_ns, count)
                count += 1
            writer.finish()
        if not count:
            raise ValueError(f"{path}: there is no frame to write")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return count


def _to_messages(frame: Frame) -> dict[str, Any]:
    """The messages of one frame by topic."""
    types = _TYPES.types
    sec, nanosec = divmod(frame.stamp_ns, 1_000_000_000)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](sec, nanosec), frame.frame_id)

    def image(plane: np.ndarray, encoding: str) -> Any:
        data = np.ascontiguousarray(plane).view(np.uint8).ravel()
        height, width = plane.shape
        return types[_IMAGE](header, height, width, encoding, 0, plane.strides[0], data)

    png = cv2.imencode(".png", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))[1].ravel()
    camera = frame.camera
    P = np.column_stack([camera.K, np.zeros(3)]).ravel()
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    size = (camera.height, camera.width)
    info = (camera.model, camera.distortion, camera.K.ravel(), np.eye(3).ravel(), P, 0, 0, roi)
    messages = {
        _INFO_OUT: types[_INFO](header, *size, *info),
        _COLOUR_OUT: types[_COMPRESSED](header, "rgb8; png compressed bgr8", png),
    }
    if frame.depth is not None:
        mm = np.nan_to_num(np.rint(frame.depth * np.float64(1000.0)), nan=0.0)
        messages[_DEPTH_OUT] = image(np.where(mm < 65536, mm, 0).astype(np.uint16), "16UC1")
    if frame.label is not None:
        low, high = int(frame.label.min()), int(frame.label.max())
        if low < 0 or high > 65535:
            raise ValueError(f"label ids run from {low} to {high}; a log holds 0 to 65535")
        dtype, encoding = (np.uint8, "mono8") if high < 256 else (np.uint16, "16UC1")
        messages[_LABEL_OUT] = image(frame.label.astype(dtype), encoding)
    return messages
