"""The messages of a recorded log, whichever library reads its format: MCAP, ROS 2 and ROS 1 recordings."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcap.records import Channel, ChunkIndex, Footer, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from foundation.one_line import one_line
from perception.sources.bounded_reading import CountingStore
from perception.sources.ros_camera import to_camera
from perception.sources.ros_images import samples, stamp_ns

INFO = "sensor_msgs/msg/CameraInfo"
_KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", INFO)
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_TRIES = 300  # messages of a topic, as many as a driver sends while it starts
_MOST_PARTS = 100
_MAGIC = b"\x89MCAP0\r\n"
_FOOTER = 37  # bytes of an MCAP from the footer's opcode to the end
_MOST_MERGED = 1 << 30  # bytes of an MCAP that merging its messages in the order of their times may hold at once


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
    try:
        if received.kind == INFO:
            return to_camera(received.message, False).width > 0
        return samples(received.message).size > 0
    except ValueError:
        return False


def open_log(path: Path) -> tuple[Read, dict[str, str], list[str]]:
    """A function that reads messages, the type of each topic that holds any, and notes."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give a recording (.mcap, .bag, ROS 2 bag folder)")
    parts, notes = [path], list[str]()
    if path.is_dir() and not (path / "metadata.yaml").exists():  # as a recorder leaves it that was killed
        parts, notes = _parts(path)

    def read(topics: set[str]) -> Iterator[Received]:
        lost = _Lost(path, notes)
        try:
            with AnyReader(parts, default_typestore=_TYPES) as reader:
                wanted = [c for c in reader.connections if c.topic in topics]
                for connection, time, raw in reader.messages(wanted) if wanted else ():
                    kind = connection.msgtype
                    with lost.counted(connection.topic, kind):
                        store = CountingStore(reader.typestore)
                        message: Any = (store.deserialize_cdr if reader.is2 else store.deserialize_ros1)(raw, kind)
                        if lacks := _fields(kind) - {name.lower() for name in message.__dataclass_fields__}:
                            raise ValueError(f"its definition of {kind} lacks {', '.join(sorted(lacks))}")
                    if not lost.this_one:
                        yield Received(connection.topic, kind, time, message)
            lost.refuse_all()
        except Exception as error:  # whichever parser meets the damage first; the caller's own errors do not pass here
            raise ValueError(f"{path} is damaged ({one_line(error)}); record it again") from None

    def mcaps() -> list[Path]:
        return [part for part in (_parts(path)[0] if path.is_dir() else [path]) if part.suffix == ".mcap"]

    try:
        with AnyReader(parts, default_typestore=_TYPES) as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount}
        if any(_merged(part) > _MOST_MERGED for part in parts if part.is_file()):
            notes.append(f"{path.name}: its times of recording do not tell an order; messages are read as they lie")
            return _open_cut(path, parts, notes)
        return read, kinds, notes
    except Exception as error:
        if cut := mcaps():
            return _open_cut(path, cut, notes)
        remedy = "give a .mcap, .bag or ROS 2 bag folder"
        if path.suffix == ".zstd":
            remedy = "unpack it with `zstd -d`"
        elif path.suffix == ".bag" or path.name.endswith(".bag.active"):
            remedy = "repair it with `rosbag reindex`"
        elif path.is_dir():
            remedy = "repair it with `ros2 bag reindex`, or remove its metadata.yaml"
        raise ValueError(f"{path} cannot be read as a recording ({one_line(error)}); {remedy}") from None


class _Lost:
    """Messages that cannot be read: they cost themselves, with a note; but not all of a message type may be lost."""

    def __init__(self, path: Path, notes: list[str]) -> None:
        self.this_one = False
        self._path, self._notes = path, notes
        self._good: set[str] = set()  # message types
        self._bad: dict[str, tuple[str, str]] = {}  # type and why, by topic

    @contextmanager
    def counted(self, topic: str, kind: str) -> Iterator[None]:
        """Read one message within."""
        self.this_one = False
        try:
            yield
            self._good.add(kind)
        except Exception as error:
            self.this_one = True
            _, why = self._bad.setdefault(topic, (kind, one_line(error)))
            note = f"{self._path.name}: messages on {topic} that cannot be read are left out ({why})"
            if note not in self._notes:
                self._notes.append(note)

    def refuse_all(self) -> None:
        """Raises ValueError for a type of which nothing could be read: its definition is damaged, or its only topic."""
        for kind, why in self._bad.values():
            if kind not in self._good:
                raise ValueError(why)


def _parts(folder: Path) -> tuple[list[Path], list[str]]:
    """The files of a recording in the order of their numbers, a_2 before a_10, and a note if some are missing.

    Raises ValueError if there is none, or there are several recordings.
    """
    found: dict[str, list[tuple[int, Path]]] = {}
    for p in folder.iterdir():
        if p.suffix in (".mcap", ".db3"):
            name, number = re.fullmatch(r"(.*?)_?(\d*)", p.stem).groups()  # type: ignore[union-attr]
            found.setdefault(name, []).append((int(number or 0), p))
    if not found:
        packed = "; unpack its parts with `zstd -d`" if any(folder.glob("*.zstd")) else ""
        raise ValueError(
            f"{folder} holds neither color.png nor a recording; give a frame folder or a recording{packed}"
        )
    if len(found) > 1:
        names = ", ".join(sorted(p.name for parts in found.values() for _, p in parts))
        raise ValueError(f"{folder} holds several recordings ({names}); give one")
    ((name, parts),) = found.items()
    parts.sort()
    numbers = {number for number, _ in parts}
    most = max(numbers) if len(parts) > 1 or max(numbers) < _MOST_PARTS else 0  # a lone number may be a date
    missing = sorted(set(range(min(most, _MOST_PARTS) + 1)) - numbers)
    told = ", ".join(f"{name}_{n}" for n in missing[:5]) + (", ..." if len(missing) > 5 else "")
    return [p for _, p in parts], [f"{folder.name}: parts are missing ({told})"] if missing else []


@cache
def _fields(kind: str) -> frozenset[str]:
    """The fields of a standard type, in small letters (ROS 1 wrote K, D, P); none of another type."""
    return frozenset(name.lower() for name, _ in _TYPES.fielddefs[kind][1]) if kind in _TYPES.fielddefs else frozenset()


def _merged(path: Path) -> int:
    """The most bytes of an MCAP's chunks whose times of recording overlap: all of a file that knows one time only.

    0 where they do not lie in the order of their beginnings: there only merging tells what follows what.
    """
    chunks: list[ChunkIndex] = []
    if path.suffix == ".mcap":
        with suppress(Exception), path.open("rb") as stream:  # whoever reads it will say what is wrong
            stream.seek(-_FOOTER, os.SEEK_END)
            footer = next(StreamReader(stream, skip_magic=True).records)
            if isinstance(footer, Footer) and footer.summary_start:
                stream.seek(footer.summary_start)
                records = StreamReader(stream, skip_magic=True, emit_chunks=True).records
                chunks = [record for record in records if isinstance(record, ChunkIndex)]
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    if any(after.message_start_time < chunk.message_start_time for chunk, after in pairwise(chunks)):
        return 0
    changes = [(chunk.message_start_time, False, chunk.uncompressed_size) for chunk in chunks]
    changes += [(chunk.message_end_time, True, -chunk.uncompressed_size) for chunk in chunks]
    most = held = 0
    for _, _, change in sorted(changes):  # at the same time one begins before another ends
        held += change
        most = max(most, held)
    return most if len(chunks) > 1 else 0


def _open_cut(whole: Path, paths: list[Path], notes: list[str]) -> tuple[Read, dict[str, str], list[str]]:
    """The same for MCAP files that the indexed reader refuses, or would hold in memory, read from the front for as long
    as they last."""

    unread: set[str] = set()  # encodings
    ends: dict[Path, str] = {}  # why a file could not be read on

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
            except Exception as error:  # the file's end, or a record that makes no sense: nothing more can be read
                ends[path] = one_line(error)

    def read(topics: set[str]) -> Iterator[Received]:
        lost = _Lost(whole, notes)
        for path in paths:
            for topic, kind, raw in records(path):
                if topic in topics:
                    with lost.counted(topic, kind):
                        message = CountingStore(_TYPES).deserialize_cdr(raw.data, kind)
                    if not lost.this_one:
                        yield Received(topic, kind, raw.log_time, message)

    kinds: dict[str, str] = {}
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
            elif path in ends:
                notes.append(f"{path.name} is damaged ({ends[path]}); {count} messages before that recovered")
    if not kinds and unread:
        raise ValueError(
            f"{paths[0]}: its messages are {', '.join(sorted(unread))}, which is not read; record the ROS 2 topics"
            " (`ros2 bag record`, cdr), or save frame folders"
        )
    if not kinds:
        raise ValueError(f"{paths[0]} holds no readable message; record it again")
    return read, kinds, notes
