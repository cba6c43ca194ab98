"""Services answer with what the functions behind them say, of one scene at a time, and refuse in one line."""

import hashlib
import json
import sys
import threading
import time
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.messages import (
    FOLDER,
    HYPOTHESES,
    NEXT_VIEW,
    QUERY_REGION,
    header,
    make,
    matrix,
    pose,
    type_hash,
)
from node.ros.parameters import flat, serve_parameters
from node.ros.services import BOX, POINTS, SWEPT, Answers
from node.ros.settings import BusConfig
from node.ros.type_descriptions import GET_TYPE_DESCRIPTION, description, serve_type_descriptions
from perception.answers.query import query
from perception.answers.regions import Box, Points
from probnerf.geometry import look_at
from tests.node.shapes import BODY, LEFT, RIGHT, STAMP_NS, body_with_handle


def point(p: tuple[float, float, float]) -> Any:
    return make("geometry_msgs/msg/Point", **dict(zip("xyz", p, strict=True)))


def ask(frame: str = "object", kind: int = BOX, **fields) -> Any:
    return make(f"{QUERY_REGION}_Request", header=header(0, frame), kind=kind, **fields)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> dict[str, object]:
    return {"box_low": point(low), "box_high": point(high)}


def oriented(T: np.ndarray, size: tuple[float, float, float]) -> Any:
    edges = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", size, strict=True)))
    return make("farside_msgs/msg/OrientedBox", pose=pose(T), size=edges)


@pytest.fixture
def answers() -> Answers:
    answers = Answers()
    answers.update([body_with_handle(T_world_camera=np.eye(4))])
    return answers


def test_the_answer_is_that_of_query(answers: Answers) -> None:
    scene = answers.scene.objects
    got, expected = answers.query_region(ask(**box(*RIGHT))), query(scene, Box(*RIGHT), "object")
    assert got.success and got.p_free == expected.p_free == pytest.approx(0.3)
    assert got.volume_q95 == expected.volume_m3["q95"] and got.entropy_nats == expected.entropy_nats
    assert got.unseen_fraction == expected.unseen_fraction and got.p_free_se == expected.p_free_se
    assert got.p_free_few == expected.p_free_few and expected.blocked_by == {1: got.blocked_hypotheses.tolist()}
    assert got.blocked_objects.tolist() == [1] * len(expected.blocked_by[1])
    assert (got.objects, got.stage, got.out_of_model) == (1, 4, False)
    assert got.stamp.sec == STAMP_NS // 10**9 and got.age == pytest.approx(time.time() - STAMP_NS / 1e9, abs=60)
    points = np.array([[0.07, 0.0, 0.0], [-0.07, 0.0, 0.0]])
    got = answers.query_region(ask(kind=POINTS, points=points.ravel()))
    np.testing.assert_array_equal(got.p_occupied, query(scene, Points(points), "object").p_occupied)


def test_swept_boxes_answer_as_a_box(answers: Answers) -> None:
    """Turned boxes that fill a box together, one of them twice, answer as the box does."""
    low, high = np.array(RIGHT)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    boxes = []
    for x0, x1 in ((low[0], -0.06), (-0.06, high[0]), (low[0], -0.06)):
        T = quarter.copy()
        T[:3, 3] = [0.5 * (x0 + x1), *(0.5 * (low + high)[1:])]
        boxes.append(oriented(T, (high[1] - low[1], x1 - x0, high[2] - low[2])))
    swept, whole = answers.query_region(ask(kind=SWEPT, boxes=boxes)), answers.query_region(ask(**box(*RIGHT)))
    for name in ("p_free", "p_free_se", "volume_q05", "volume_q50", "volume_q95", "entropy_nats"):
        assert getattr(swept, name) == pytest.approx(getattr(whole, name)), name
    assert swept.unseen_fraction == pytest.approx(whole.unseen_fraction, abs=0.02)
    assert swept.outside_fraction == whole.outside_fraction == 0.0


def test_frames_go_by_their_names_too(answers: Answers) -> None:
    h = answers.scene.objects[0]
    boxes = [oriented(h.object_frame.T_camera_object, (0.02, 0.02, 0.02))]
    free = {
        frame: answers.query_region(ask(frame, SWEPT, boxes=boxes)).p_free for frame in ("camera", h.frame_id, "world")
    }
    assert set(free.values()) == {0.0}  # in the middle of the body
    assert answers.query_region(ask("farside/object_1", **box(*LEFT))).p_free == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("request_", "complaint"),
    [
        (ask("map", **box(*BODY)), "frame_id is 'map'; give one of object, camera, world"),
        (ask(**box(BODY[1], BODY[0])), "the box is empty"),
        (ask(kind=7), "kind is 7"),
        (ask(kind=POINTS, points=np.ones(4)), "points has 4 numbers"),
        (ask(kind=POINTS), "N >= 1"),
        (ask(kind=SWEPT), "there are 0 boxes"),
        (ask(kind=SWEPT, boxes=[oriented(np.eye(4), (0.1, 0.0, 0.1))]), "an edge is not longer than 0 m"),
        (ask(object_id=9), "no object 9; its objects: 1"),
    ],
)
def test_what_cannot_be_asked_is_refused(answers: Answers, request_: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        answers.query_region(request_)


def test_one_object_of_a_scene_may_be_asked() -> None:
    answers = Answers()
    with pytest.raises(ValueError, match="there are no hypotheses"):
        answers.query_region(ask())
    answers.update([body_with_handle(), body_with_handle((0.9, 0.1), object_id=2, stage=2)])
    assert answers.query_region(ask(object_id=2, **box(*RIGHT))).p_free == pytest.approx(0.9)
    with pytest.raises(ValueError, match="ambiguous"):
        answers.query_region(ask(**box(*RIGHT)))
    both = answers.query_region(ask("camera", **box((-1, -1, 0), (1, 1, 1))))
    assert both.objects == 2
    assert list(zip(both.blocked_objects, both.blocked_hypotheses, strict=True)) == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert min(h.stage for h in answers.scene) == 2
    answers.update([])
    with pytest.raises(ValueError, match="there are no hypotheses"):
        _ = answers.scene


def test_views_are_ranked_in_the_frame_of_the_question(answers: Answers, monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass
    class Ranked:
        T_object_camera: np.ndarray
        gain_nats: np.ndarray

    asked = []

    def rank_views(scene: Any, cameras: np.ndarray | None, count: int) -> Ranked:
        asked.append((cameras, count))
        given = np.stack([np.eye(4)] * 7) if cameras is None else cameras
        return Ranked(given[::-1][:count], np.arange(count)[::-1] * 0.5)

    module = ModuleType("perception.answers.next_view")
    module.__dict__["rank_views"] = rank_views
    monkeypatch.setitem(sys.modules, "perception.answers.next_view", module)
    T = answers.scene.objects[0].object_frame.T_camera_object
    places = [np.eye(4), T]
    request = make(f"{NEXT_VIEW}_Request", header=header(0, "camera"), candidates=[pose(p) for p in places])
    response = answers.next_view(request)
    np.testing.assert_allclose(asked[0][0], [np.linalg.inv(T), np.eye(4)], atol=1e-12)
    np.testing.assert_allclose([matrix(p) for p in response.poses], places[::-1], atol=1e-12)
    np.testing.assert_array_equal(response.gain_nats, [0.5, 0.0])
    assert len(answers.next_view(make(f"{NEXT_VIEW}_Request", header=header(0, "object"))).poses) == 5
    with pytest.raises(ValueError, match="101 views are too many"):
        answers.next_view(make(f"{NEXT_VIEW}_Request", header=header(0, "object"), count=101))


def two_objects() -> Answers:
    """Objects 1 and 2, which stand 30 cm apart."""
    first, second = body_with_handle(T_world_camera=np.eye(4)), body_with_handle(object_id=2, T_world_camera=np.eye(4))
    T = second.object_frame.T_camera_object.copy()
    T[0, 3] += 0.3
    answers = Answers()
    answers.update([first, replace(second, object_frame=replace(second.object_frame, T_camera_object=T), stage=2)])
    return answers


def views(frame: str, object_id: int = 0, *places: np.ndarray) -> Any:
    candidates = [pose(T) for T in places]
    return make(f"{NEXT_VIEW}_Request", header=header(0, frame), object_id=object_id, candidates=candidates)


@pytest.mark.parametrize("frame", ["object", "farside/object_1", "farside/object_2"])
def test_an_objects_frame_is_ambiguous_where_several_are_asked(frame: str) -> None:
    answers = two_objects()
    for service, request in ((answers.next_view, views(frame)), (answers.query_region, ask(frame, **box(*RIGHT)))):
        with pytest.raises(ValueError, match=f"'{frame}' is ambiguous with 2 objects; give the object_id of one"):
            service(request)


@pytest.mark.parametrize("frame", ["object", "farside/object_2"])
def test_the_second_object_is_asked_in_its_own_frame(frame: str) -> None:
    """Views and regions of object 2's frame are those of the camera's, turned."""
    answers = two_objects()
    T = answers.scene.objects[1].object_frame.T_camera_object
    places = [look_at(np.array(at), np.zeros(3)).astype(np.float64) for at in ((0.5, 0, 0.2), (0.0, 0.5, 0.1))]
    own, camera = (
        answers.next_view(r) for r in (views(frame, 2, *places), views("camera", 2, *(T @ p for p in places)))
    )
    np.testing.assert_allclose([T @ matrix(p) for p in own.poses], [matrix(p) for p in camera.poses], atol=1e-6)
    np.testing.assert_allclose(own.gain_nats, camera.gain_nats, atol=1e-6)
    assert own.gain_nats[0] > 0
    assert {tuple(np.round(matrix(p)[:3, 3], 6)) for p in own.poses} == {(0.5, 0, 0.2), (0.0, 0.5, 0.1)}
    ring = answers.next_view(views(frame, 2))
    distances = [np.linalg.norm(matrix(p)[:3, 3]) for p in ring.poses]
    np.testing.assert_allclose(distances, np.linalg.norm(T[:3, 3]), rtol=1e-6)  # about object 2
    inside = [oriented(T, (0.02, 0.02, 0.02))]
    assert answers.query_region(ask("camera", SWEPT, object_id=2, boxes=inside)).p_free == 0.0
    assert np.isnan(answers.query_region(ask("camera", SWEPT, object_id=1, boxes=inside)).p_free)
    assert answers.query_region(ask(frame, object_id=2, **box(*RIGHT))).p_free == pytest.approx(0.3)
    with pytest.raises(ValueError, match="frame_id is 'farside/object_1'"):
        answers.next_view(views("farside/object_1", 2))


def test_an_answer_tells_the_stage_of_the_objects_asked() -> None:
    answers = two_objects()
    for object_id, stage in ((0, 2), (1, 4), (2, 2)):
        asked = ask("camera", object_id=object_id, **box((-1, -1, 0), (1, 1, 1)))
        assert answers.query_region(asked).stage == answers.next_view(views("camera", object_id)).stage == stage


def test_over_the_bus_while_scenes_change() -> None:
    """Every answer is of one whole scene: with the weights (w, 1 - w) of its stage."""
    answers, done = Answers(), threading.Event()
    answers.update([body_with_handle((0.0, 1.0), stage=0)])

    def infer() -> None:
        stage = 0
        while not done.is_set():
            stage = (stage + 1) % 10
            answers.update([body_with_handle((stage / 10, 1 - stage / 10), stage=stage)])

    thread = threading.Thread(target=infer)
    with Bus(BusConfig()) as bus:
        answers.serve(bus)
        thread.start()
        try:
            for _ in range(10):
                response = bus.call("~/query_region", QUERY_REGION, ask(**box(*RIGHT)), 20.0)
                assert response.success and response.p_free == pytest.approx(response.stage / 10)
        finally:
            done.set()
            thread.join()
        refused = bus.call("~/query_region", QUERY_REGION, ask("map", **box(*RIGHT)), 20.0)
        assert not refused.success and refused.message.startswith("frame_id is 'map'")


def test_a_type_is_described_as_it_is_hashed() -> None:
    """What a client rebuilds from the answer has the very hash of the type; own types come with their text."""
    for kind in (HYPOTHESES, QUERY_REGION, "std_msgs/msg/Empty", "rcl_interfaces/msg/ParameterDescriptor"):
        digest = hashlib.sha256(json.dumps(description(kind)).encode()).hexdigest()
        assert f"RIHS01_{digest}" == type_hash(kind)

    def call(bus: Bus, name: str, hashed: str) -> Any:
        request = make(f"{GET_TYPE_DESCRIPTION}_Request", type_name=name, type_hash=hashed, include_type_sources=True)
        return bus.call("~/get_type_description", GET_TYPE_DESCRIPTION, request, 20.0)

    with Bus(BusConfig()) as bus:
        serve_type_descriptions(bus)
        answer = call(bus, HYPOTHESES, type_hash(HYPOTHESES))
        described = answer.type_description
        assert answer.successful and described.type_description.type_name == HYPOTHESES
        names = [f.name for f in described.type_description.fields]
        assert names == [f["name"] for f in description(HYPOTHESES)["type_description"]["fields"]]
        header = next(f.type for f in described.type_description.fields if f.name == "header")
        assert (header.type_id, header.nested_type_name) == (1, "std_msgs/msg/Header")
        assert "std_msgs/msg/Header" in {part.type_name for part in described.referenced_type_descriptions}
        (source,) = answer.type_sources
        assert source.raw_file_contents == (FOLDER / "msg" / "ShapeHypotheses.msg").read_text()
        wrong = call(bus, HYPOTHESES, "RIHS01_00")
        assert not wrong.successful and "two versions of it are in use" in wrong.failure_reason
        unknown = call(bus, "a_msgs/msg/B", "")
        assert not unknown.successful and "'a_msgs/msg/B' is unknown" in unknown.failure_reason


def test_settings_are_parameters() -> None:
    config = BusConfig(domain_id=3)
    assert flat(config)["domain_id"] == 3 and "tls_ca" not in flat(config)

    def call(bus: Bus, service: str, **fields) -> Any:
        kind = f"rcl_interfaces/srv/{service}"
        snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in service).strip("_")
        return bus.call(f"~/{snake}", kind, make(f"{kind}_Request", **fields), 20.0)

    with Bus(config) as bus:
        serve_parameters(bus, {"bus.domain_id": 3, "bus.listen": ("a", "b"), "seed": 0, "gate": 0.5, "on": True})
        assert call(bus, "ListParameters").result.names == ["bus.domain_id", "bus.listen", "gate", "on", "seed"]
        assert call(bus, "ListParameters", prefixes=["bus"]).result.names == ["bus.domain_id", "bus.listen"]
        assert call(bus, "ListParameters", depth=1).result.names == ["gate", "on", "seed"]
        values = call(bus, "GetParameters", names=["bus.domain_id", "bus.listen", "gate", "on", "absent"]).values
        assert [v.type for v in values] == [2, 9, 3, 1, 0]
        assert (values[0].integer_value, values[2].double_value, values[3].bool_value) == (3, 0.5, True)
        assert values[1].string_array_value == ["a", "b"]
        assert call(bus, "GetParameterTypes", names=["gate"]).types.tolist() == [3]
        described = call(bus, "DescribeParameters", names=["seed"]).descriptors[0]
        assert (described.name, described.type, described.read_only) == ("seed", 2, True)
        wanted = {"parameters": [make("rcl_interfaces/msg/Parameter")]}
        assert not call(bus, "SetParameters", **wanted).results[0].successful
        result = call(bus, "SetParametersAtomically", **wanted).result
        assert not result.successful and "change its configuration file" in result.reason
