"""Pixel errors over the picture: as large as the truth's, small where corners were seen, and no turn of the camera."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.calibrate import calibrate
from calibration.projection import GRID, projection
from tests.calibration.boards import CAMERAS, SIZE, views


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_the_deviation_is_the_error(model: str) -> None:
    """Errors of the projection against the known camera, and differences of halves."""
    ratios, halves = [], []
    for seed in range(6):
        result = calibrate(views(model, 14, seed=seed), SIZE, model)
        found = projection(result)
        K, distortion = CAMERAS[model].K, CAMERAS[model].distortion
        pixels = found.places.reshape(-1, 2)
        rays, known = result.camera.rays(pixels), replace(result.camera, K=K, distortion=distortion)
        turn = _turn(rays, known.rays(pixels))
        error = np.linalg.norm(known.project(rays @ turn.T) - pixels, axis=1)
        ratios.append(error / found.std.ravel())
        halves.append(found.difference / found.std)
    assert 0.45 < np.sqrt(np.nanmean(np.square(ratios))) < 1.7
    assert 0.8 < np.sqrt(np.nanmean(np.square(halves))) < 4.0  # 2 for independent halves of half of the views each


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The small turn from rays a to rays b, by least squares."""
    both = np.isfinite(a + b).all(axis=1)
    cross = np.concatenate([[[0, z, -y], [-z, 0, x], [y, -x, 0]] for x, y, z in a[both]])
    w = np.linalg.lstsq(cross, (b - a)[both].ravel(), rcond=None)[0]
    return np.eye(3) + np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def test_halves_of_exact_views_agree() -> None:
    found = projection(calibrate(views("plumb_bob", noise=0.0), SIZE))
    assert found.places.shape == (*GRID[::-1], 2) and found.difference.max() < 0.02


def test_few_views_have_no_halves() -> None:
    found = projection(calibrate(views("plumb_bob", 5), SIZE))
    assert found.shift is None and found.difference is None and np.isfinite(found.std).all()


def test_the_worst_place_is_where_no_corner_was() -> None:
    seen = [v for v in views("plumb_bob", 60) if v.pixels[:, 0].max() < 450]
    found = projection(calibrate(seen, SIZE))
    assert len(seen) > 8 and found.std[:, -1].mean() > 1.2 * found.std[:, 0].mean()
    x = float(found.words(found.std).split("(")[1].split(",")[0])
    assert x == SIZE[0] - 1
    assert found.words(np.full_like(found.std, np.nan)) == "not known"
