"""A camera file is read as it was written, holds what ROS reads, and says what is wrong with it."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.camera import Camera
from calibration.camera_file import read_camera, write_camera
from calibration.projection import Projection

K = np.array([[520.123456789012, 0.0, 318.5], [0.0, 518.0, 243.2], [0.0, 0.0, 1.0]])
MODELS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
# As camera_calibration of ROS writes it.
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [430, 0, 310.5, 0, 431.25, 221, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.39, 0.29, 0.0001, -0.0004, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [380, 0, 307, 0, 0, 400, 219, 0, 0, 0, 1, 0]
"""


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("known", [True, False])
def test_a_round_trip_is_exact(tmp_path: Path, model: str, known: bool) -> None:
    rng = np.random.default_rng(0)
    distortion = rng.normal(size=MODELS[model])
    std = {"K_std": rng.random((3, 3)), "distortion_std": rng.random(MODELS[model]), "rms": 0.1} if known else {}
    camera = Camera(640, 480, K, distortion, model, **std)
    path = tmp_path / "new" / "camera.yaml"
    write_camera(path, camera, "left")
    again = read_camera(path)
    assert (again.width, again.height, again.model, again.rms) == (640, 480, model, camera.rms)
    for name in ("K", "distortion", "K_std", "distortion_std"):
        np.testing.assert_array_equal(getattr(again, name), getattr(camera, name))
    assert [p.name for p in path.parent.iterdir()] == ["camera.yaml"]
    content = yaml.safe_load(path.read_text())
    theirs = set(yaml.safe_load(ROS))
    assert theirs <= set(content) <= theirs | {"farside_calibration"} and content["camera_name"] == "left"
    assert content["projection_matrix"]["data"][:3] == [K[0, 0], 0.0, K[0, 2]]


def test_what_the_projection_misses_is_in_the_file(tmp_path: Path) -> None:
    std, shift = np.full((7, 9), 0.5), np.full((7, 9, 2), [3.0, 4.0])
    std[0, 0] = np.nan
    path = tmp_path / "a.yaml"
    write_camera(path, Camera(640, 480, K, np.zeros(5)), misses=Projection(np.zeros((7, 9, 2)), std, shift))
    ours = yaml.safe_load(path.read_text())["farside_calibration"]
    np.testing.assert_array_equal(np.reshape(ours["projection_std"]["data"], (7, 9)), std)
    assert ours["halves_difference"] == {"rows": 7, "cols": 9, "data": [5.0] * 63}
    assert read_camera(path).K_std is None


def test_a_file_of_ros_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(ROS)
    camera = read_camera(path)
    assert (camera.width, camera.height, camera.model, camera.K_std) == (640, 480, "plumb_bob", None)
    np.testing.assert_array_equal(camera.K, [[430, 0, 310.5], [0, 431.25, 221], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [-0.39, 0.29, 0.0001, -0.0004, 0])


LAUGHS = "a: &a [1]\n" + "".join(f"{y}: &{y} [{', '.join([f'*{x}'] * 99)}]\n" for x, y in ("ab", "bc", "cd"))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("image_width: 640", "image_width: wide", "image_width is 'wide'"),
        ("image_width: 640\n", "", "image_width is None"),
        ("distortion_model: plumb_bob", "distortion_model: sphere", "'sphere' is unknown"),
        ("data: [430, 0,", "data: [430,", "camera_matrix has 8 numbers for 3x3"),
        ("data: [430, 0,", "data: [a, 0,", "could not convert"),
        ("  cols: 5", "  columns: 5", "distortion_coefficients is"),
        (ROS, "- 1", "no keys"),
        (ROS, "a: [", "not YAML"),
        ("data: [430, 0,", f"data: [{10**400}, 0,", "too large"),
        (ROS, "[" * 5000, "not YAML"),
        (ROS, LAUGHS, "aliases"),
    ],
)
def test_a_broken_file_says_so_in_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(ROS.replace(old, new))
    with pytest.raises(ValueError, match=says) as caught:
        read_camera(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value) and "calibrate again" in str(caught.value)


def test_an_absent_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"b\.yaml: no such camera file"):
        read_camera(tmp_path / "b.yaml")
