"""A camera of Kalibr's chain is the camera that Kalibr meant, and what cannot be read is refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.camera_file import is_camera_file, read_camera, write_camera

POSE = "[[1.0, 0.0, 0.0, -0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]"
# As kalibr_calibrate_cameras writes it.
CHAIN = f"""cam0:
  cam_overlaps: [1, 2]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0009, -0.0001]
  distortion_model: radtan
  intrinsics: [461.5, 460.25, 362.5, 246.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: {POSE}
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.013, 0.05, -0.045, 1.2e-02]
  distortion_model: equidistant
  intrinsics: [458.0, 457.0, 367.0, 248.0]
  resolution: [640, 400]
  rostopic: /cam1/image_raw
cam2:
  T_cn_cnm1: {POSE}
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [300.0, 301.0, 320.0, 240.0]
  resolution: [640, 480]
"""


@pytest.fixture
def chain(tmp_path: Path) -> Path:
    path = tmp_path / "camchain.yaml"
    path.write_text(CHAIN)
    return path


@pytest.mark.parametrize(("name", "model"), [("cam0", "plumb_bob"), ("cam1", "equidistant"), ("cam2", "plumb_bob")])
def test_each_camera_projects_as_kalibr_says(chain: Path, name: str, model: str) -> None:
    said = yaml.safe_load(CHAIN)[name]
    camera = read_camera(Path(f"{chain}#{name}"))
    assert [camera.width, camera.height, camera.model] == [*said["resolution"], model]
    # Kalibr's own formulas: pinhole, then radial and tangential, or the angle's polynomial.
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 1.0], [0.3, 0.2, 2.0], (20, 3))
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x**2 + y**2
    a, b, c, d = said["distortion_coeffs"] or [0.0] * 4
    if model == "equidistant":
        theta = np.arctan(np.sqrt(r2))
        scale = theta * (1 + a * theta**2 + b * theta**4 + c * theta**6 + d * theta**8) / np.sqrt(r2)
        u, v = x * scale, y * scale
    else:
        scale = 1 + a * r2 + b * r2**2
        u = x * scale + 2 * c * x * y + d * (r2 + 2 * x**2)
        v = y * scale + 2 * d * x * y + c * (r2 + 2 * y**2)
    fu, fv, pu, pv = said["intrinsics"]
    np.testing.assert_allclose(camera.project(points), np.column_stack([fu * u + pu, fv * v + pv]), atol=1e-9)


def test_without_a_name_it_is_the_first_and_a_copy_is_the_same_camera(chain: Path) -> None:
    camera, named = read_camera(chain), read_camera(Path(f"{chain}#cam0"))
    write_camera(chain.with_name("copy.yaml"), camera)
    for again in (named, read_camera(chain.with_name("copy.yaml"))):
        assert (again.width, again.height, again.model) == (camera.width, camera.height, camera.model)
        np.testing.assert_array_equal(again.K, camera.K)
        np.testing.assert_array_equal(again.distortion, camera.distortion)
    assert is_camera_file(Path(f"{chain}#cam1")) and not is_camera_file(Path("a.mcap"))


def test_a_hash_may_be_part_of_a_files_name(chain: Path) -> None:
    path = chain.rename(chain.with_name("rig#2.yaml"))
    assert read_camera(path).width == 752 and read_camera(Path(f"{path}#cam1")).width == 640


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("#cam7", "", "", "no camera cam7; append #NAME to the file, with one of cam0, cam1, cam2"),
        ("", "cam0:", "cam3:", "no camera cam0; append #NAME to the file, with one of cam3, cam1, cam2"),
        *(("", "pinhole", kind, f"camera_model '{kind}'.* pinhole-radtan") for kind in ("omni", "eucm", "ds")),
        ("", "radtan", "fov", "distortion_model 'fov'.* pinhole-equi"),
        ("", "  distortion_model: radtan\n", "", "distortion_model 'None'"),
        ("", "[461.5, ", "[", "cam0: intrinsics is .*, not 4 finite numbers"),
        ("", "[461.5, ", "[.nan, ", "not 4 finite numbers"),
        ("", "[461.5, ", f"[{10**400}, ", "not 4 finite numbers"),
        ("", "[461.5, ", "[-461.5, ", "positive focal lengths"),
        ("", "-0.0001]", "-0.0001, 0.1]", "distortion_coeffs is .*, not 4"),
        ("", "[752, 480]", "[752.5, 480]", "resolution is"),
        ("", "[752, 480]", "[0, 480]", "camera size is 0x480"),
        ("", CHAIN, "cam0: 1", "cam0 has no keys"),
        ("#left", CHAIN, "image_width: 640", "not a chain of cameras.*omit #left"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(chain: Path, name: str, old: str, new: str, says: str) -> None:
    chain.write_text(CHAIN.replace(old, new, 1) if old else CHAIN)
    with pytest.raises(ValueError, match=says) as caught:
        read_camera(Path(f"{chain}{name}"))
    assert "\n" not in str(caught.value) and str(chain) in str(caught.value) and len(str(caught.value)) < 500
