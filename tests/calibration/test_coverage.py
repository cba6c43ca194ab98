"""Coverage counts what was seen, and the advice names what is missing."""

import cv2
import numpy as np
import pytest

from calibration.calibrate import calibrate, tilts
from calibration.coverage import coverage, next_views
from calibration.fit import BoardView, FittedView
from tests.calibration.boards import CAMERAS, CHESSBOARD, SIZE, views


def placed(
    right_away: float = 0.0, lower_away: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 1.0
) -> FittedView:
    """The board's middle at (x, y, z) m, leaning by degrees."""
    T = np.eye(4)
    T[:3, :3] = (
        cv2.Rodrigues(np.radians([lower_away, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.radians([0.0, -right_away, 0.0]))[0]
    )
    T[:3, 3] = np.array([x, y, z]) - T[:3, :3] @ CHESSBOARD.corners.mean(axis=0)
    points = CHESSBOARD.corners @ T[:3, :3].T + T[:3, 3]
    px = CAMERAS["plumb_bob"].project(points)
    assert right_away <= 0 or points[7, 2] > points[0, 2]  # what the names mean
    assert lower_away <= 0 or points[-1, 2] > points[7, 2]
    return FittedView(BoardView("view", CHESSBOARD.corners, px), T, np.zeros_like(px))


def test_tilts_are_signed_and_do_not_depend_on_how_the_board_is_numbered() -> None:
    np.testing.assert_allclose(tilts([placed(30), placed(-20), placed(0, 25)]), [[30, 0], [-20, 0], [0, 25]], atol=1e-9)
    turned = placed(30)
    flip = np.diag([-1.0, 1.0, -1.0, 1.0])  # the same plane with the other side up
    np.testing.assert_allclose(
        tilts([FittedView(turned.view, turned.T_camera_board @ flip, turned.residuals)]), [[30, 0]], atol=1e-9
    )


def test_counts_distances_and_areas() -> None:
    seen = coverage([placed(z=1.5), placed(z=3.0)], SIZE)
    assert seen.counts.sum() == 96 and seen.counts[:, 0].sum() == 0
    np.testing.assert_allclose(seen.distances, [1.5, 3.0])
    assert seen.areas[0] / seen.areas[1] == pytest.approx(4.0, rel=0.1)
    assert "tilts 0 to 0 degrees, distances 1.50 to 3.00 m" in str(seen)


def test_the_advice_is_what_is_missing() -> None:
    face_on = next_views(coverage([placed(), placed(z=2.0)], SIZE))
    assert "right side, then its left side, then its lower side, then its upper side is farther" in face_on[0]
    three = [placed(30), placed(-30), placed(0, 30)]
    assert "so that its upper side is farther" in next_views(coverage(three, SIZE))[0]
    leaning = [*three, placed(0, -30)]
    assert any("upper left" in line for line in next_views(coverage(leaning, SIZE)))
    left = [placed(x=-0.3, y=dy) for dy in (-0.25, 0.0, 0.25)]
    places = [line for line in next_views(coverage([*leaning, *left], SIZE)) if "hold the board at the" in line]
    assert all("left" not in line for line in places) and any("right" in line for line in places)
    assert any("nearer" in line for line in next_views(coverage([placed(30, z=4.0)], SIZE)))


def test_a_good_coverage_needs_no_advice() -> None:
    many = calibrate(views("plumb_bob", 15, seed=3), SIZE).views
    corners = [placed(x=x * 0.6, y=y * 0.4, z=1.0) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    assert next_views(coverage([*many, *corners], SIZE)) == []
