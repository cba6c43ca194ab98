"""Place and size of what is seen: a handle is no part of the body, a long shaft is."""

import numpy as np
import pytest

from perception.observation.visible_extent import visible_body

CAMERA = 0.4  # m above the plane


def box(rng: np.random.Generator, low: tuple[float, ...], high: tuple[float, ...], count: int = 4000) -> np.ndarray:
    """Points on the top and on the side towards the camera (+x)."""
    points = rng.uniform(low, high, (count, 3))
    points[: count // 2, 2] = high[2]
    points[count // 2 :, 0] = high[0]
    return points


def guessed(points: np.ndarray, angle: float) -> tuple[np.ndarray, float]:
    """Centre and width of points turned about the vertical, 0.5 m before the camera; the centre is turned back."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    seen = np.column_stack([points[:, :2] @ turn.T - [0.5, 0.0], points[:, 2]])
    centre, width, _, _ = visible_body(seen, np.zeros(len(seen), bool), CAMERA)
    return (centre + np.array([0.5, 0.0])) @ turn, width


@pytest.mark.parametrize("angle", [0.0, 0.6, 1.3, 2.2])
def test_a_pans_handle_belongs_to_what_is_seen(angle: float) -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [box(rng, (-0.1, -0.1, 0.0), (0.1, 0.1, 0.05)), box(rng, (0.1, -0.01, 0.03), (0.3, 0.01, 0.05), 800)]
    )
    centre, width = guessed(points, angle)
    assert centre == pytest.approx([0.1, 0.0], abs=0.02)
    assert width == pytest.approx(0.4, abs=0.03)


@pytest.mark.parametrize("angle", [0.0, 1.3])
def test_a_mugs_handle_does_not(angle: float) -> None:
    rng = np.random.default_rng(0)
    turn = rng.uniform(0.0, 2.0 * np.pi, 4000)
    rim = np.column_stack([0.04 * np.cos(turn), 0.04 * np.sin(turn), np.full(4000, 0.1)])
    handle = box(rng, (0.04, -0.006, 0.03), (0.053, 0.006, 0.09), 300)
    centre, width = guessed(np.concatenate([rim, handle]), angle)
    assert centre == pytest.approx([0.0, 0.0], abs=0.006)
    assert width == pytest.approx(0.08, abs=0.008)
