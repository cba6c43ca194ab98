"""Rays meet the voxels that lie on them, in order, and nothing outside the grid."""

import numpy as np
import pytest

from probnerf.rendering.occupancy import voxel_index
from probnerf.rendering.voxel_rays import crossed, met, nearest


def test_a_ray_crosses_a_box_between_its_faces() -> None:
    low, high = np.array([-0.5, -0.25, 0.0]), np.array([0.5, 0.25, 1.0])
    directions = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    near, far = crossed(np.array([-2.0, 0.0, 0.5]), directions, low, high)
    assert (near[0], far[0]) == pytest.approx((1.5, 2.5)) and (near[1:] > far[1:]).all()
    near, far = crossed(np.array([0.0, 0.0, 0.5]), directions, low, high)
    assert (near == 0.0).all() and far == pytest.approx([0.5, 0.5, 0.25])  # from inside


@pytest.mark.parametrize("grid", [12, 32])
def test_values_are_those_of_the_voxels_at_the_points(grid: int) -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(1, 1 << 60, (grid,) * 3, np.uint64)
    points = rng.uniform(-1.3, 1.3, (5000, 3))
    index = voxel_index(points, grid)
    expected = np.where(index >= 0, values.ravel()[index], 0)
    np.testing.assert_array_equal(nearest(np.pad(values, 1), *points.T), expected)


def test_each_ray_goes_from_its_entry_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    values = rng.integers(1, 256, (16,) * 3, np.uint8)
    origin, directions = np.array([2.0, 1.0, 0.5]), rng.normal(size=(400, 3)) - [2.0, 1.0, 0.5]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    near, far = crossed(origin, directions, np.full(3, -1.0), np.ones(3))
    monkeypatch.setattr("probnerf.rendering.voxel_rays._SAMPLES", 1000)  # so that there are several parts
    parts = list(met(np.pad(values, 1), origin, directions, 0.75, first=0.5))
    rays, t, held = (np.concatenate(part) for part in zip(*parts, strict=True))
    assert len(parts) > 3
    np.testing.assert_array_equal(rays, np.flatnonzero(far > near))
    np.testing.assert_allclose(t[:, 0], near[rays] + 0.5 * 0.75 / 8)
    np.testing.assert_allclose(np.diff(t, axis=1), 0.75 / 8)
    assert (t[:, -1] >= far[rays]).all()
    within = (t < far[rays, None] - 1e-5) & (t > near[rays, None] + 1e-5)
    assert (held[within] > 0).all() and (held[t > far[rays, None] + 1e-5] == 0).all()


def test_rays_that_miss_meet_nothing() -> None:
    assert not list(met(np.ones((6, 6, 6)), np.array([3.0, 0.0, 0.0]), np.array([[1.0, 0.0, 0.0]]), 1.0))
