"""Planners ask in the robot's own frames, for distances too, and by the time of a simulation."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.clock import CLOCK, Clock
from node.ros.frame_tree import FrameTree
from node.ros.messages import NEXT_VIEW, header, make, matrix, time_message
from node.ros.planner_messages import ESDF
from node.ros.services import BOX, POINTS, Answers
from node.ros.settings import BusConfig, PlannerConfig
from perception.answers.occupied_space import distance_field
from perception.answers.query import query
from perception.answers.regions import Box, Points, Swept, moved
from tests.node.ros.test_frame_tree import frames, place
from tests.node.ros.test_services import ask, box
from tests.node.shapes import STAMP_NS, body_with_handle

T_BASE_CAMERA = place(0.4, 0.7) @ np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1.0]])
T_CAMERA_BASE = np.linalg.inv(T_BASE_CAMERA)


@pytest.fixture
def answers() -> Answers:
    h, tree = body_with_handle(), FrameTree()
    tree.take(frames(("base_link", h.frame_id, T_BASE_CAMERA)), static=True)
    answers = Answers(planner=PlannerConfig(risk=0.5), frames=tree)
    answers.update([h])
    return answers


@pytest.mark.parametrize("frame", ["base_link", "/base_link"])
def test_a_question_in_a_frame_of_the_robot_is_one_in_the_cameras(answers: Answers, frame: str) -> None:
    scene = answers.scene.objects
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (50, 3)) + scene[0].object_frame.T_camera_object[:3, 3]
    in_base = points @ T_BASE_CAMERA[:3, :3].T + T_BASE_CAMERA[:3, 3]
    got = answers.query_region(ask(frame, POINTS, points=in_base.ravel()))
    np.testing.assert_allclose(got.p_occupied, query(scene, Points(points), "camera").p_occupied)
    low, high = in_base.mean(axis=0) - 0.04, in_base.mean(axis=0) + 0.04
    turned = moved(Box(tuple(low), tuple(high)), T_CAMERA_BASE)
    expected = query(scene, turned, "camera")
    got = answers.query_region(ask(frame, BOX, **box(low, high)))
    assert isinstance(turned, Swept) and got.p_free == expected.p_free
    assert got.volume_q50 == expected.volume_m3["q50"] > 0


def test_views_in_a_frame_of_the_robot(answers: Answers) -> None:
    ring = answers.next_view(make(f"{NEXT_VIEW}_Request", header=header(0, "camera")))
    asked = answers.next_view(make(f"{NEXT_VIEW}_Request", header=header(0, "/base_link")))
    np.testing.assert_allclose(
        [matrix(p) for p in asked.poses], [T_BASE_CAMERA @ matrix(p) for p in ring.poses], atol=1e-9
    )


def test_world_is_that_of_tf_where_the_source_knows_none(answers: Answers) -> None:
    with pytest.raises(ValueError, match="without the camera's pose in the world"):
        answers.query_region(ask("world", **box((0, 0, 0), (1, 1, 1))))
    answers.frames.take(frames(("world", "base_link", place(1.0))), static=True)
    wide = box((-2, -2, -2), (2, 2, 2))
    assert answers.query_region(ask("world", **wide)).p_free == answers.query_region(ask("camera", **wide)).p_free
    own = "/" + answers.scene.objects[0].frame_id
    assert answers.query_region(ask(own, **wide)).p_free == 0.0
    with pytest.raises(ValueError, match="or one that is on /tf"):
        answers.query_region(ask("gripper", **wide))


def test_a_camera_that_moved_on_is_asked_where_it_was(answers: Answers) -> None:
    """The arm has carried the camera away before the question comes."""
    h = answers.scene.objects[0]
    answers.frames.take(frames(("base_link", h.frame_id, T_BASE_CAMERA), stamp=STAMP_NS))
    answers.update([h])
    for second in range(1, 30):
        answers.frames.take(frames(("base_link", h.frame_id, np.eye(4)), stamp=STAMP_NS + second * 10**9))
    centre = T_BASE_CAMERA @ h.object_frame.T_camera_object[:, 3]
    assert answers.query_region(ask("base_link", POINTS, points=centre[:3])).p_occupied == [1.0]


def esdf(frame: str, **fields: Any) -> Any:
    return make(f"{ESDF}_Request", frame_id=frame, update_esdf=True, **fields)


def corner(low: tuple[float, float, float], size: tuple[float, float, float]) -> dict[str, Any]:
    return {
        "use_aabb": True,
        "aabb_min_m": make("geometry_msgs/msg/Point", **dict(zip("xyz", low, strict=True))),
        "aabb_size_m": make("geometry_msgs/msg/Vector3", **dict(zip("xyz", size, strict=True))),
    }


def test_distances_over_the_bus(answers: Answers) -> None:
    h = answers.scene.objects[0]
    with Bus(BusConfig()) as bus:
        answers.serve(bus)

        def call(request: Any) -> Any:
            return bus.call("~/get_esdf_and_gradient", ESDF, request, 20.0)

        whole, field = call(esdf("base_link")), distance_field([h], T_BASE_CAMERA, None, 0.5, 0.01)
        assert whole.success and whole.header.frame_id == "base_link"
        values = whole.esdf_and_gradients.data.reshape(field.distance.shape)
        np.testing.assert_array_equal(values, np.nan_to_num(field.distance + np.float32(0.005), nan=-1000.0))
        low, size = field.first * 0.01 + 0.053, (0.1, 0.08, 0.06)
        part = call(esdf("/base_link", **corner(low, size)))
        assert [d.size for d in part.esdf_and_gradients.layout.dim] == [11, 9, 7]  # cells that it meets in part
        np.testing.assert_array_equal(part.esdf_and_gradients.data, values[5:16, 5:14, 5:12].ravel())
        for request in (esdf("gripper"), esdf("base_link", **corner((0, 0, 0), (0, 1, 1)))):
            assert not call(request).success  # it has no message to say why
        assert bus.counts.of("/farside/get_esdf_and_gradient")["refused"] == 2


def test_what_is_cleared_is_free_for_that_answer(answers: Answers) -> None:
    at = T_BASE_CAMERA @ answers.scene.objects[0].object_frame.T_camera_object[:, 3]
    centre = make("geometry_msgs/msg/Point", x=at[0], y=at[1], z=at[2])
    whole = answers.distances(esdf("base_link"))
    for radius in (0.05, 1.0):
        shapes = {"spheres_to_clear_center_m": [centre], "spheres_to_clear_radius_m": np.float32([radius])}
        cleared = answers.distances(esdf("base_link", **shapes))
        assert len(cleared.esdf_and_gradients.data) == len(whole.esdf_and_gradients.data)
    known = np.array(cleared.esdf_and_gradients.data)
    assert known[known > -1000].min() == np.float32(2.005) == known.max()  # all is cleared, and as far as distances go
    low = make("geometry_msgs/msg/Point", x=at[0] - 1, y=at[1] - 1, z=at[2] - 1)
    edges = make("geometry_msgs/msg/Vector3", x=2.0, y=2.0, z=2.0)
    boxed = answers.distances(esdf("base_link", aabbs_to_clear_min_m=[low], aabbs_to_clear_size_m=[edges]))
    np.testing.assert_array_equal(boxed.esdf_and_gradients.data, known)
    with pytest.raises(ValueError, match="each box needs a corner and a size"):
        answers.distances(esdf("base_link", aabbs_to_clear_min_m=[low]))


def until(condition: Callable[[], object]) -> bool:
    deadline = time.monotonic() + 20.0
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(condition())


def test_ages_are_by_the_time_of_a_simulation() -> None:
    with Bus(BusConfig()) as bus:
        real, simulated = Clock(bus), Clock(bus, simulated=True)
        assert abs(simulated.now_ns() - time.time_ns()) < 10**9
        bus.publisher("/clock", CLOCK).publish(make(CLOCK, clock=time_message(STAMP_NS + 5 * 10**9)))
        assert until(lambda: simulated.now_ns() == STAMP_NS + 5 * 10**9)
        assert abs(real.now_ns() - time.time_ns()) < 10**9
        answers = Answers(clock=simulated)
        answers.update([body_with_handle()])
        assert answers.query_region(ask(**box((0, 0, 0), (0.1, 0.1, 0.1)))).age == 5.0
        assert answers.next_view(make(f"{NEXT_VIEW}_Request", header=header(0, "object"))).age == 5.0
