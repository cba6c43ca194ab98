"""Planners read from their own messages what the hypotheses say."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from node.ros.messages import decode, encode, matrix
from node.ros.planner_messages import (
    SceneDifferences,
    detections_message,
    esdf_response,
    octomap_message,
)
from node.ros.settings import PlannerConfig
from perception.answers.occupied_space import distance_field, risky_surface
from perception.answers.query import query
from perception.answers.regions import Points
from perception.answers.summary import size
from tests.node.ros.test_octree import leaves
from tests.node.shapes import BODY, GRID, HALF_EXTENT, RIGHT, STAMP_NS, body_with_handle


def there_and_back(message: Any) -> Any:
    return decode(bytes(encode(message)), message.__msgtype__)


def operations(message: Any) -> list[tuple[str, int]]:
    assert message.is_diff and message.robot_state.is_diff
    return [(it.id, it.operation) for it in message.world.collision_objects]


def test_an_object_is_added_with_its_surface() -> None:
    h = body_with_handle()
    message = there_and_back(SceneDifferences("/robot/farside", PlannerConfig(mesh_grid=GRID)).message([h]))
    assert operations(message) == [("robot_farside_object_1", 0)]
    (it,) = message.world.collision_objects
    assert it.header.frame_id == h.frame_id and it.header.stamp.nanosec == STAMP_NS % 10**9
    np.testing.assert_allclose(matrix(it.pose), h.object_frame.T_camera_object, atol=1e-12)
    np.testing.assert_allclose(matrix(it.mesh_poses[0]), np.eye(4), atol=1e-12)
    vertices, faces = risky_surface(h, 0.05)
    np.testing.assert_array_equal([(v.x, v.y, v.z) for v in it.meshes[0].vertices], vertices)
    np.testing.assert_array_equal([t.vertex_indices for t in it.meshes[0].triangles], faces)
    assert not len(message.world.octomap.octomap.data)  # MoveIt keeps the one that it has
    low = SceneDifferences("/farside", PlannerConfig(mesh_grid=GRID, risk=0.5)).message([h])
    assert max(v.x for v in low.world.collision_objects[0].meshes[0].vertices) == pytest.approx(BODY[1][0])


def test_objects_come_and_go() -> None:
    """A difference is to what was sent, not to what was worked out."""
    one, two = body_with_handle(), body_with_handle(object_id=2)
    scene = SceneDifferences("/farside", PlannerConfig())
    assert scene.message([]) is None
    assert operations(scene.message([one])) == [("farside_object_1", 0)]
    assert scene.message([]) is None  # nobody got it
    scene.message([one, two])
    scene.sent()
    for _ in range(2):
        assert operations(there_and_back(scene.message([two]))) == [("farside_object_1", 1), ("farside_object_2", 0)]
    scene.sent()
    assert operations(scene.message([one, two])) == [("farside_object_1", 0), ("farside_object_2", 0)]  # back again
    empty = replace(two, opacity=np.zeros_like(two.opacity))
    gone = [("farside_object_1", 1), ("farside_object_2", 1)]
    for objects in ([], [empty]):
        assert operations(there_and_back(scene.message(objects))) == gone
    for said in (gone, gone, gone[1:]):  # each three times: one message may be lost
        assert operations(scene.message([])) == said
        scene.sent()
    assert scene.message([]) is None
    scene.message([one])
    scene.sent()
    assert operations(scene.message([])) == [("farside_object_1", 1)]


def test_a_detection_is_as_large_as_the_summary_says() -> None:
    h = body_with_handle()
    edges = detections_message([h]).detections[0].bbox.size
    np.testing.assert_allclose([edges.y, edges.x, edges.z], size(h), rtol=1e-12)


def test_the_scenes_octomap_lies_where_the_object_does_and_is_emptied() -> None:
    h = body_with_handle()
    scene = SceneDifferences("/farside", PlannerConfig(scene_octomap=True))
    world = there_and_back(scene.message([h])).world.octomap
    np.testing.assert_allclose(matrix(world.origin), h.object_frame.T_camera_object, atol=1e-12)
    assert world.header.frame_id == h.frame_id
    assert world.octomap.data.tobytes() == octomap_message([h], "/farside", 0.005).data.tobytes()
    scene.sent()
    world = there_and_back(scene.message([])).world.octomap
    assert leaves(world.octomap.data.tobytes()) == {(0, 0, 0): (1, pytest.approx(-6.9, abs=0.01))}
    assert world.header.frame_id == h.frame_id


def test_the_octomap_has_the_probabilities_of_unseen_space() -> None:
    """Its voxels, as wide as the object's own, are the object's, and a query of their centres says the same."""
    h = body_with_handle()
    message = there_and_back(octomap_message([h], "/farside", 0.001))
    assert (message.id, message.binary, message.header.frame_id) == ("OcTree", False, "farside/object_1")
    assert message.resolution == pytest.approx(h.voxel_m)
    centres, p = [], []
    for corner, (edge, log_odds) in leaves(message.data.tobytes()).items():
        for offset in np.ndindex(edge, edge, edge):
            centres.append((np.add(corner, offset) + 0.5) * message.resolution)
            p.append(1 / (1 + np.exp(-log_odds)))
    assert len(p) == h.unseen.sum()
    asked = query([h], Points(np.array(centres)), "object", now_ns=STAMP_NS)
    assert asked.unseen_fraction == 1.0
    np.testing.assert_allclose(p, np.clip(asked.p_occupied, 1e-3, 1 - 1e-3), atol=1e-5)


def test_a_wider_voxel_has_the_largest_probability_in_it() -> None:
    h = body_with_handle()
    both = octomap_message([h, body_with_handle(object_id=2)], "/farside", 0.04)
    wide = leaves(octomap_message([h], "/farside", 0.04).data.tobytes())
    fine = leaves(octomap_message([h], "/farside", h.voxel_m).data.tobytes())
    largest: dict[tuple[int, ...], float] = {}
    for corner, (edge, value) in fine.items():
        for offset in np.ndindex(edge, edge, edge):
            cell = tuple(np.floor_divide(np.add(corner, offset), 4).tolist())
            largest[cell] = max(value, largest.get(cell, -np.inf))
    spread: dict[tuple[int, ...], float] = {}
    for corner, (edge, value) in wide.items():
        spread |= {tuple(np.add(corner, o).tolist()): value for o in np.ndindex(edge, edge, edge)}
    assert spread == largest
    assert len(both.data) > len(octomap_message([h], "/farside", 0.04).data)


def test_detections_say_what_it_may_be_and_where() -> None:
    h = body_with_handle(kinds={"box": 0.2, "vessel": 0.7, "other": 0.1})
    message = there_and_back(detections_message([h, body_with_handle(object_id=2)]))
    first, second = message.detections
    assert message.header.frame_id == first.header.frame_id == h.frame_id
    assert (first.id, second.id) == ("1", "2") and not second.results
    found = [(r.hypothesis.class_id, r.hypothesis.score) for r in first.results]
    assert found == [("vessel", 0.7), ("box", 0.2), ("other", 0.1)]
    low, high = np.minimum(BODY[0], RIGHT[0]), np.maximum(BODY[1], RIGHT[1])  # of the heavier one
    size = first.bbox.size
    np.testing.assert_allclose([size.x, size.y, size.z], high - low, atol=1e-9)
    centre = h.object_frame.to_camera(0.5 * (low + high) / HALF_EXTENT)
    np.testing.assert_allclose(matrix(first.bbox.center)[:3, 3], centre, atol=1e-9)
    np.testing.assert_allclose(matrix(first.results[0].pose.pose), matrix(first.bbox.center), atol=1e-12)
    spread = np.reshape(first.results[0].pose.covariance, (6, 6))
    assert spread[0, 0] == pytest.approx(0.3 * 0.7 * 0.06**2) and not spread[1:].any()  # the middles: 3 cm to each side


def test_distances_are_laid_out_as_nvblox_lays_them() -> None:
    h = body_with_handle()
    field = distance_field([h], np.eye(4), None, 0.05, 0.01)
    message = there_and_back(esdf_response(field, STAMP_NS, "camera", -1000.0))
    nx, ny, nz = field.distance.shape
    dims = [(d.label, d.size, d.stride) for d in message.esdf_and_gradients.layout.dim]
    assert dims == [("x", nx, nx * ny * nz), ("y", ny, ny * nz), ("z", nz, nz)]
    values = message.esdf_and_gradients.data.reshape(nx, ny, nz)
    np.testing.assert_array_equal(values == -1000.0, np.isnan(field.distance))
    assert message.success and message.voxel_size_m == np.float32(0.01) and message.header.frame_id == "camera"
    corner = np.array([message.origin_m.x, message.origin_m.y, message.origin_m.z])
    np.testing.assert_allclose(corner, field.first * 0.01)
    inside = np.floor((h.object_frame.T_camera_object[:3, 3] - corner) / 0.01).astype(int)
    assert values[tuple(inside)] == pytest.approx(-0.035, abs=0.01)  # the body's middle
    border = values[(values > -0.003) & (values < 0.005)]
    assert len(border) > 100 and np.abs(border).max() < 1e-6  # the outermost voxels of what is occupied
    assert values[values > 0.005].min() == pytest.approx(0.01)  # and those beside them


@pytest.mark.parametrize("wrong", [{"risk": 0.0}, {"risk": 1.0}, {"mesh_grid": 2}, {"octomap_m": 0.0}])
def test_wrong_settings_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="planner: "):
        PlannerConfig(**wrong)
