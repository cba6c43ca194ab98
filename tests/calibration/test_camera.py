"""Laws of the camera: rays and projection are inverse; what is no camera is refused."""

import cv2
import numpy as np
import pytest

from calibration.camera import Camera

K = np.array([[520.0, 0.0, 318.5], [0.0, 518.0, 243.2], [0.0, 0.0, 1.0]])
LENSES = {
    "none": ("plumb_bob", np.zeros(5)),
    "plumb_bob": ("plumb_bob", np.array([-0.28, 0.07, 0.0006, -0.0003, 0.01])),
    "four": ("plumb_bob", np.array([0.1, -0.2, 0.001, 0.001])),
    "equidistant": ("equidistant", np.array([-0.02, 0.01, -0.004, 0.001])),
    "ideal fisheye": ("equidistant", np.zeros(4)),
    "rational": ("rational_polynomial", np.array([8.6, 4.6, 1e-4, -6e-5, 0.25, 8.9, 7.5, 1.3])),
}


def camera(lens: str = "none") -> Camera:
    model, distortion = LENSES[lens]
    return Camera(640, 480, K, distortion, model)


@pytest.mark.parametrize("lens", LENSES)
def test_project_inverts_rays(lens: str) -> None:
    x, y = np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 479, 13))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = camera(lens).rays(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    depth = np.random.default_rng(0).uniform(0.3, 4.0, (len(rays), 1))
    np.testing.assert_allclose(camera(lens).project(rays * depth), pixels, atol=1e-3)


@pytest.mark.parametrize(("model", "count"), [("plumb_bob", 5), ("equidistant", 4)])
def test_skew_is_honoured(model: str, count: int) -> None:
    skew = np.array([[0.0, 7.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    skewed = Camera(640, 480, K + skew, np.zeros(count), model)
    pixels = np.random.default_rng(0).uniform(0, 480, (50, 2))
    np.testing.assert_allclose(skewed.project(skewed.rays(pixels)), pixels, atol=1e-9)


def test_the_axis_looks_forward_and_y_is_down() -> None:
    rays = camera().rays(np.array([[318.5, 243.2], [318.5, 400.0], [500.0, 243.2]]))
    np.testing.assert_allclose(rays[0], [0, 0, 1], atol=1e-12)
    assert rays[1, 1] > 0 and rays[2, 0] > 0


def test_points_behind_the_camera_have_no_pixel() -> None:
    for lens in LENSES:
        assert np.isnan(camera(lens).project(np.array([[0.1, 0.0, -1.0], [0.0, 0.0, 0.0]]))).all()


def test_a_pixel_that_no_ray_reaches_is_nan() -> None:
    barrel = Camera(640, 480, K, np.array([-0.9, 0.0, 0.0, 0.0, 0.0]))  # folds over inside the picture
    rays = barrel.rays(np.array([[0.0, 0.0], [318.5, 243.2]]))
    assert np.isnan(rays[0]).all() and np.isfinite(rays[1]).all()


def test_the_fisheye_is_opencvs() -> None:
    fisheye = camera("equidistant")
    points = np.random.default_rng(0).uniform([-2, -2, 0.2], [2, 2, 2], (100, 3))
    theirs = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), K, fisheye.distortion)[0]
    np.testing.assert_allclose(fisheye.project(points), np.reshape(theirs, (-1, 2)), atol=1e-9)


def test_a_fisheye_looks_forward_only_and_does_not_fold() -> None:
    narrow = K * np.array([[0.2, 1, 1], [1, 0.2, 1], [1, 1, 1]])  # the picture's corners lie beyond 90 degrees
    rays = Camera(640, 480, narrow, np.zeros(4), "equidistant").rays(
        np.array([[0.0, 0.0], [318.5, 243.2], [200, 243.2]])
    )
    assert np.isnan(rays[0]).all() and rays[2, 2] > 0
    np.testing.assert_array_equal(rays[1], [0, 0, 1])
    folds = Camera(640, 480, K, np.array([-0.4, 0, 0, 0]), "equidistant")
    assert np.isnan(folds.rays(np.array([[0.0, 0.0]]))).all()


def test_fisheye_is_another_name_of_equidistant() -> None:
    assert Camera(640, 480, K, np.zeros(4), "fisheye").model == "equidistant"


def test_empty_arrays_pass() -> None:
    assert camera().rays(np.zeros((0, 2))).shape == (0, 3)
    assert camera().project(np.zeros((0, 3))).shape == (0, 2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"width": 0}, "0x480"),
        ({"K": np.full((3, 3), np.nan)}, "finite"),
        ({"K": np.diag([-500.0, 500.0, 1.0])}, "positive focal"),
        ({"K": K.T}, "transposed"),
        ({"model": "omnidirectional"}, "omnidirectional.*equidistant"),
        ({"model": "equidistant"}, "does not fit equidistant: 4"),
        ({"distortion": np.zeros(3)}, "4 or 5"),
        ({"distortion": np.full(5, np.inf)}, "finite"),
        ({"K_std": -np.eye(3)}, "K_std is .*0 or more"),
        ({"distortion_std": np.full(5, np.nan)}, "distortion_std is"),
        ({"rms": -0.1}, "rms is -0.1"),
    ],
)
def test_what_is_no_camera_is_refused(change: dict, says: str) -> None:
    fields = {"width": 640, "height": 480, "K": K, "distortion": np.zeros(5), "model": "plumb_bob"} | change
    with pytest.raises(ValueError, match=says):
        Camera(**fields)
