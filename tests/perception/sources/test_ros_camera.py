"""A CameraInfo becomes the camera of its image, whatever its lens model is called and whichever part was read."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perception.sources.ros_camera import is_empty, other_size, to_camera

K = np.array([[90.0, 0, 31], [0, 91, 23], [0, 0, 1]])
BROWN = [0.1, -0.2, 0.01, 0.02, 0.03]


def info(model: str, distortion: list[float], **others: Any) -> SimpleNamespace:
    P = np.column_stack([K * [[2.0], [2.0], [1.0]], np.zeros(3)]).ravel()
    fields = dict(width=64, height=48, k=K.ravel(), d=np.array(distortion), p=P, distortion_model=model)
    return SimpleNamespace(**(fields | others))


@pytest.mark.parametrize("name", ["equidistant", "fisheye", "KANNALA_BRANDT4"])
@pytest.mark.parametrize("distortion", [[0.1, -0.2, 0.01, 0.0], []])
def test_a_fisheye_is_equidistant(name: str, distortion: list[float]) -> None:
    camera = to_camera(info(name, distortion), rectified=False)
    assert camera.model == "equidistant"
    np.testing.assert_array_equal(camera.distortion, distortion or np.zeros(4))
    # 90 pixels from the middle is an angle of 1, not a tangent of 1.
    if not distortion:
        ray = camera.rays(np.array([[31.0 + 90.0, 23.0]]))[0]
        np.testing.assert_allclose(ray, [np.sin(1.0), 0.0, np.cos(1.0)], atol=1e-12)


@pytest.mark.parametrize("name", ["plumb_bob", "Plumb Bob", "Brown Conrady", "radtan", "rational_polynomial"])
def test_five_numbers_are_browns_lens_under_any_name(name: str) -> None:
    px = np.array([[0.0, 0.0], [60.0, 40.0]])
    camera, brown = (to_camera(info(n, BROWN), rectified=False) for n in (name, "plumb_bob"))
    np.testing.assert_allclose(camera.rays(px), brown.rays(px), atol=1e-9)


@pytest.mark.parametrize("name", ["", "none", "Inverse Brown Conrady", "rational_polynomial", "sphere"])
@pytest.mark.parametrize("count", [0, 5])
def test_zeros_are_no_distortion_whatever_the_name(name: str, count: int) -> None:
    camera = to_camera(info(name, [0.0] * count), rectified=False)
    assert camera.model == "plumb_bob" and not camera.distortion.any()
    assert to_camera(info("rational_polynomial", [0.0] * 8), rectified=False).model == "rational_polynomial"


def test_lenses_that_are_not_known_are_named() -> None:
    with pytest.raises(ValueError, match="'sphere' is unknown"):
        to_camera(info("sphere", BROWN), rectified=False)
    with pytest.raises(ValueError, match=r"inverse Brown-Conrady lens .* px off"):
        to_camera(info("Inverse Brown Conrady", [-3.0, 9.0, 0.0, 0.0, 0.0]), rectified=False)
    for wrong in (info("Inverse Brown Conrady", [np.nan] * 5), info("Inverse Brown Conrady", BROWN, k=np.eye(3) * 0)):
        with pytest.raises(ValueError, match=r"unknown|positive focal"):
            to_camera(wrong, rectified=False)


def test_librealsenses_inverse_lens_takes_pixels_to_the_same_rays() -> None:
    """As `rs2_deproject_pixel_to_point` does (librealsense, src/rs.cpp)."""
    k = [-0.055, 0.066, -0.0004, 0.0003, -0.021]
    matrix = np.array([[384.0, 0, 320], [0, 384, 240], [0, 0, 1]])
    wide = info("Inverse Brown Conrady", k, k=matrix.ravel(), width=640, height=480)
    camera = to_camera(wide, rectified=False)
    for px in ([0.0, 0.0], [320.0, 240.0], [639.0, 100.0], [200.0, 479.0]):
        x, y = (px[0] - 320) / 384, (px[1] - 240) / 384
        r2 = x * x + y * y
        f = 1 + k[0] * r2 + k[1] * r2 * r2 + k[4] * r2 * r2 * r2
        point = [
            x * f + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * f + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y),
            1,
        ]
        assert np.linalg.norm(camera.project(np.array([point]))[0] - px) < 0.3


def test_more_coefficients_than_browns_are_a_rational_lens() -> None:
    for name in ("plumb_bob", "rational_polynomial"):
        assert to_camera(info(name, [0.1] * 8), rectified=False).model == "rational_polynomial"


def test_a_rectified_image_has_the_matrix_p_and_k_where_p_is_empty() -> None:
    rectified = to_camera(info("equidistant", [0.1] * 4), rectified=True)
    assert rectified.model == "plumb_bob" and not rectified.distortion.any() and rectified.K[0, 0] == 180.0
    without = to_camera(info("plumb_bob", BROWN, p=np.zeros(12)), rectified=True)
    assert without.K[0, 0] == 90.0 and not without.distortion.any()


@pytest.mark.parametrize("rectified", [False, True])
def test_a_part_of_the_sensor_sees_what_the_whole_sees_there(rectified: bool) -> None:
    roi = SimpleNamespace(x_offset=8, y_offset=4, width=40, height=32, do_rectify=False)
    whole = to_camera(info("plumb_bob", BROWN), rectified)
    part = to_camera(info("plumb_bob", BROWN, roi=roi), rectified)
    assert (part.width, part.height) == (40, 32)
    px = np.array([[0.0, 0.0], [39.0, 31.0]])
    np.testing.assert_allclose(part.rays(px), whole.rays(px + np.array([8, 4])), atol=1e-9)
    # two by two pixels joined: their middle is the new one's
    joined = to_camera(info("plumb_bob", BROWN, roi=roi, binning_x=2, binning_y=2), rectified)
    assert (joined.width, joined.height) == (20, 16)
    np.testing.assert_allclose(joined.rays(px // 2), whole.rays(2 * (px // 2) + np.array([8.5, 4.5])), atol=1e-9)


def test_a_roi_and_binning_of_zeros_is_the_whole_sensor() -> None:
    none = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    camera = to_camera(info("plumb_bob", BROWN, roi=none, binning_x=0, binning_y=0), rectified=False)
    assert (camera.width, camera.height) == (64, 48)
    np.testing.assert_array_equal(camera.K, K)


def test_a_roi_is_in_pixels_of_the_whole_sensor_whatever_is_joined_or_rectified() -> None:
    """sensor_msgs/CameraInfo: "A particular ROI always denotes the same window of pixels on the camera sensor"."""
    for rectify in (False, True):
        roi = SimpleNamespace(x_offset=8, y_offset=4, width=40, height=32, do_rectify=rectify)
        parts = [to_camera(info("plumb_bob", BROWN, roi=roi, binning_x=n, binning_y=n), False) for n in (0, 1, 2, 4)]
        assert [(c.width, c.height) for c in parts] == [(40, 32), (40, 32), (20, 16), (10, 8)]
        corners = [c.rays(np.array([[-0.5, -0.5], [c.width - 0.5, c.height - 0.5]])) for c in parts]
        for other in corners[1:]:
            np.testing.assert_allclose(other, corners[0], atol=1e-9)


def test_an_image_of_another_size_is_explained_by_what_its_driver_says() -> None:
    image = SimpleNamespace(width=64, height=48)
    joined = info("plumb_bob", BROWN, binning_x=2, binning_y=2)
    said = other_size(joined, to_camera(joined, False), image)
    assert said is not None and "64x48 px" in said and "binning 2x2" in said and "an image is 32x24" in said
    assert other_size(info("plumb_bob", BROWN), to_camera(info("plumb_bob", BROWN), False), image) is None
    assert other_size(joined, to_camera(joined, False), SimpleNamespace(format="jpeg")) is None


def test_an_uncalibrated_camera_is_known() -> None:
    assert is_empty(info("", [], k=np.zeros(9))) and not is_empty(info("", []))


def test_zeros_at_the_end_may_be_left_out_or_added() -> None:
    for model, d in (
        ("plumb_bob", [0.1, -0.2]),
        ("plumb_bob", [*BROWN, 0.0]),
        ("rational_polynomial", [*BROWN, 0.1, 0, 0, 0, 0]),
    ):
        whole = to_camera(info("rational_polynomial", (d + [0.0] * 8)[:8]), rectified=False)
        found = to_camera(info(model, d), rectified=False)
        np.testing.assert_allclose(
            found.project(np.array([[0.2, 0.1, 1.0]])), whole.project(np.array([[0.2, 0.1, 1.0]]))
        )
    with pytest.raises(ValueError, match="does not fit plumb_bob"):
        to_camera(info("plumb_bob", [*BROWN, 0.1]), rectified=False)
