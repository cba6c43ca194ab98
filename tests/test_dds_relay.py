"""`examples/06_dds_relay.py`: what Cyclone DDS sends as ROS 2 does comes onto the bus, and the other way."""

import hashlib
import runpy
import subprocess
import sys
import time
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest

from calibration.camera import Camera
from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, encode, frame_messages, hypotheses_message
from node.ros.planner_messages import SceneDifferences, detections_message, octomap_message
from node.ros.scene_messages import occupancy_message, transforms_message
from node.ros.settings import BusConfig, PlannerConfig
from perception.sources.frame import Frame
from tests.conftest import ROOT
from tests.node.shapes import body_with_handle, free_port

pytest.importorskip("cyclonedds")

DOMAIN, RELAY = 77, ROOT / "examples" / "06_dds_relay.py"
# On this machine alone, without multicast.
ONLY_HERE = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces></General>'
    '<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
# A camera driver on DDS, by a definition of its own, that wants hypotheses: `python -c DRIVER relay.py DOMAIN`.
DRIVER = """
import hashlib, runpy, sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

@final
@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32

@final
@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str

@final
@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]

dds_type = runpy.run_path(sys.argv[1])["dds_type"]
participant, plain = DomainParticipant(int(sys.argv[2])), Policy.DataRepresentation(use_cdrv0_representation=True)
writer = DataWriter(participant, Topic(participant, "rt/image", Image), Qos(plain, Policy.Reliability.BestEffort))
wanted = Topic(participant, "rt/farside/hypotheses", dds_type("farside_msgs/msg/ShapeHypotheses"))
late = Qos(plain, Policy.Reliability.Reliable(duration(seconds=1)), Policy.Durability.TransientLocal)
reader = DataReader(participant, wanted, late)
pixels, deadline, got = [n % 251 for n in range(240 * 320 * 3)], time.monotonic() + 60.0, False
while time.monotonic() < deadline:
    writer.write(Image(Header(Time(7, 9), "eye"), 240, 320, "rgb8", 0, 960, pixels))
    for sample in reader.take(5):
        if not got:
            print(hashlib.sha256(sample.data).hexdigest(), flush=True)
        got = True
    time.sleep(0.2)
"""


@pytest.fixture(scope="module")
def relay() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CYCLONEDDS_URI", ONLY_HERE)
        return runpy.run_path(str(RELAY))


def test_cyclone_reads_and_writes_the_same_bytes(relay: dict[str, Any]) -> None:
    """Of all that is carried, by its own reading of CDR and the types that it is given."""
    h = body_with_handle(kinds={"box": 0.3, "vessel": 0.7})
    frame = Frame(
        np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), Camera(6, 4, np.diag([9.0, 9.0, 1.0]), np.zeros(5))
    )
    sent = [*frame_messages(frame).values(), hypotheses_message(h), transforms_message([h], "/farside")]
    sent += [SceneDifferences("/farside", PlannerConfig(mesh_grid=8, scene_octomap=True)).message([h])]
    sent += [octomap_message([h], "/farside", 0.02), detections_message([h]), occupancy_message([h])]
    assert {message.__msgtype__ for message in sent} == {*relay["TO_BUS"].values(), *relay["TO_DDS"].values()}
    for message in sent:
        data, idl = bytes(encode(message)), relay["dds_type"](message.__msgtype__).__idl__
        idl.populate()
        again = idl.serialize(idl.deserialize(data), use_version_2=False)
        assert again[:2] == b"\x00\x01" and again[4:] == data[4:], message.__msgtype__


def test_topics_are_carried_one_way_alone(relay: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="/tf would go in a circle"):
        relay["Relay"](None, {"/tf": HYPOTHESES}, {"/tf": HYPOTHESES}, DOMAIN)


@pytest.mark.slow
def test_a_driver_on_dds_is_heard_and_hears(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images of a best-effort writer come onto the bus; a late reader gets the last hypotheses."""
    monkeypatch.setenv("CYCLONEDDS_URI", ONLY_HERE)
    port, came = free_port(), list[Any]()
    relay = [sys.executable, str(RELAY), "--connect", f"tcp/127.0.0.1:{port}", "--domain-id", str(DOMAIN)]
    relay += ["--to-bus", "/image", "sensor_msgs/msg/Image", "--to-dds", "/farside/hypotheses", HYPOTHESES]
    driver = [sys.executable, "-c", DRIVER, str(RELAY), str(DOMAIN)]
    message = hypotheses_message(body_with_handle())
    with Bus(BusConfig(domain_id=DOMAIN, listen=(f"tcp/127.0.0.1:{port}",))) as bus:
        bus.publisher("~/hypotheses", HYPOTHESES, latched=True).publish(message)
        bus.subscribe("/image", "sensor_msgs/msg/Image", came.append)
        with (
            subprocess.Popen(relay, cwd=ROOT, stdout=PIPE, text=True) as carrying,
            subprocess.Popen(driver, cwd=ROOT, stdout=PIPE, text=True) as seen,
        ):
            try:
                assert seen.stdout is not None
                assert seen.stdout.readline().strip() == hashlib.sha256(bytes(encode(message))).hexdigest()
                deadline = time.monotonic() + 60.0
                while not came and time.monotonic() < deadline:
                    time.sleep(0.05)
            finally:
                carrying.kill()
                seen.kill()
    assert (came[0].header.frame_id, came[0].header.stamp.sec, came[0].header.stamp.nanosec) == ("eye", 7, 9)
    np.testing.assert_array_equal(came[0].data, np.arange(240 * 320 * 3) % 251)
