"""Clouds, markers, pictures and frames show what the hypotheses say, where they say it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibration.camera import Camera
from node.ros.messages import decode, encode, matrix
from node.ros.scene_messages import (
    CLOUD_FIELDS,
    MAX_TRIANGLES,
    DiagnosticStatus,
    counts_status,
    diagnostics_message,
    markers_message,
    occupancy_message,
    sampler_status,
    transforms_message,
    uncertainty,
    uncertainty_message,
)
from perception.answers.query import query
from perception.answers.regions import Points
from tests.node.shapes import BODY, GRID, HALF_EXTENT, LEFT, RIGHT, STAMP_NS, body_with_handle

CAMERA = Camera(160, 120, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]), np.zeros(5))


def there_and_back(message: Any) -> Any:
    return decode(bytes(encode(message)), message.__msgtype__)


def cloud(message: Any) -> np.ndarray:
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        (name, 4 * i, 7, 1) for i, name in enumerate(CLOUD_FIELDS)
    ]
    assert message.row_step == message.point_step * message.width == len(message.data)
    return np.frombuffer(message.data.tobytes(), [(name, "<f4") for name in CLOUD_FIELDS])


def test_the_cloud_says_what_a_query_says() -> None:
    scene = [body_with_handle(), body_with_handle((0.8, 0.2), object_id=2)]
    message = there_and_back(occupancy_message(scene[:1]))
    points = cloud(message)
    assert message.header.frame_id == scene[0].frame_id and message.header.stamp.nanosec == STAMP_NS % 10**9
    xyz = np.stack([points["x"], points["y"], points["z"]], axis=1).astype(np.float64)
    asked = query(scene[:1], Points(xyz), "camera", now_ns=STAMP_NS)
    np.testing.assert_allclose(points["p_occupied"], asked.p_occupied, atol=1e-4)  # places are in single precision
    assert len(points) == (scene[0].p_occupied >= 0.05).sum()
    inside = (xyz - scene[0].object_frame.T_camera_object[:3, 3]) @ scene[0].object_frame.T_camera_object[:3, :3]
    left = np.all((inside > LEFT[0]) & (inside < LEFT[1]), axis=1)
    body = np.all((inside > BODY[0]) & (inside < BODY[1]), axis=1)
    np.testing.assert_allclose(points["p_occupied"][left], 0.3, atol=1e-6)
    np.testing.assert_allclose(points["weight"][body], 0.7, atol=1e-6)
    np.testing.assert_allclose(points["disagreement"][body], 0.0, atol=1e-6)
    assert points["disagreement"][left] == pytest.approx(-0.3 * np.log(0.3) - 0.7 * np.log(0.7))
    np.testing.assert_array_equal(points["seen"], inside[:, 1] < 0)
    assert len(cloud(occupancy_message(scene))) > 1.9 * len(points)


def test_out_of_model_makes_the_cloud_cautious() -> None:
    sure, unsure = body_with_handle(), body_with_handle(out_of_model=True)
    hidden = cloud(occupancy_message([unsure]))
    assert len(hidden) > 5 * len(cloud(occupancy_message([sure])))
    assert hidden["p_occupied"][hidden["seen"] == 0].min() >= 0.5


def test_markers_are_the_shapes_surfaces() -> None:
    h = body_with_handle(object_id=4)
    array = there_and_back(markers_message([h])).markers
    assert [(m.action, m.ns, m.id, m.type) for m in array] == [
        (3, "", 0, 0),
        (0, "object_4", 0, 11),
        (0, "object_4", 1, 11),
    ]
    assert {m.header.frame_id for m in array} == {h.frame_id}
    for marker, handle in zip(array[1:], (RIGHT, LEFT), strict=True):  # the heaviest first
        np.testing.assert_allclose(matrix(marker.pose), h.object_frame.T_camera_object, atol=1e-12)
        corners = np.array([(p.x, p.y, p.z) for p in marker.points])
        assert 0 < len(corners) <= 3 * MAX_TRIANGLES and len(corners) % 3 == 0
        voxel = 2 * HALF_EXTENT / GRID
        np.testing.assert_allclose(corners.min(axis=0), np.minimum(BODY[0], handle[0]), atol=voxel)
        np.testing.assert_allclose(corners.max(axis=0), np.maximum(BODY[1], handle[1]), atol=voxel)
    assert array[1].color.a > array[2].color.a > 0


def test_a_fine_shape_is_drawn_coarsely() -> None:
    fine = body_with_handle()
    rough = np.random.default_rng(0).integers(0, 2, (1, 64, 64, 64), dtype=np.uint8) * 255
    h = replace(
        fine,
        opacity=rough,
        pose=fine.pose[:1],
        weights=np.ones(1),
        population=fine.population[:1],
        seen=np.zeros((64,) * 3, bool),
    )
    assert 0 < len(markers_message([h]).markers[-1].points) <= 3 * MAX_TRIANGLES


def test_the_picture_shows_where_shapes_disagree() -> None:
    h = body_with_handle()
    image = uncertainty([h], CAMERA)
    assert image.max() == pytest.approx(-0.3 * np.log(0.3) - 0.7 * np.log(0.7), abs=1e-6)
    middle = [(np.array(low) + high) / 2 + [0, 0.01, 0] for low, high in (LEFT, RIGHT)]
    for u, v in np.rint(CAMERA.project(h.object_frame.to_camera(np.array(middle) / HALF_EXTENT))).astype(int):
        assert image[v, u] > 0.5
    assert not image[:, :20].any() and not image[:5].any()
    message = there_and_back(uncertainty_message([h], CAMERA))
    assert (message.width, message.height, message.encoding, message.step) == (160, 120, "32FC1", 640)
    np.testing.assert_array_equal(message.data.view(np.float32).reshape(120, 160), image)
    assert not uncertainty([replace(h, seen=np.ones_like(h.seen))], CAMERA).any()


def test_frames_are_those_of_the_objects() -> None:
    scene = [body_with_handle(), body_with_handle(object_id=2)]
    first, second = there_and_back(transforms_message(scene, "/robot/farside")).transforms
    assert (first.child_frame_id, second.child_frame_id) == ("robot/farside/object_1", "robot/farside/object_2")
    assert first.header.frame_id == scene[0].frame_id
    t = second.transform.translation
    np.testing.assert_allclose([t.x, t.y, t.z], scene[1].object_frame.T_camera_object[:3, 3])


def test_diagnostics_say_what_is_wrong() -> None:
    h = body_with_handle(out_of_model=True)
    counts = {"/a": {"sent": 3}, "/b": {"received": 2, "dropped": 1, "malformed": 4}}
    statuses = [
        sampler_status(h, STAMP_NS + 2 * 10**9),
        counts_status(counts),
        DiagnosticStatus("farside: camera", "stale", "gone", {}),
    ]
    sampler, bus, camera = there_and_back(diagnostics_message(STAMP_NS, statuses)).status
    assert (sampler.level, bus.level, camera.level) == (1, 1, 3)
    assert sampler.name == "farside: object 1" and "out of model" in sampler.message
    assert {v.key: v.value for v in sampler.values}.items() >= {"age (s)": "2", "ess": "12.5", "stage": "4"}.items()
    assert bus.message == "5 messages dropped or refused"
    assert counts_status({"/a": {"sent": 3}}).level == "ok"
