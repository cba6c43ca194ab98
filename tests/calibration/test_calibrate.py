"""A known camera is recovered within its standard deviations; what is not determined is not claimed."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.boards import parse_board
from calibration.calibrate import CalibrateConfig, calibrate, distinct
from calibration.fit import BoardView
from tests.calibration.boards import CAMERAS, CHESSBOARD, SIZE, poses, views

CONFIG = CalibrateConfig()
PARTS = ([0, 1, 0, 1], [0, 1, 2, 2])  # fx, fy, cx, cy


@pytest.mark.parametrize("model", CAMERAS)
def test_a_known_camera_is_recovered(model: str) -> None:
    known = CAMERAS[model]
    result = calibrate(views(model), SIZE, model)
    found = result.camera
    assert result.trouble is None and not result.dropped and found.model == model
    errors = (found.K - known.K)[PARTS] / found.K_std[PARTS]
    assert np.abs(errors).max() < 4
    assert (found.K_std[PARTS] < 0.8).all()  # px
    assert found.rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)  # noise in x and in y, less what was fitted
    if model != "rational_polynomial":  # whose coefficients run along a valley, in the end to the same pixels
        assert np.abs((found.distortion - known.distortion) / found.distortion_std).max() < 4
    x, y = np.meshgrid(np.linspace(100, 540, 9), np.linspace(80, 400, 7))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    assert np.abs(found.project(known.rays(pixels)) - pixels).max() < 1.0
    # Poses and residuals belong to it.
    for fitted in result.views:
        T = fitted.T_camera_board
        predicted = found.project(result.bend.bent(fitted.view.points) @ T[:3, :3].T + T[:3, 3])
        np.testing.assert_allclose(fitted.view.pixels - predicted, fitted.residuals, atol=1e-6)
        assert fitted.rms == pytest.approx(np.sqrt((fitted.residuals**2).sum(axis=1).mean()))


@pytest.mark.parametrize("model", CAMERAS)
def test_exact_corners_give_the_exact_camera(model: str) -> None:
    camera = calibrate(views(model, noise=0.0), SIZE, model).camera
    np.testing.assert_allclose(camera.K, CAMERAS[model].K, atol=0.05)
    assert camera.rms < 1e-2


def test_deviations_are_opencvs_where_errors_are_independent() -> None:
    """Not less, and not much more: the bend is fitted besides, and its prior does not tell all."""
    seen = views("plumb_bob", count=40, noise=0.3)
    camera = calibrate(seen, SIZE).camera
    points, pixels = ([getattr(v, name).astype(np.float32) for v in seen] for name in ("points", "pixels"))
    theirs = cv2.calibrateCameraExtended(points, pixels, SIZE, np.eye(3), np.zeros(5))[5].ravel()
    ratio = np.array([*camera.K_std[PARTS], *camera.distortion_std]) / theirs[:9]
    assert (ratio > 0.98).all() and (ratio < 2.0).all() and np.median(ratio) < 1.5


def test_errors_that_a_picture_has_in_common_count_once() -> None:
    """Each picture's corners are scaled about their middle: as many errors as pictures, not as corners."""
    rng = np.random.default_rng(0)
    independent, common = views("plumb_bob", count=20, noise=0.3), []
    for view in views("plumb_bob", count=20, noise=0.02):
        about = view.pixels - view.pixels.mean(axis=0)
        common.append(replace(view, pixels=view.pixels + about @ rng.normal(size=(2, 2)) * 0.004))
    alone, together = (calibrate(v, SIZE).camera for v in (independent, common))
    assert together.K_std[0, 0] / together.rms > 3 * alone.K_std[0, 0] / alone.rms


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_bent_board_is_found_bent(model: str) -> None:
    """A bow of 1% of the half board moves the focal length of a flat fit by far more than the noise."""
    rng = np.random.default_rng(1)
    corners = CHESSBOARD.corners
    x = (corners[:, 0] - corners[:, 0].mean()) / np.ptp(corners[:, 0]) * 2
    bow = corners + (0.01 * np.ptp(corners[:, 0]) / 2 * x**2)[:, None] * [0, 0, 1]
    seen = []
    for i, T in enumerate(poses(CAMERAS[model], CHESSBOARD, 15, 40.0, 3)):
        pixels = CAMERAS[model].project(bow @ T[:3, :3].T + T[:3, 3])
        seen.append(BoardView(str(i), corners, pixels + 0.05 * rng.normal(size=pixels.shape)))
    result = calibrate(seen, SIZE, model)
    np.testing.assert_allclose(result.bend.coefficients, [0.01, 0, 0], atol=5e-4)
    np.testing.assert_allclose(np.ptp(result.bend.bent(corners)[:, 2]), np.ptp(bow[:, 2]), rtol=0.05)
    assert result.camera.rms < 0.08
    assert (np.abs(result.camera.K - CAMERAS[model].K)[PARTS] < 4 * result.camera.K_std[PARTS]).all()
    assert (result.camera.K_std[PARTS] < 1.0).all()


def test_a_fisheyes_deviations_are_its_spread_over_repetitions() -> None:
    exact = views("equidistant", count=8, noise=0.0)
    found, stated = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        noisy = [replace(v, pixels=v.pixels + 0.2 * rng.normal(size=v.pixels.shape)) for v in exact]
        camera = calibrate(noisy, SIZE, "equidistant").camera
        found.append([*camera.K[PARTS], *camera.distortion])
        stated.append([*camera.K_std[PARTS], *camera.distortion_std])
    ratio = np.std(found, axis=0, ddof=1) / np.mean(stated, axis=0)
    # 3 standard deviations of 24 repetitions; with 8 views the jackknife errs on the wide side
    assert (ratio > 0.4).all() and (ratio < 1.5).all()


@pytest.mark.parametrize("model", CAMERAS)
def test_more_views_are_more_certain(model: str) -> None:
    few, many = (calibrate(views(model, count), SIZE, model).camera.K_std[0, 0] for count in (8, 32))
    assert many < 0.8 * few


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_board_seen_face_on_determines_nothing(model: str, noise: float) -> None:
    try:
        result = calibrate(views(model, noise=noise, tilt=0.0), SIZE, model)
    except ValueError as error:  # OpenCV itself finds that no fisheye fits
        assert model == "equidistant" and "tilted by 30 degrees" in str(error) and "\n" not in str(error)
        return
    if model == "plumb_bob":
        assert "focal length is not determined" in result.trouble and "nearly face on" in result.trouble
        assert "tilted by 30 to 45 degrees" in result.trouble and "\n" not in result.trouble


def test_few_and_like_views_are_refused() -> None:
    (one,) = views("plumb_bob", 1, noise=0.0)
    with pytest.raises(ValueError, match=r"^1 different views of the board are too few .* take 3 or more"):
        calibrate(distinct([one, one, one], SIZE, CONFIG)[0], SIZE)
    rng = np.random.default_rng(0)
    again = [BoardView(str(i), one.points, one.pixels + 0.3 * rng.normal(size=one.pixels.shape)) for i in range(6)]
    assert "focal length is not determined" in calibrate(again, SIZE).trouble


def test_views_that_differ_are_kept() -> None:
    seen = views("plumb_bob", 10)
    moved = [replace(v, name=f"{v.name} again", pixels=v.pixels + 3.0) for v in seen]
    kept, same = distinct([*seen, *moved], SIZE, CONFIG)
    assert kept == seen
    assert same[0] == ("view 0 again", "nearly the same view as view 0") and len(same) == 10
    kept, same = distinct(seen, SIZE, replace(CONFIG, most_views=4))
    assert [v.name for v in kept] == ["view 0", "view 3", "view 6", "view 9"] and len(same) == 6


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_bad_view_is_left_out(model: str) -> None:
    seen = views(model)
    rng = np.random.default_rng(0)
    seen[4] = replace(seen[4], name="blurred", pixels=seen[4].pixels + 3.0 * rng.normal(size=(48, 2)))
    result = calibrate(seen, SIZE, model)
    ((name, why),) = result.dropped
    assert name == "blurred" and "times the median" in why
    assert len(result.views) == 14 and "blurred" not in [v.view.name for v in result.views]
    assert abs(result.camera.K[0, 0] - CAMERAS[model].K[0, 0]) < 4 * result.camera.K_std[0, 0]


def test_another_board_than_the_named_one_is_not_saved() -> None:
    wrong = parse_board("chessboard:6x8:0.1").corners
    try:
        trouble = calibrate([replace(v, points=wrong) for v in views("plumb_bob")], SIZE).trouble
    except ValueError as error:  # or no camera comes out of it at all
        trouble = str(error)
    assert "miss their places by" in trouble or "camera fits" in trouble


def test_views_of_parts_of_a_board_count() -> None:
    rng = np.random.default_rng(0)
    parts = []
    for view in views("plumb_bob", 20):
        chosen = np.sort(rng.permutation(48)[: rng.integers(20, 48)])
        parts.append(BoardView(view.name, view.points[chosen], view.pixels[chosen]))
    for model in ("plumb_bob", "equidistant"):
        result = calibrate(parts, SIZE, model)
        assert result.trouble is None
    camera = calibrate(parts, SIZE).camera
    assert abs(camera.K[0, 0] - 430.0) < 4 * camera.K_std[0, 0]


def test_the_real_chessboard(shared_data: Path) -> None:
    board = parse_board("chessboard:8x6:0.108")
    seen = []
    for file in sorted((shared_data / "chessboard_wide").glob("*.png")):
        found = board.find(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
        assert found is not None
        seen.append(BoardView(file.name, *found))
    kept, _ = distinct(seen, SIZE, CONFIG)
    result = calibrate(kept, SIZE)
    assert len(result.views) == 12 and result.trouble is None
    assert abs(result.camera.K[0, 0] / 430.3 - 1) < 0.005 and result.camera.rms <= 0.18
