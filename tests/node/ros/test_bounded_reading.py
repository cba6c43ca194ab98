"""What a message says of its own length is believed only as far as bytes came, and its parts are counted."""

import struct
import time
import tracemalloc
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from node.ros.bus import Bus
from node.ros.detections import DETECTIONS_IN
from node.ros.messages import decode, encode, make, type_hash, types
from node.ros.rmw_zenoh import attachment, key
from node.ros.settings import BusConfig
from perception.sources.bounded_reading import MOST_PARTS
from tests.node.ros.test_detections import detection, detections

PARTS_OF_ONE = 6  # a detection without results: itself, header, stamp, box, its centre and the centre's place


def sequences() -> list[tuple[str, str, Any]]:
    """Each type, its fields that are sequences, and what these are of."""
    found = []
    for kind, (_, fields) in sorted(types().fielddefs.items()):
        found += [(kind, name, inner[0]) for name, (of, inner) in fields if of == Nodetype.SEQUENCE]
    return found


def one(of: Any) -> Any:
    """A sequence of one entry."""
    node, inner = of
    if node == Nodetype.NAME:
        return [make(inner)]
    return ["x"] if inner[0] == "string" else np.ones(1, {"byte": "uint8", "octet": "uint8"}.get(inner[0], inner[0]))


def test_a_length_beyond_the_bytes_that_came_is_refused_before_anything_is_built() -> None:
    """Of every sequence of every type."""
    seen = set()
    for kind, field, of in sequences():
        none, some = bytes(encode(make(kind))), bytes(encode(make(kind, **{field: one(of)})))
        at = next(i for i, (a, b) in enumerate(zip(none, some, strict=False)) if a != b)
        assert struct.unpack_from("<I", some, at) == (1,)
        seen.add(of[1] if of[0] == Nodetype.NAME else of[1][0])
        for claimed in (len(some), 10**6, 2**31 - 1, 2**31, 2**32 - 1):
            data = some[:at] + struct.pack("<I", claimed) + some[at + 4 :]
            tracemalloc.start()
            with pytest.raises(ValueError, match=f"bytes are no {kind}"):
                decode(data, kind)
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert peak < 100_000, (kind, field, claimed)
    assert {"string", "bool", "uint8", "float64", "geometry_msgs/msg/Point", "vision_msgs/msg/Detection2D"} <= seen


def many(count: int) -> bytes:
    """A Detection2DArray of so many detections without results, made from the bytes of one."""
    empty, two, three = (bytes(encode(detections(*n * [detection(9, 9, 5, 5, None)], frame="came"))) for n in (0, 2, 3))
    more = len(three) - len(two)
    data = bytearray(two[:-more] + (count - 1) * two[-more:])
    struct.pack_into("<I", data, len(empty) - 4, count)
    return bytes(data)


def test_as_many_parts_as_are_allowed_are_read() -> None:
    assert len(decode(many(10), DETECTIONS_IN, 10 * PARTS_OF_ONE + 3).detections) == 10
    with pytest.raises(ValueError, match=r"it has more than 62 parts \(max_parts\)"):
        decode(many(10), DETECTIONS_IN, 10 * PARTS_OF_ONE + 2)
    assert encode(decode(many(3), DETECTIONS_IN)) == many(3)


def test_a_million_detections_cost_little_and_are_said() -> None:
    """Half a million, which max_message_bytes lets in, are refused by their number; a million by their size."""
    said, came = list[str](), list[Any]()
    half, million = many(500_000), many(1_000_000)
    assert len(half) < BusConfig().max_message_bytes < len(million)
    with Bus(BusConfig(), said.append) as bus:
        bus.subscribe("/found", DETECTIONS_IN, came.append)
        where = key(0, "/found", DETECTIONS_IN, type_hash(DETECTIONS_IN))
        for number, data in enumerate((half, million, many(100)), start=1):
            bus._session.put(where, data, attachment=attachment(number, 0, 16 * b"d"))
        deadline = time.monotonic() + 20.0
        while not came and time.monotonic() < deadline:
            time.sleep(0.02)
        assert bus.counts.of("/found") == {"malformed": 1, "too_large": 1, "received": 1}
    assert len(came[0].detections) == 100
    malformed, large = said
    assert malformed.startswith(
        f"/found: {len(half)} bytes are no {DETECTIONS_IN}: it has more than {MOST_PARTS} parts"
    )
    assert large.startswith(f"/found: a message of {len(million)} bytes is larger than max_message_bytes (64000000)")
