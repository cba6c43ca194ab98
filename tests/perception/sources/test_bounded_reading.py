"""A recording brings its own definitions: a message that holds a crowd of others by them costs itself alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
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
