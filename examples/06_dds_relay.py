"""Carry topics between ROS 2 nodes on DDS and a Farside node, for robots that do not change their middleware.

    pip install cyclonedds
    farside live topic --config launch/live.yaml        # with bus: {listen: [tcp/127.0.0.1:7448]}
    python examples/06_dds_relay.py --connect tcp/127.0.0.1:7448 --domain-id 0

The camera's topics and /tf go to the bus; the planning scene and what else is named in `--to-dds` goes to DDS. Messages
are CDR on both sides: they are checked and passed on as they are. Who joins late on DDS gets the last ten messages of
hypotheses, of all objects together. Services are not carried: DDS has no common form of
them. Ask with `farside query`, or in Python. CYCLONEDDS_URI configures DDS as for ROS 2.
"""

import threading
from functools import cache, partial
from types import TracebackType
from typing import Any, Self

import tyro

from node.ros.bus import Bus
from node.ros.frame_tree import TRANSFORMS
from node.ros.messages import HYPOTHESES, Nodetype, decode, encode, types
from node.ros.planner_messages import DETECTIONS, OCTOMAP, PLANNING_SCENE
from node.ros.rmw_zenoh import type_name
from node.ros.settings import BusConfig, TopicConfig

try:
    from cyclonedds import domain, idl, pub, sub, topic
    from cyclonedds.core import Policy, Qos
    from cyclonedds.idl import annotations
    from cyclonedds.idl import types as idl_types
    from cyclonedds.util import duration
except ImportError:
    raise SystemExit("Cyclone DDS is not installed; this example needs it: pip install cyclonedds") from None

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_TOPICS = TopicConfig()
TO_BUS = {_TOPICS.colour: IMAGE, str(_TOPICS.depth): IMAGE, _TOPICS.info: INFO} | dict.fromkeys(
    ("/tf", "/tf_static"), TRANSFORMS
)
TO_DDS = {"/farside/planning_scene": PLANNING_SCENE, "/farside/octomap": OCTOMAP, "/farside/detections": DETECTIONS}
TO_DDS |= {"/farside/occupancy": "sensor_msgs/msg/PointCloud2", "/farside/hypotheses": HYPOTHESES}
LATCHED = {"/tf_static": 100, "/farside/hypotheses": 10}  # how many messages late joiners get
PLAIN_CDR = Policy.DataRepresentation(use_cdrv0_representation=True)


@cache
def dds_type(kind: str) -> Any:
    """A type as ROS 2 has it on DDS, whose samples are their bytes."""
    fields = {name: _field(*field) for name, field in types().fielddefs[kind][1]}
    made: Any = annotations.final(idl.make_idl_struct(kind.split("/")[-1], type_name(kind), fields))

    def deserialize(data: bytes, **_: Any) -> Any:
        sample = made.__new__(made)
        sample.data = data
        return sample

    made.deserialize = deserialize
    made.serialize = lambda sample, **_: sample.data
    return made


def _field(of: Nodetype, inner: Any) -> Any:
    kinds: Any = idl_types
    if of == Nodetype.NAME:
        return dds_type(inner)
    if of == Nodetype.BASE:
        name = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(inner[0], inner[0])
        return {"string": str, "bool": bool}.get(name) or getattr(kinds, name)
    entry, count = _field(*inner[0]), inner[1]
    if of == Nodetype.ARRAY:
        return kinds.array[entry, count]
    return kinds.sequence[entry, count] if count else kinds.sequence[entry]


class Relay:
    """`with Relay(...)`: topics (name: type) are carried while it lasts."""

    def __init__(self, bus: Bus, to_bus: dict[str, str], to_dds: dict[str, str], domain_id: int) -> None:
        if both := to_bus.keys() & to_dds.keys():
            raise ValueError(f"{', '.join(sorted(both))} would go in a circle; carry a topic one way")
        self._bus, self._closed = bus, threading.Event()
        self._dds = domain.DomainParticipant(domain_id)
        self._threads = [threading.Thread(target=self._take, args=item, daemon=True) for item in to_bus.items()]
        for name, kind in to_dds.items():
            writer = pub.DataWriter(self._dds, self._topic(name, kind), self._quality(name, True))
            latched, depth = name in LATCHED, LATCHED.get(name, 10)
            bus.subscribe(name, kind, partial(self._give, writer), latched=latched, depth=depth)

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed.set()
        for thread in self._threads:
            thread.join()

    def _topic(self, name: str, kind: str) -> Any:
        return topic.Topic(self._dds, f"rt{name}", dds_type(kind))

    def _quality(self, name: str, writes: bool) -> Any:
        """Reliable as a writer; a reader takes from best-effort writers, too, but what is latched."""
        latched = name in LATCHED
        reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
        return Qos(
            PLAIN_CDR,
            reliable if writes or latched else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(LATCHED.get(name, 10)),
        )

    def _take(self, name: str, kind: str) -> None:
        """DDS to the bus, in a thread of the topic's own."""
        reader: Any = sub.DataReader(self._dds, self._topic(name, kind), self._quality(name, False))
        latched, depth = name in LATCHED, LATCHED.get(name, 10)
        publisher = self._bus.publisher(name, kind, latched=latched, depth=depth)
        while not self._closed.is_set():
            for sample in reader.take_iter(timeout=duration(milliseconds=200)):
                if isinstance(sample, dds_type(kind)):  # or a writer is gone
                    try:
                        publisher.publish(decode(sample.data, kind))
                    except ValueError as error:
                        print(f"{name}: a message is left out: {error}")
                if self._closed.is_set():
                    break

    def _give(self, writer: Any, message: Any) -> None:
        writer.write(dds_type(message.__msgtype__).deserialize(bytes(encode(message))))


def main(
    connect: str = "tcp/127.0.0.1:7448",
    domain_id: int = 0,
    to_bus: dict[str, str] | None = None,
    to_dds: dict[str, str] | None = None,
) -> None:
    """Carry topics until Ctrl-C.

    Args:
        connect: the Farside node's endpoint on the bus
        domain_id: ROS_DOMAIN_ID, on both sides
        to_bus: topics of DDS nodes and their types (/name package/msg/Type ...); default: camera and /tf
        to_dds: topics of Farside and their types; default: planning scene, octomap, detections, cloud, hypotheses
    """
    config = BusConfig(domain_id=domain_id, name="dds_relay", connect=(connect,))
    with Bus(config) as bus, Relay(bus, to_bus or TO_BUS, to_dds or TO_DDS, domain_id):
        print("carrying; Ctrl-C ends it", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            return


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:
        raise SystemExit(f"dds relay: error: {error}") from None
