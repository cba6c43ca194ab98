"""Free-form deformation: its laws, and that what it makes stays a solid."""

import numpy as np
import pytest
import trimesh

from probnerf.objects.free_form import LEAST_STRETCH, bent, displacement, least_volume

CUBE = np.random.default_rng(0).random((200, 3))


def test_control_points_moved_alike_move_all_alike() -> None:
    """The weights add up to one."""
    shift = np.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose(displacement(np.broadcast_to(shift, (4, 4, 4, 3)), CUBE), np.tile(shift, (200, 1)))


def test_control_points_moved_by_a_linear_map_move_space_by_it() -> None:
    """Bernstein polynomials reproduce linear functions of their control points, which lie at thirds."""
    matrix = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.1], [0.05, 0.0, 0.2]])
    thirds = np.stack(np.meshgrid(*[np.arange(4) / 3.0] * 3, indexing="ij"), axis=-1)
    np.testing.assert_allclose(displacement(thirds @ matrix.T, CUBE), CUBE @ matrix.T, atol=1e-12)
    assert least_volume(thirds @ matrix.T) == pytest.approx(np.linalg.det(np.eye(3) + matrix))


def test_the_volume_factor_is_that_of_finite_differences() -> None:
    control = 0.05 * np.random.default_rng(1).standard_normal((4, 4, 4, 3))
    corner, step = np.full((1, 3), 0.5), 1e-6
    jacobian = np.eye(3) + np.stack(
        [(displacement(control, corner + step * e) - displacement(control, corner))[0] / step for e in np.eye(3)], -1
    )
    assert least_volume(control) <= np.linalg.det(jacobian) + 1e-5


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
def test_what_is_bent_stays_a_closed_solid_that_is_not_folded(size: float) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    for seed in range(4):
        moved = bent(ball, np.random.default_rng(seed), size)
        assert moved.is_watertight
        assert moved.volume > 0.5 * LEAST_STRETCH * ball.volume
        assert moved.volume == pytest.approx(moved.convex_hull.volume, rel=0.25)
        assert np.abs(moved.vertices - ball.vertices).max() > 1e-4


def test_nothing_moves_where_the_size_is_zero() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    np.testing.assert_allclose(bent(ball, np.random.default_rng(0), 0.0).vertices, ball.vertices, atol=1e-12)
