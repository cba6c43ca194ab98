"""The messages of a recorded log, whichever library reads its format: MCAP, ROS 2 and ROS 1 recordings."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from foundation.one_line import one_line
from perception.sources.ros_camera import is_empty
from perception.sources.ros_images import samples, stamp_ns

_KINDS = tuple(f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_IMAGE, _COMPRESSED, INFO = _KINDS
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_TRIES = 30
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True)
class Received:
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


Read = Callable[[set[str]], Iterator[Received]]  # the messages of these topics, in order


def first_messages(read: Read, kinds: dict[str, str]) -> dict[str, Received]:
    """The first message of each topic of images and camera_info that can be used, among its first `_TRIES`."""
    wanted = {topic for topic, kind in kinds.items() if kind in _KINDS}
    firsts: dict[str, Received] = {}
    unused: dict[str, Received] = {}
    tries: Counter[str] = Counter()
    for received in read(wanted):
        topic = received.topic
        tries[topic] += topic not in firsts
        if topic not in firsts and (tries[topic] > _TRIES or _is_usable(received)):
            firsts[topic] = received
        unused.setdefault(topic, received)
        if len(firsts) == len(wanted):
            break
    return unused | firsts


def _is_usable(received: Received) -> bool:
    """Neither an empty camera_info, which a driver sends until it has read its calibration, nor a cut picture."""
    if received.kind == INFO:
        return not is_empty(received.message)
    try:
        return received.kind == _IMAGE or samples(received.message).size > 0
    except ValueError:
        return False


def open_log(path: Path) -> tuple[Read, dict[str, str], list[str]]:
    """A function that reads messages, the type of each topic that holds any, and notes."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give a recording (.mcap, .bag, ROS 2 bag folder)")
    if path.is_dir() and not (path / "metadata.yaml").exists():  # as a recorder leaves it that was killed
        parts = _parts(path)
        if not parts:
            raise ValueError(f"{path} holds neither color.png nor a recording; give a frame folder or a recording")
    else:
        parts = [path]

    def read(topics: set[str]) -> Iterator[Received]:
        try:
            with AnyReader(parts, default_typestore=_TYPES) as reader:
                wanted = [c for c in reader.connections if c.topic in topics]
                for connection, time, raw in reader.messages(wanted) if wanted else ():
                    kind = connection.msgtype
                    message: Any = reader.deserialize(raw, kind)
                    if lacks := _fields(kind) - {name.lower() for name in message.__dataclass_fields__}:
                        raise ValueError(f"its definition of {kind} lacks {', '.join(sorted(lacks))}")
                    yield Received(connection.topic, kind, time, message)
        except Exception as error:  # whichever parser meets the damage first; the caller's own errors do not pass here
            raise ValueError(f"{path} is damaged ({one_line(error)}); record it again") from None

    try:
        with AnyReader(parts, default_typestore=_TYPES) as reader:
            return read, {c.topic: c.msgtype for c in reader.connections if c.msgcount}, []
    except Exception as error:
        mcaps = [part for part in (_parts(path) if path.is_dir() else [path]) if part.suffix == ".mcap"]
        if mcaps:
            return _open_cut(mcaps)
        remedy = (
            "repair it with `rosbag reindex`" if path.suffix == ".bag" else "give a .mcap, .bag or ROS 2 bag folder"
        )
        raise ValueError(f"{path} cannot be read as a recording ({one_line(error)}); {remedy}") from None


def _parts(folder: Path) -> list[Path]:
    """The files of a recording in the order of their numbers: a_2 comes before a_10."""
    found = (p for p in folder.iterdir() if p.suffix in (".mcap", ".db3"))
    return sorted(found, key=lambda p: [(int(n), "") if n.isdigit() else (-1, n) for n in re.split(r"(\d+)", p.name)])


@cache
def _fields(kind: str) -> frozenset[str]:
    """The fields of a standard type, in small letters (ROS 1 wrote K, D, P); none of another type."""
    return frozenset(name.lower() for name, _ in _TYPES.fielddefs[kind][1]) if kind in _TYPES.fielddefs else frozenset()


def _open_cut(paths: list[Path]) -> tuple[Read, dict[str, str], list[str]]:
    """The same for MCAP files that the indexed reader refuses, read from the front for as long as they last."""

    unread: set[str] = set()  # encodings

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
                    elif isinstance(record, Channel):
                        unread.add(record.message_encoding or "unnamed")
                    elif isinstance(record, Message) and record.channel_id in channels:
                        yield *channels[record.channel_id], record
            except Exception:  # the file's end, or a record that makes no sense: nothing more is there to read
                return

    def read(topics: set[str]) -> Iterator[Received]:
        for path in paths:
            for topic, kind, message in records(path):
                if topic in topics:
                    yield Received(topic, kind, message.log_time, _TYPES.deserialize_cdr(message.data, kind))

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
    if not kinds and unread:
        raise ValueError(
            f"{paths[0]}: its messages are {', '.join(sorted(unread))}, which is not read; record the ROS 2 topics"
            " (`ros2 bag record`, cdr), or save frame folders"
        )
    if not kinds:
        raise ValueError(f"{paths[0]} holds no readable message; record it again")
    return read, kinds, notes
