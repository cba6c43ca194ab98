"""Surfaces enclose what may be occupied, and distances lead to it, in any frame."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from perception.answers.hypotheses import Hypotheses
from perception.answers.occupied_space import MAX_CELLS, cells, distance_field, risky_surface
from perception.answers.query import marginal
from probnerf.rendering.occupancy import voxel_centres
from tests.node.shapes import BODY, GRID, HALF_EXTENT, LEFT, RIGHT, body_with_handle

VOXEL = 2 * HALF_EXTENT / GRID


@pytest.mark.parametrize(("risk", "handles"), [(0.05, (LEFT, RIGHT)), (0.5, (RIGHT,)), (0.9, ())])
def test_the_surface_encloses_what_is_riskier(risk: float, handles: tuple) -> None:
    h = body_with_handle()
    vertices, faces = risky_surface(h, risk)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    inside = (marginal(h) > risk).ravel()
    np.testing.assert_array_equal(mesh.contains(voxel_centres(GRID).reshape(-1, 3) * HALF_EXTENT), inside)
    corners = np.array([BODY, *handles])
    np.testing.assert_allclose(vertices.min(axis=0), corners[:, 0].min(axis=0), atol=0.01 * VOXEL)
    np.testing.assert_allclose(vertices.max(axis=0), corners[:, 1].max(axis=0), atol=0.01 * VOXEL)


def test_a_coarse_surface_encloses_the_fine_one() -> None:
    h = body_with_handle()
    fine, coarse = (trimesh.Trimesh(*risky_surface(h, 0.05, grid), process=False) for grid in (GRID, GRID // 2))
    assert len(coarse.faces) < 0.5 * len(fine.faces) and coarse.is_watertight
    assert coarse.contains(voxel_centres(GRID).reshape(-1, 3)[marginal(h) > 0.05] * HALF_EXTENT).all()


def test_where_nothing_is_riskier_there_is_no_surface() -> None:
    h = body_with_handle()
    empty = replace(h, opacity=np.zeros_like(h.opacity))
    assert [len(part) for part in risky_surface(empty, 0.05)] == [0, 0]
    cautious = replace(empty, out_of_model=True)  # half of the weight says that all unseen space is occupied
    vertices, _ = risky_surface(cautious, 0.05)
    assert vertices[:, 1].min() >= -0.01 * VOXEL and vertices[:, 1].max() > HALF_EXTENT - VOXEL


def turned(x: float, y: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
    T[:3, 3] = [x, y, z]
    return T


@pytest.mark.parametrize("width", [0.3 * VOXEL, VOXEL, 1.7 * VOXEL])
def test_cells_leave_no_hole_however_they_are_turned(width: float) -> None:
    """Each cell that lies in the body is one of its voxels'."""
    h = body_with_handle()
    T_frame_camera = turned(0.2, -0.1, 0.4)
    mask = (marginal(h) > 0.9).ravel()
    found, voxel = cells(h, mask, T_frame_camera, width)
    assert mask[voxel].all()
    low = found.min(axis=0)
    every = np.argwhere(np.ones(found.max(axis=0) - low + 1)) + low
    corners = (every[:, None] + np.argwhere(np.ones((2, 2, 2)))) * width
    points = in_object(h, T_frame_camera, corners.reshape(-1, 3)).reshape(corners.shape)
    within = every[np.all((points > BODY[0]) & (points < BODY[1]), axis=(1, 2))]
    assert len(within) > 50
    assert set(map(tuple, within.tolist())) <= set(map(tuple, found.tolist()))


def in_object(h: Hypotheses, T_frame_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    T = np.linalg.inv(T_frame_camera @ h.object_frame.T_camera_object)
    return points @ T[:3, :3].T + T[:3, 3]


@pytest.mark.parametrize("T_frame_camera", [np.eye(4), turned(0.3, 0.1, -0.2)])
def test_distances_are_those_to_the_riskier_boxes(T_frame_camera: np.ndarray) -> None:
    h, width = body_with_handle(), 0.01
    field = distance_field([h], T_frame_camera, None, 0.5, width)
    centres = (
        np.stack(np.meshgrid(*map(np.arange, field.distance.shape), indexing="ij"), -1) + field.first + 0.5
    ) * width
    points = in_object(h, T_frame_camera, centres.reshape(-1, 3))
    boxes = []
    for low, high in (BODY, RIGHT):
        q = np.abs(points - np.add(low, high) / 2) - np.subtract(high, low) / 2
        boxes.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))
    true, got = np.minimum(*boxes), field.distance.ravel()
    known = ~np.isnan(got)
    assert known.sum() * width**3 == pytest.approx((2 * HALF_EXTENT) ** 3 * 1.75 / 2, rel=0.2)  # above the table
    assert np.abs(got - true)[known & (true > 0)].max() < np.sqrt(3) * width
    assert (got[known & (true < -width)] < 0).all() and got[known].min() < -0.02 and got.dtype == np.float32
    assert np.isnan(got[np.abs(points).max(axis=1) > HALF_EXTENT + width]).all()
    assert np.isnan(got[points[:, 2] < -0.75 * HALF_EXTENT - 2 * width]).all()


def test_a_part_of_the_field_is_that_of_the_whole() -> None:
    h = body_with_handle()
    whole = distance_field([h], np.eye(4), None, 0.05, 0.01)
    first = whole.first + np.array([4, 5, 6])
    low = first * 0.01
    part = distance_field([h], np.eye(4), (low + 0.004, low + np.array([0.056, 0.05, 0.034])), 0.05, 0.01)
    assert part.distance.shape == (6, 6, 4) and np.array_equal(part.first, first)
    np.testing.assert_array_equal(part.distance, whole.distance[4:10, 5:11, 6:10])
    beyond = distance_field([h], np.eye(4), ((5.0, 5.0, 5.0), (5.1, 5.1, 5.1)), 0.05, 0.01)
    assert np.isnan(beyond.distance).all()


def test_what_is_cleared_or_below_the_risk_is_free() -> None:
    h = body_with_handle()
    far = distance_field([h], np.eye(4), None, 0.05, 0.01, 0.05, lambda points: np.ones(len(points), bool))
    assert np.nanmin(far.distance) == np.float32(0.05)
    closer = distance_field([h], np.eye(4), None, 0.05, 0.01)
    cleared = distance_field([h], np.eye(4), None, 0.05, 0.01, 2.0, lambda points: points[:, 2] > 0.5)
    assert np.nanmean(cleared.distance) > np.nanmean(closer.distance)


@pytest.mark.parametrize("box", [((0, 0, 0), (0, 1, 1)), ((0, 0, 0), (1, 1, float("inf"))), ((0, 0, 0), (1, 1, -1))])
def test_a_box_without_content_is_refused(box: tuple) -> None:
    with pytest.raises(ValueError, match="is empty or not finite"):
        distance_field([body_with_handle()], np.eye(4), box, 0.05, 0.01)
    with pytest.raises(ValueError, match=f"ask for at most {MAX_CELLS}"):
        distance_field([body_with_handle()], np.eye(4), ((0, 0, 0), (9, 9, 9)), 0.05, 0.01)


def test_cells_too_narrow_for_the_voxels_are_refused() -> None:
    h = body_with_handle()
    with pytest.raises(ValueError, match="ask for wider cells"):
        cells(h, np.ones(h.grid**3, bool), np.eye(4), h.voxel_m / 100)
