"""The map without shapes finds known solids, and knows nothing where it was told nothing."""

import numpy as np
import pytest
import trimesh
from scipy.special import expit
from scipy.stats import norm

from benchmarks.scenes.strangers import StrangerConfig, hidden_points, stranger
from perception.inference.hilbert_map import HilbertMap, HilbertMapConfig, features, fit, hilbert_map, thinned
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import segment
from probnerf.rendering.occupancy import voxel_centres

CONFIG = HilbertMapConfig()
GRID = np.stack(np.meshgrid(*[np.arange(-0.15, 0.16, 0.05)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
POINTS = np.random.default_rng(0).uniform(-0.15, 0.15, (1500, 3))


def test_a_half_space_is_recovered() -> None:
    found = fit(POINTS, POINTS[:, 0] < 0.02, GRID, CONFIG)
    asked = np.random.default_rng(1).uniform(-0.12, 0.12, (1000, 3))
    asked = asked[np.abs(asked[:, 0] - 0.02) > 0.015]
    assert np.mean((found.p_occupied(asked) > 0.5) == (asked[:, 0] < 0.02)) > 0.99


def test_a_ball_is_recovered() -> None:
    found = fit(POINTS, np.linalg.norm(POINTS, axis=1) < 0.09, GRID, CONFIG)
    radius = np.linalg.norm(POINTS, axis=1)
    p = found.p_occupied(POINTS)
    assert p[radius < 0.07].min() > 0.5 > p[(radius > 0.11) & (radius < 0.15)].max()


def test_where_nothing_was_told_the_prior_returns() -> None:
    known = POINTS[POINTS[:, 2] > 0.05]
    found = fit(known, known[:, 0] < 0.0, GRID, CONFIG)
    away = GRID[GRID[:, 2] < -0.09]  # hinge points that no point came near: their weights kept the prior
    assert np.abs(found.p_occupied(away) - 0.5).max() < 0.05
    assert np.ptp(found.p_occupied(away - 5.0)) < 1e-9  # beyond all hinge points the constant alone


def test_predictions_are_the_mean_of_the_posterior() -> None:
    rng = np.random.default_rng(2)
    root = rng.standard_normal((4, 4))
    given = HilbertMap(rng.uniform(0, 0.05, (3, 3)), rng.standard_normal(4), root @ root.T + np.eye(4), 1000.0)
    asked = rng.uniform(0, 0.05, (5, 3))
    phi = features(asked, given.hinges, 1000.0)
    spread = np.sqrt(np.einsum("nm,mk,nk->n", phi, np.linalg.inv(given.precision), phi))
    u = norm.ppf((np.arange(2000) + 0.5) / 2000)
    exact = expit(phi @ given.mean + u[:, None] * spread).mean(axis=0)
    np.testing.assert_allclose(given.p_occupied(asked), exact, atol=0.02)


def test_drawn_shapes_are_solid_as_often_as_predicted() -> None:
    found = fit(POINTS[::8], POINTS[::8, 0] < 0.02, GRID, CONFIG)
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    turn[:, 0] *= np.linalg.det(turn)
    T = np.eye(4)
    T[:3] = np.column_stack([turn, [0.01, -0.02, 0.03]])
    cube = ObjectFrame(T, 0.15, np.array([0.0, 0.0, 1.0, 0.0]), 0.1, 0.1)
    drawn = found.shapes(cube, 8, 2000, seed=0)
    centres = voxel_centres(8).reshape(-1, 3) * 0.15 @ turn.T + T[:3, 3]
    p = found.p_occupied(centres)
    assert np.ptp(p) > 0.5
    np.testing.assert_allclose(drawn.reshape(2000, -1).mean(axis=0), p, atol=0.06)


def test_a_cell_keeps_the_mean_of_its_points() -> None:
    points = np.array([[0.001, 0.001, 0.001], [0.003, 0.001, 0.001], [-0.001, 0.0, 0.0]])
    kept = thinned(points, 0.01)
    assert sorted(kept[:, 0].tolist()) == pytest.approx([-0.001, 0.002])


def test_a_box_on_a_table_is_more_likely_solid_than_the_space_beside_it(tmp_path) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box((0.1, 0.12, 0.14)).export(path)
    scene = stranger(path, StrangerConfig(width=160, height=120, focal=150.0, border=2.0))
    points, occupied = hidden_points(scene)
    p = hilbert_map(scene.frame, segment(scene.frame, 1)[0]).p_occupied(points)
    assert p[occupied].mean() > max(0.7, p[~occupied].mean() + 0.2)
