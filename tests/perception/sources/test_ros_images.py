"""A CameraInfo becomes the camera that it describes, whatever its lens model is called."""

from types import SimpleNamespace

import numpy as np
import pytest

from perception.sources.ros_images import to_camera

K = np.array([[90.0, 0, 31], [0, 91, 23], [0, 0, 1]])


def info(model: str, distortion: list[float]) -> SimpleNamespace:
    P = np.column_stack([K * [[2.0], [2.0], [1.0]], np.zeros(3)]).ravel()
    return SimpleNamespace(width=64, height=48, k=K.ravel(), d=np.array(distortion), p=P, distortion_model=model)


@pytest.mark.parametrize("name", ["equidistant", "fisheye"])
@pytest.mark.parametrize("distortion", [[0.1, -0.2, 0.01, 0.0], []])
def test_a_fisheye_is_equidistant(name: str, distortion: list[float]) -> None:
    camera = to_camera(info(name, distortion), rectified=False)
    assert camera.model == "equidistant"
    np.testing.assert_array_equal(camera.distortion, distortion or np.zeros(4))
    # 90 pixels from the middle is an angle of 1, not a tangent of 1.
    if not distortion:
        ray = camera.rays(np.array([[31.0 + 90.0, 23.0]]))[0]
        np.testing.assert_allclose(ray, [np.sin(1.0), 0.0, np.cos(1.0)], atol=1e-12)


def test_other_lenses() -> None:
    assert to_camera(info("", []), rectified=False).model == "plumb_bob"
    assert to_camera(info("rational_polynomial", [0.1] * 8), rectified=False).model == "rational_polynomial"
    rectified = to_camera(info("equidistant", [0.1] * 4), rectified=True)
    assert rectified.model == "plumb_bob" and not rectified.distortion.any() and rectified.K[0, 0] == 180.0
    with pytest.raises(ValueError, match="'sphere' is unknown"):
        to_camera(info("sphere", [0.1] * 4), rectified=False)
