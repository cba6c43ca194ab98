"""The frame folder comes back as written; every fault in it is one line that names the file."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.camera import Camera
from perception.source import Frame, open_source, read_frame_folder

REAL = Path(__file__).parents[2] / "../shared/data/ycbv_000002"
K = [[500.0, 0.0, 32.0], [0.0, 500.0, 24.0], [0.0, 0.0, 1.0]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / "color.png"), rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    cv2.imwrite(
        str(tmp_path / "depth.png"), rng.integers(0, 3000, (48, 64)).astype(np.uint16) * (rng.random((48, 64)) > 0.3)
    )
    cv2.imwrite(str(tmp_path / "label.png"), rng.integers(0, 4, (48, 64)).astype(np.uint8))
    (tmp_path / "meta.json").write_text(
        json.dumps({"camera_matrix_px": K, "depth_unit_m": 0.0005, "objects": "not read"})
    )
    return tmp_path


def fails(folder: Path, *says: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        open_source(folder)
    message = str(caught.value)
    assert "\n" not in message
    for part in says:
        assert part in message


def test_a_folder_reads_as_written(folder: Path) -> None:
    frames = list(open_source(folder))
    assert len(frames) == 1
    frame = frames[0]
    counts = cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(frame.rgb[..., ::-1], cv2.imread(str(folder / "color.png")))
    np.testing.assert_array_equal(np.isnan(frame.depth), counts == 0)
    np.testing.assert_allclose(frame.depth[counts > 0], counts[counts > 0] * 0.0005, rtol=1e-6)
    np.testing.assert_array_equal(frame.label, cv2.imread(str(folder / "label.png"), cv2.IMREAD_UNCHANGED))
    np.testing.assert_array_equal(frame.camera.K, K)
    assert frame.rgb.dtype == np.uint8 and frame.depth.dtype == np.float32 and frame.label.dtype == np.int32


def test_the_label_is_optional(folder: Path) -> None:
    (folder / "label.png").unlink()
    assert read_frame_folder(folder).label is None


@pytest.mark.parametrize("name", ["color.png", "depth.png", "meta.json"])
def test_a_missing_file_is_named(folder: Path, name: str) -> None:
    (folder / name).unlink()
    fails(folder, name, "missing")


@pytest.mark.parametrize("name", ["color.png", "depth.png", "label.png"])
@pytest.mark.parametrize("keep", [0.5, 0.99])
def test_a_truncated_png_is_named(folder: Path, name: str, keep: float) -> None:
    data = (folder / name).read_bytes()
    size = int(len(data) * keep)
    (folder / name).write_bytes(data[:size])
    fails(folder, name, f"cut short at byte {size}")


def test_a_damaged_png_is_named(folder: Path) -> None:
    data = bytearray((folder / "color.png").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (folder / "color.png").write_bytes(data)
    fails(folder, "color.png", "damaged")
    (folder / "color.png").write_bytes(b"GIF89a")
    fails(folder, "color.png", "not a PNG")


def test_sizes_that_differ_are_named(folder: Path) -> None:
    cv2.imwrite(str(folder / "depth.png"), np.ones((24, 32), np.uint16))
    fails(folder, "depth.png", "32x24", "64x48", "align")


def test_eight_bit_depth_is_refused(folder: Path) -> None:
    cv2.imwrite(str(folder / "depth.png"), np.ones((48, 64), np.uint8))
    fails(folder, "depth.png", "16 bits")


@pytest.mark.parametrize(
    ("meta", "says"),
    [
        ({"depth_unit_m": 0.001}, "camera_matrix_px"),
        ({"camera_matrix_px": K}, "depth_unit_m"),
        ({"camera_matrix_px": K, "depth_unit_m": 0}, "depth_unit_m"),
        ({"camera_matrix_px": K, "depth_unit_m": "mm"}, "'mm'"),
        ({"camera_matrix_px": [[1, 2], [3]], "depth_unit_m": 0.001}, "camera_matrix_px"),
        ({"camera_matrix_px": [[float("nan")] * 3] * 3, "depth_unit_m": 0.001}, "finite"),
        ([], "camera_matrix_px"),
    ],
)
def test_a_wrong_meta_is_named(folder: Path, meta: object, says: str) -> None:
    (folder / "meta.json").write_text(json.dumps(meta))
    fails(folder, "meta.json", says)


def test_meta_that_is_not_json_is_named(folder: Path) -> None:
    (folder / "meta.json").write_text("{")
    fails(folder, "meta.json", "not JSON")


def test_no_such_path_is_named(folder: Path) -> None:
    shutil.rmtree(folder)
    fails(folder, str(folder), "does not exist")


def test_a_frame_refuses_planes_of_other_sizes() -> None:
    camera = Camera(64, 48, np.array(K), np.zeros(5))
    rgb = np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(ValueError, match="depth is 32x24 px but colour is 64x48"):
        Frame(0, "c", rgb, np.ones((24, 32), np.float32), None, camera)
    with pytest.raises(ValueError, match="calibrated at 64x48"):
        Frame(0, "c", np.zeros((24, 32, 3), np.uint8), None, None, camera)
    depth = np.array([0.0, -1.0, np.inf, np.nan, 1.5], np.float32).repeat(64 * 48 // 5 + 1)[: 64 * 48].reshape(48, 64)
    frame = Frame(0, "c", rgb, depth, None, camera)
    assert set(frame.depth[np.isfinite(frame.depth)]) == {1.5}


@pytest.mark.skipif(not REAL.exists(), reason="../shared/data/ycbv_000002 is not beside this checkout")
def test_the_real_frame_reads() -> None:
    frame = read_frame_folder(REAL)
    assert frame.rgb.shape == (480, 640, 3)
    assert set(np.unique(frame.label)) == {0, 1, 3, 9, 11}
    assert 0.6 < np.nanmedian(frame.depth[frame.label == 1]) < 1.0
