"""An independent implementation of ROS 2 on Zenoh reads every topic and calls every service of this node.

It is the crate hiroz 0.2.1: keys, tokens, type hashes, quality of service and CDR are its own. By hand: build it first,
which takes some minutes, then run this.

    cargo build --locked --manifest-path tests/peer/Cargo.toml
    .venv/bin/pytest -m slow tests/node/ros/test_independent_peer.py
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE
from typing import Any

import jax
import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.detections import DETECTIONS_IN
from node.ros.frame_tree import TRANSFORMS, FrameTree
from node.ros.messages import HYPOTHESES, NEXT_VIEW, QUERY_REGION, frame_messages
from node.ros.planner_messages import DETECTIONS, ESDF, OCTOMAP, PLANNING_SCENE
from node.ros.publishers import Announcer
from node.ros.services import POINTS, Answers
from node.ros.settings import BusConfig, PlannerConfig, TopicConfig
from node.ros.type_descriptions import GET_TYPE_DESCRIPTION
from perception.observation.segmentation import segment
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.conftest import ROOT
from tests.node.commands.test_replay_whole import FEW
from tests.node.independent_peer import BINARY, BUILD, IndependentPeer, as_json
from tests.node.ros.test_detections import detection
from tests.node.shapes import RIGHT, STAMP_NS, body_with_handle, free_port
from tests.perception.cylinders import CAMERA

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not BINARY.is_file(), reason=f"{BINARY} is not built: {BUILD}"),
]

TOPICS = {
    "/farside/occupancy": "sensor_msgs/msg/PointCloud2",
    "/farside/markers": "visualization_msgs/msg/MarkerArray",
    "/farside/uncertainty": "sensor_msgs/msg/Image",
    "/farside/planning_scene": PLANNING_SCENE,
    "/farside/octomap": OCTOMAP,
    "/farside/detections": DETECTIONS,
    "/farside/color/image_raw": "sensor_msgs/msg/Image",
    "/farside/color/camera_info": "sensor_msgs/msg/CameraInfo",
    "/farside/depth/image_raw": "sensor_msgs/msg/Image",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/tf": "tf2_msgs/msg/TFMessage",
}
PARAMETER_SERVICES = (
    "GetParameters",
    "GetParameterTypes",
    "ListParameters",
    "DescribeParameters",
    "SetParameters",
    "SetParametersAtomically",
)
SERVICES = {
    "/farside/query_region": QUERY_REGION,
    "/farside/next_view": NEXT_VIEW,
    "/farside/get_esdf_and_gradient": ESDF,
    "/farside/get_type_description": GET_TYPE_DESCRIPTION,
    "/farside/get_parameters": "rcl_interfaces/srv/GetParameters",
    "/farside/get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "/farside/list_parameters": "rcl_interfaces/srv/ListParameters",
    "/farside/describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "/farside/set_parameters": "rcl_interfaces/srv/SetParameters",
    "/farside/set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}


def answer(peer: IndependentPeer, service: str, /, **request: Any) -> dict[str, Any]:
    """The response, of which hiroz must write the same bytes as came."""
    line = peer.call(service, SERVICES[service], **request)
    assert line["what"] == "answer" and line["same"], line
    return line["response"]


def newest(peer: IndependentPeer, topic: str, seconds: float = 60.0) -> dict[str, Any]:
    """The newest message of a topic, of which hiroz must write the same bytes as came."""
    peer.wait(lambda line: line["what"] == "heard" and line["name"] == topic, seconds)
    lines = peer.heard(topic)
    assert all(line["same"] for line in lines), topic
    return lines[-1]["message"]


@pytest.fixture
def peer_and_scene(tmp_path: Path) -> Iterator[tuple[IndependentPeer, Announcer]]:
    """The peer beside a node that knows one body with a handle at one side or the other."""
    port, planner = free_port(), PlannerConfig(risk=0.5)
    with Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",)), print) as bus:
        answers, announcer = Answers(planner=planner), Announcer(bus, planner)
        answers.update([body_with_handle()])
        answers.serve(bus)
        with IndependentPeer(f"tcp/127.0.0.1:{port}", tmp_path) as peer:
            until_it_sees(peer, {"/farside/query_region", "/farside/get_esdf_and_gradient"})
            yield peer, announcer


def until_it_sees(peer: IndependentPeer, names: set[str]) -> list[dict[str, Any]]:
    deadline, found = time.monotonic() + 60.0, peer.graph("/farside")
    while not names <= {it["name"] for it in found}:
        assert time.monotonic() < deadline, found
        time.sleep(0.2)
        found = peer.graph("/farside")
    return found


def test_what_it_reads_is_what_the_scene_is(peer_and_scene: tuple[IndependentPeer, Announcer]) -> None:
    """Numbers of a known scene, through an implementation of its own."""
    peer, announcer = peer_and_scene
    h = body_with_handle()
    for topic, kind in TOPICS.items():
        peer.tell(listen=topic, type=kind)
    deadline = time.monotonic() + 60.0
    while not peer.heard("/farside/detections") and time.monotonic() < deadline:
        announcer.scene([h], CAMERA)
        time.sleep(0.3)
    (it,) = newest(peer, "/farside/planning_scene")["world"]["collision_objects"]
    assert (it["id"], it["operation"], it["header"]["frame_id"]) == ("farside_object_1", 0, h.frame_id)
    assert it["header"]["stamp"] == {"sec": STAMP_NS // 10**9, "nanosec": STAMP_NS % 10**9}
    assert it["pose"]["position"]["z"] == 0.5 and it["meshes"][0]["triangles"]["count"] > 100
    (found,) = newest(peer, "/farside/detections")["detections"]
    assert found["id"] == "1" and 0.1 < found["bbox"]["size"]["z"] < 0.2
    octomap = newest(peer, "/farside/octomap")
    assert (octomap["id"], octomap["binary"]) == ("OcTree", False) and octomap["resolution"] == pytest.approx(0.01)
    cloud = newest(peer, "/farside/occupancy")
    assert [field["name"] for field in cloud["fields"]][:4] == ["x", "y", "z", "p_occupied"]
    assert cloud["data"]["count"] == cloud["width"] * cloud["point_step"]
    (moved,) = newest(peer, "/tf")["transforms"]
    assert moved["child_frame_id"] == "farside/object_1" and moved["transform"]["translation"]["x"] == 0.02
    peer.tell(listen="/farside/hypotheses", type=HYPOTHESES)  # too late, but it is latched
    shapes = newest(peer, "/farside/hypotheses")
    assert shapes["weights"] == [0.3, 0.7] and shapes["opacity"]["count"] == 2 * 32**3 and shapes["seed"] == 7

    low, high = (dict(zip("xyz", corner, strict=True)) for corner in RIGHT)
    asked = {"header": {"frame_id": "object"}}
    region = answer(peer, "/farside/query_region", **asked, box_low=low, box_high=high)
    assert region["success"] and region["p_free"] == pytest.approx(0.3) and region["blocked_hypotheses"] == [1]
    points = answer(peer, "/farside/query_region", **asked, kind=POINTS, points=[0.07, 0.0, 0.0, -0.07, 0.0, 0.0])
    np.testing.assert_allclose(points["p_occupied"], [0.3, 0.7])
    refused = answer(peer, "/farside/query_region", header={"frame_id": "moon"})
    assert not refused["success"] and refused["message"].startswith("frame_id is 'moon'")
    peer.tell(call="/farside/query_region", type=QUERY_REGION, raw=64 * "ff")  # no request at all
    garbled = peer.wait(lambda line: line["what"] == "answer" and "bytes are no" in line["response"].get("message", ""))
    assert garbled["same"] and not garbled["response"]["success"]
    distances = answer(peer, "/farside/get_esdf_and_gradient", frame_id="object", update_esdf=True)
    sizes = [dim["size"] for dim in distances["esdf_and_gradients"]["layout"]["dim"]]
    assert distances["success"] and distances["voxel_size_m"] == pytest.approx(0.01)
    assert distances["esdf_and_gradients"]["data"]["count"] == np.prod(sizes)
    assert -0.04 <= distances["esdf_and_gradients"]["data"]["least"] < -0.02  # the body is 8 cm wide
    aabb = {
        "use_aabb": True,
        "aabb_min_m": {"x": -0.02, "y": 0.0, "z": 0.0},
        "aabb_size_m": {"x": 0.04, "y": 0.02, "z": 0.02},
    }
    part = answer(peer, "/farside/get_esdf_and_gradient", frame_id="object", **aabb)
    assert [dim["size"] for dim in part["esdf_and_gradients"]["layout"]["dim"]] == [5, 3, 3]  # those that it meets
    assert part["esdf_and_gradients"]["data"]["largest"] < 0.0  # inside the body


def test_who_listens_late_gets_what_it_latched(tmp_path: Path) -> None:
    """As /tf_static of a robot that was up before."""
    place = {"translation": {"x": 1.5}, "rotation": {"w": 1.0}}
    moved = {"header": {"frame_id": "base_link"}, "child_frame_id": "camera", "transform": place}
    static = {"topic": "/tf_static", "type": TRANSFORMS, "message": {"transforms": [moved]}, "latched": True}
    port = free_port()
    with Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",)), print) as bus:
        with IndependentPeer(f"tcp/127.0.0.1:{port}", tmp_path) as peer:
            peer.tell(publish=[static], period_s=3600.0)
            peer.graph("/farside")  # when it answers, that is done
            tree, deadline = FrameTree(bus), time.monotonic() + 60.0
            while not tree.knows("camera"):
                assert time.monotonic() < deadline
                time.sleep(0.05)
    assert tree.T("base_link", "camera", STAMP_NS)[0, 3] == 1.5
    assert bus.counts.of("/tf_static") == {"received": 1}


def test_a_node_of_its_own_is_camera_detector_and_planner(tmp_path: Path) -> None:
    """`farside live` infers from what hiroz publishes; hiroz hears every topic and calls every service."""
    frame = next(iter(Log(SHIPPED_LOG)))
    things = [np.nonzero(thing.mask) for thing in segment(frame)]
    boxes = [detection(float(u.mean()), float(v.mean()), np.ptp(u) + 1.0, np.ptp(v) + 1.0) for v, u in things]
    messages = {name: as_json(message) for name, message in frame_messages(frame).items()}
    topics = TopicConfig(detections="/found")
    header = {"frame_id": frame.frame_id}
    published = [
        {"topic": topics.info, "type": "sensor_msgs/msg/CameraInfo", "message": messages["color/camera_info"]},
        {"topic": topics.depth, "type": "sensor_msgs/msg/Image", "message": messages["depth/image_raw"]},
        {"topic": topics.colour, "type": "sensor_msgs/msg/Image", "message": messages["color/image_raw"]},
        {
            "topic": topics.detections,
            "type": DETECTIONS_IN,
            "message": {"header": header, "detections": [as_json(it) for it in boxes]},
        },
    ]
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    port, config = free_port(), tmp_path / "live.yaml"
    topic = "topic: {detections: /found}"
    config.write_text(f"bus: {{listen: [tcp/127.0.0.1:{port}]}}\n{topic}\ntrack: {{moved_below: 0.0}}\n{FEW}")
    options = ["--config", str(config), "--prior", str(tmp_path / "tiny.safetensors")]
    live, errors = [sys.executable, "-m", "node", "live", "topic", *options], tmp_path / "errors"
    with errors.open("w") as stderr, subprocess.Popen(live, cwd=ROOT, stdout=PIPE, stderr=stderr, text=True) as node:
        try:
            assert node.stdout is not None and "is up" in node.stdout.readline(), errors.read_text()
            with IndependentPeer(f"tcp/127.0.0.1:{port}", tmp_path / "definitions") as peer:
                found = until_it_sees(peer, {*TOPICS, *SERVICES})
                for name, kind in (TOPICS | SERVICES).items():
                    stated = {(it["type"], it["hash"], it["computed"]) for it in found if it["name"] == name}
                    ((stated_kind, stated_hash, computed),) = stated
                    assert stated_kind == kind and stated_hash == computed, name
                quality = {(it["durability"], it["reliability"]) for it in found if it["name"] in TOPICS | SERVICES}
                assert quality == {("Volatile", "Reliable")}
                for name, kind in TOPICS.items():
                    peer.tell(listen=name, type=kind)
                peer.tell(publish=published, period_s=1.0)
                _reads_everything(peer, frame.frame_id)
                _calls_everything(peer)
        finally:
            node.kill()
    assert "moved" not in errors.read_text()


def _reads_everything(peer: IndependentPeer, frame_id: str) -> None:
    told = {name: newest(peer, name, 400.0) for name in TOPICS}
    (latched,) = {it["durability"] for it in until_it_sees(peer, {"/farside/hypotheses"}) if it["type"] == HYPOTHESES}
    assert latched == "TransientLocal"
    peer.tell(listen="/farside/hypotheses", type=HYPOTHESES)
    shapes = newest(peer, "/farside/hypotheses")
    assert sum(shapes["weights"]) == pytest.approx(1.0) and shapes["header"]["frame_id"] == frame_id
    assert told["/farside/color/image_raw"]["encoding"] == "rgb8"
    info, depth = told["/farside/color/camera_info"], told["/farside/depth/image_raw"]
    assert info["k"][0] > 100.0 and info["r"] == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert (depth["height"], depth["width"]) == (info["height"], info["width"])
    scene = told["/farside/planning_scene"]
    assert scene["is_diff"] and scene["robot_state"]["is_diff"]
    assert {it["header"]["frame_id"] for it in scene["world"]["collision_objects"]} <= {frame_id}
    assert {it["id"] for it in told["/farside/detections"]["detections"]} <= {"1", "2"}
    assert told["/farside/octomap"]["data"]["count"] > 0
    assert {"farside: camera", "farside: bus"} <= {status["name"] for status in told["/diagnostics"]["status"]}


def _calls_everything(peer: IndependentPeer) -> None:
    asked = {"header": {"frame_id": "camera"}}
    deadline = time.monotonic() + 200.0
    region: dict[str, Any] = {"objects": 0}
    while region["objects"] != 2:  # the second one is inferred after the first
        assert time.monotonic() < deadline, region
        region = answer(peer, "/farside/query_region", **asked, kind=POINTS, points=[0.0, 0.0, 0.4])
    assert region["success"] and 0.0 <= region["age"] < 100.0
    # hiroz waits for an answer for a while only (`PATIENCE`), and the node may compile for longer before the first one
    lines = (peer.call("/farside/next_view", NEXT_VIEW, **asked, count=3) for _ in range(10))
    views = next(line["response"] for line in lines if line["what"] == "answer")
    assert views["success"] and len(views["poses"]) == 3
    assert answer(peer, "/farside/get_esdf_and_gradient", frame_id="camera")["success"]
    described = answer(peer, "/farside/get_type_description", type_name=PLANNING_SCENE, include_type_sources=True)
    assert described["successful"]
    assert described["type_description"]["type_description"]["type_name"] == PLANNING_SCENE
    for topic, kind in (TOPICS | {"/farside/hypotheses": HYPOTHESES}).items():
        if topic.startswith("/farside") and kind != PLANNING_SCENE:  # whose `byte` hiroz cannot take from a description
            after = len(peer.lines)
            peer.tell(discover=topic)
            line = peer.wait(lambda line: line["what"] in ("discovered", "error"), 100.0, after)
            assert line["what"] == "discovered" and line["type"] == kind, line
    names = answer(peer, "/farside/list_parameters")["result"]["names"]
    names = names["first"] if isinstance(names, dict) else names
    assert "budget" in names
    values = answer(peer, "/farside/get_parameters", names=["budget", "bus.domain_id", "nothing"])["values"]
    assert [value["type"] for value in values] == [3, 2, 0] and values[0]["double_value"] > 0
    assert answer(peer, "/farside/get_parameter_types", names=["budget", "nothing"])["types"] == [3, 0]
    (budget,) = answer(peer, "/farside/describe_parameters", names=["budget"])["descriptors"]
    assert (budget["name"], budget["type"], budget["read_only"]) == ("budget", 3, True)
    change = [{"name": "budget", "value": {"type": 3, "double_value": 1.0}}]
    (one,) = answer(peer, "/farside/set_parameters", parameters=change)["results"]
    together = answer(peer, "/farside/set_parameters_atomically", parameters=change)["result"]
    assert one == together and not one["successful"] and "read when it starts" in one["reason"]
