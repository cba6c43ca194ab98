"""A node announces each scene to whoever listens, and to a late joiner its hypotheses."""

import time
from collections import Counter
from typing import Any

import numpy as np
import pytest

from calibration.camera import Camera
from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, hypotheses_from
from node.ros.planner_messages import DETECTIONS, OCTOMAP, PLANNING_SCENE
from node.ros.publishers import Announcer
from node.ros.scene_messages import DiagnosticStatus
from node.ros.settings import BusConfig, PlannerConfig, TopicConfig
from node.ros.topic_source import TopicSource
from perception.sources.frame import Frame
from tests.node.shapes import body_with_handle, free_port

CAMERA = Camera(160, 120, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]), np.zeros(5))
TOPICS = {
    "~/hypotheses": HYPOTHESES,
    "~/occupancy": "sensor_msgs/msg/PointCloud2",
    "~/markers": "visualization_msgs/msg/MarkerArray",
    "~/uncertainty": "sensor_msgs/msg/Image",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "~/planning_scene": PLANNING_SCENE,
    "~/octomap": OCTOMAP,
    "~/detections": DETECTIONS,
}


def test_every_topic_carries_the_scene() -> None:
    scene = [body_with_handle(), body_with_handle(object_id=2)]
    came: dict[str, list[Any]] = {name: [] for name in TOPICS}
    with Bus(BusConfig(namespace="/robot")) as bus:
        announcer = Announcer(bus)
        assert announcer.node == "/robot/farside"
        for name, kind in TOPICS.items():
            bus.subscribe(name, kind, came[name].append)
        announcer.scene(scene, CAMERA, "tempered_smc")
        announcer.status(scene, [DiagnosticStatus("farside: camera", "ok", "", {"rate (Hz)": 10.0})])
        late: list[Any] = []
        bus.subscribe("~/hypotheses", HYPOTHESES, late.append, latched=True)
        deadline = time.monotonic() + 20.0
        while (not all(came.values()) or len(late) + len(came["~/hypotheses"]) < 4) and time.monotonic() < deadline:
            time.sleep(0.02)
        for messages in (came["~/hypotheses"], late):
            assert sorted(hypotheses_from(m).object_id for m in messages) == [1, 2]
        assert came["~/hypotheses"][0].method == "tempered_smc"
        assert len(came["/tf"][0].transforms) == 2
        names = [status.name for status in came["/diagnostics"][0].status]
        assert names == ["farside: camera", "farside: object 1", "farside: object 2", "farside: bus"]
        assert len(came["~/detections"][0].detections) == 2
        announcer.scene([], CAMERA)  # says only to MoveIt that all is gone
        deadline = time.monotonic() + 20.0
        while len(came["~/planning_scene"]) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert [[(it.id, it.operation) for it in m.world.collision_objects] for m in came["~/planning_scene"]] == [
            [("robot_farside_object_1", operation), ("robot_farside_object_2", operation)] for operation in (0, 1)
        ]
        once = {"~/occupancy", "~/markers", "~/uncertainty", "~/octomap", "~/detections"}
        assert not once - {name for name in came if len(came[name]) == 1}


def test_what_nobody_listens_to_is_not_worked_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("worked out for nobody")

    for name in (
        "occupancy_message",
        "markers_message",
        "uncertainty_message",
        "octomap_message",
        "detections_message",
    ):
        monkeypatch.setattr(f"node.ros.publishers.{name}", fail)
    monkeypatch.setattr("node.ros.publishers.SceneDifferences.message", fail)
    with Bus(BusConfig()) as bus:
        Announcer(bus).scene([body_with_handle()], CAMERA)


def test_the_planning_scene_may_go_to_moveits_own_topic() -> None:
    came: list[Any] = []
    with Bus(BusConfig()) as bus:
        announcer = Announcer(bus, PlannerConfig(scene="/planning_scene"))
        bus.subscribe("/planning_scene", PLANNING_SCENE, came.append)
        deadline = time.monotonic() + 20.0
        while not came and time.monotonic() < deadline:
            announcer.scene([body_with_handle()], CAMERA)
            time.sleep(0.02)
    assert came


def test_a_late_joiner_gets_the_last_answer_of_each_object() -> None:
    """Also of one that has had none for long; nothing superseded, nothing of an object that is gone."""
    port = free_port()
    with Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",))) as bus:
        announcer, early = Announcer(bus), list[Any]()
        bus.subscribe("~/hypotheses", HYPOTHESES, early.append, latched=True, depth=50)
        still = [body_with_handle(object_id=number, stage=7) for number in (1, 2)]
        announcer.scene([*still, body_with_handle(object_id=3)], CAMERA)  # which is taken away
        for stage in range(10):
            announcer.scene([*still, body_with_handle(object_id=4, stage=stage)], CAMERA)
        with Bus(BusConfig(name="planner", connect=(f"tcp/127.0.0.1:{port}",))) as planner:
            late: list[Any] = []
            planner.subscribe("/farside/hypotheses", HYPOTHESES, late.append, latched=True)
            deadline = time.monotonic() + 20.0
            while (len(late) < 3 or len(early) < 33) and time.monotonic() < deadline:
                time.sleep(0.02)
            time.sleep(0.5)  # for what must not come
            assert sorted((m.object_id, m.stage) for m in late) == [(1, 7), (2, 7), (4, 9)]
            late.clear()
            announcer.scene([*still, body_with_handle(object_id=5, stage=1)], CAMERA)
            while len(late) < 3 and time.monotonic() < deadline:
                time.sleep(0.02)
            assert sorted((m.object_id, m.stage) for m in late) == [(1, 7), (2, 7), (5, 1)]
        assert Counter(m.object_id for m in early) == {1: 12, 2: 12, 3: 1, 4: 10, 5: 1}
        assert sum("/MP/%/%/farside/%farside%hypotheses/" in token for token in bus.graph()) == 3


def test_a_frame_comes_back_from_the_bus() -> None:
    """What the node sends of its camera, a topic source takes for the same frame."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    depth = rng.uniform(0.2, 2.0, (120, 160)).astype(np.float32)
    depth[:5] = np.nan
    sent = Frame(rgb, depth, CAMERA, stamp_ns=1_700_000_000_123_456_789, frame_id="oak")
    topics = TopicConfig("~/color/image_raw", "~/depth/image_raw", "~/color/camera_info", end_s=20.0)
    with Bus(BusConfig()) as bus:
        source, announcer = TopicSource(bus, topics), Announcer(bus)
        announcer.frame(sent)
        came = next(iter(source))
    assert (came.stamp_ns, came.frame_id) == (sent.stamp_ns, sent.frame_id)
    np.testing.assert_array_equal(came.rgb, sent.rgb)
    np.testing.assert_array_equal(came.depth, sent.depth)
    np.testing.assert_array_equal(came.camera.K, CAMERA.K)
