"""A recording brings its own definitions: a message that holds a crowd of others by them costs itself alone."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from perception.sources.bounded_reading import MOST_PARTS, CountingStore
from perception.sources.recording import Log
from tests.perception.sources.test_recording import START, maker

INFO = "sensor_msgs/msg/CameraInfo"
CROWD: Any = ("crowd", (Nodetype.SEQUENCE, ((Nodetype.NAME, "builtin_interfaces/msg/Duration"), 0)))


def crowded(kind: str) -> Typestore:
    """Types by which a camera_info holds durations, too."""
    known = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_JAZZY).fielddefs
    store = get_typestore(Stores.EMPTY)
    constants, fields = known[INFO]
    store.register({**known, INFO: (constants, [*fields, CROWD])})
    return store


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_a_crowded_message_of_a_recording_costs_itself_alone(kind: str, tmp_path: Path) -> None:
    make, store, path = maker(kind), crowded(kind), tmp_path / f"a{'.bag' if kind == 'bag' else ''}"
    duration, image = store.types["builtin_interfaces/msg/Duration"](1, 2), np.zeros((48, 64, 3), np.uint8)
    writer: Any = Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
    write = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
    with writer:
        topics: dict[str, Any] = {}
        for count in (MOST_PARTS, 3, 3):
            stamp = START + len(topics) * 33_000_000
            for topic, name, time, plain in (make.info(stamp), make.image("/c/color/image_raw", stamp, image, "rgb8")):
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, name, typestore=store)
                fields = {field: getattr(plain, field) for field, _ in store.fielddefs[name][1] if field != "crowd"}
                fields |= {"crowd": count * [duration]} if name == INFO else {}
                writer.write(topics[topic], time, write(store.types[name](**fields), name))
    log = Log(path)
    assert len(list(log)) >= 1
    assert any(f"cannot be read are left out (it has more than {MOST_PARTS} parts)" in note for note in log.notes)


def test_what_is_counted_is_all_that_is_within() -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    pose, kind = types.types["geometry_msgs/msg/Pose"], "geometry_msgs/msg/Pose"
    point, turn = types.types["geometry_msgs/msg/Point"], types.types["geometry_msgs/msg/Quaternion"]
    message = pose(point(1, 2, 3), turn(0, 0, 0, 1))
    for write, read in (("serialize_cdr", "deserialize_cdr"), ("serialize_ros1", "deserialize_ros1")):
        data = getattr(types, write)(message, kind)
        assert getattr(CountingStore(types, 3), read)(data, kind) == message
        with pytest.raises(Exception, match="it has more than 2 parts"):
            getattr(CountingStore(types, 2), read)(data, kind)


@pytest.mark.parametrize("way", ["cdr", "ros1"])
def test_texts_are_parts(way: str) -> None:
    types, kind = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/JointState"
    header = types.types["std_msgs/msg/Header"](types.types["builtin_interfaces/msg/Time"](1, 2), "base")
    message: Any = types.types[kind](header, ["a", "bc", ""], np.arange(3.0), np.zeros(0), np.zeros(0))
    data = getattr(types, f"serialize_{way}")(message, kind)
    read = f"deserialize_{way}"
    assert getattr(CountingStore(types, 6), read)(data, kind).name == message.name  # itself, header, stamp and three
    with pytest.raises(Exception, match="it has more than 5 parts"):
        getattr(CountingStore(types, 5), read)(data, kind)


@pytest.mark.parametrize("way", ["cdr", "ros1"])
def test_texts_are_counted_before_they_are_built(way: str) -> None:
    """Eight million of them in 32 or 64 MB took seconds and most of a gigabyte."""
    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg("string[] texts", "a/msg/Texts"))
    one = b"\1\0\0\0\0\0\0\0" if way == "cdr" else bytes(4)
    data = (b"\0\1\0\0" if way == "cdr" else b"") + struct.pack("<I", 8_000_000) + 8_000_000 * one
    tracemalloc.start()
    with pytest.raises(Exception, match=f"it has more than {MOST_PARTS} parts"):
        getattr(CountingStore(types), f"deserialize_{way}")(data, "a/msg/Texts")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000 + 2 * len(data) * (way == "cdr")  # rosbags cuts the first four bytes off


@pytest.mark.parametrize("way", ["cdr", "ros1"])
def test_numbers_beside_texts_are_no_parts(way: str) -> None:
    types, kind = get_typestore(Stores.EMPTY), "a/msg/Named"
    types.register(get_types_from_msg("uint8[] before\nstring[] names\na/Inner[] inner\nuint8[] data", kind))
    types.register(get_types_from_msg("float32[] values\nstring[] names", "a/msg/Inner"))
    inner = types.types["a/msg/Inner"](np.zeros(2 * MOST_PARTS, np.float32), ["c"])
    long = np.zeros(3 * MOST_PARTS, np.uint8)
    message = types.types[kind](long, ["a", "b"], [inner, inner], long)
    data = bytes(getattr(types, f"serialize_{way}")(message, kind))
    read = f"deserialize_{way}"
    found = getattr(CountingStore(types, 7), read)(data, kind)  # itself, two texts, two within, a text in each
    assert (found.names, len(found.data), len(found.inner[1].values)) == (["a", "b"], len(long), 2 * MOST_PARTS)
    with pytest.raises(Exception, match="it has more than 6 parts"):
        getattr(CountingStore(types, 6), read)(data, kind)
    with pytest.raises(Exception, match="Invalid sequence length"):  # the bytes are missing, not a bound
        getattr(CountingStore(types), read)(data[: -len(long)], kind)


@pytest.mark.parametrize("field", ["string[50000000] x", "B[50000000] x", "C[2] x"])
def test_a_definition_with_a_long_array_of_parts_is_refused_before_code_is_written_for_it(field: str) -> None:
    types = get_typestore(Stores.EMPTY)
    fields = {"A": field, "B": "uint8 y", "C": "string[20000] z"}
    for name in "CBA":
        types.register(get_types_from_msg(fields[name], f"a/msg/{name}"))
    with pytest.raises(Exception, match=r"its definition of a/msg/[AC] gives [xz] \d+ parts"):
        CountingStore(types).deserialize_cdr(b"\0\1\0\0" + bytes(100), "a/msg/A")
