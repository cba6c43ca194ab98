"""The frame folder comes back as written; every fault in it is one line that names the file."""

import json
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder, write_frame_folder
from perception.sources.image_files import read_png
from perception.sources.open_source import open_source

REAL = Path(__file__).parents[3] / "../shared/data/ycbv_000002"
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


def test_a_folder_that_knows_of_no_depth_is_a_frame_without(folder: Path) -> None:
    (folder / "depth.png").unlink()
    (folder / "meta.json").write_text(json.dumps({"camera_matrix_px": K}))
    frame = read_frame_folder(folder)
    assert frame.depth is None and frame.label is not None and frame.rgb.shape == (48, 64, 3)


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


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"width": 30_000, "height": 30_000}, "30000x30000"),
        ({"height": 480}, "pixels end after"),
    ],
)
def test_a_png_that_says_more_than_it_holds_is_named(
    folder: Path, capfd: pytest.CaptureFixture, change: dict, says: str
) -> None:
    data = bytearray((folder / "color.png").read_bytes())
    for name, size in change.items():
        at = {"width": 16, "height": 20}[name]
        data[at : at + 4] = size.to_bytes(4, "big")
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    (folder / "color.png").write_bytes(data)
    fails(folder, "color.png", says)
    assert capfd.readouterr().err == ""  # OpenCV's readers print


def test_every_kind_of_png_is_read(folder: Path) -> None:
    rng = np.random.default_rng(1)
    for channels, dtype in ((1, np.uint8), (3, np.uint8), (4, np.uint8), (1, np.uint16), (3, np.uint16)):
        image = rng.integers(0, np.iinfo(dtype).max, (7, 5, channels)).astype(dtype)
        cv2.imwrite(str(folder / "any.png"), image)
        np.testing.assert_array_equal(read_png(folder / "any.png").reshape(image.shape), image)
    cv2.imwrite(str(folder / "any.png"), rng.integers(0, 2, (7, 5), dtype=np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert read_png(folder / "any.png").shape[:2] == (7, 5)


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
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "distortion": 0.1}, "distortion is 0.1"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "distortion": [0.1]}, "4 or 5 finite numbers wanted"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "distortion": ["k", 0, 0, 0]}, "not 4 finite numbers"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "distortion_model": "barrel"}, "'barrel' is unknown"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "stamp_ns": "now"}, "stamp_ns is 'now'"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "stamp_ns": -1}, "stamp_ns is -1"),
        ({"camera_matrix_px": [[10**400, 0, 0], *K[1:]], "depth_unit_m": 0.001}, "finite"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "frame_id": None}, "frame_id is None"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "T_world_camera": K}, "4 rows of 4 finite numbers"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "camera_matrix_std_px": 2.0}, "3 rows of 3 finite numbers"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "distortion_std": [0.1]}, "not 5 finite numbers"),
        ({"camera_matrix_px": K, "depth_unit_m": 0.001, "rms_px": "good"}, "rms_px 'good' is not a finite number"),
        (
            {"camera_matrix_px": K, "depth_unit_m": 0.001, "T_world_camera": [[0, 0, 0, 1]] * 3 + [[1, 2, 3, 1]]},
            "transp",
        ),
        (
            {"camera_matrix_px": K, "depth_unit_m": 0.001, "T_world_camera": np.diag([1, 2, 1, 1]).tolist()},
            "no rotation",
        ),
    ],
)
def test_a_wrong_meta_is_named(folder: Path, meta: object, says: str) -> None:
    (folder / "meta.json").write_text(json.dumps(meta))
    fails(folder, "meta.json", says)


def test_meta_that_is_not_json_is_named(folder: Path) -> None:
    (folder / "meta.json").write_text("{")
    fails(folder, "meta.json", "not JSON")


@pytest.mark.parametrize("known", [False, True])
def test_a_frame_comes_back_as_it_was_written(tmp_path: Path, known: bool) -> None:
    """Depth in whole tenths of a millimetre, and all else, exactly; other depth to half of a tenth."""
    rng = np.random.default_rng(1)
    counts = rng.integers(0, 65536, (48, 64)) * (rng.random((48, 64)) > 0.3)
    T = np.eye(4)
    T[:3, 3] = rng.normal(size=3)
    lens = rng.normal(size=8) / 3
    frame = Frame(
        stamp_ns=1_790_000_000_123_456_789 if known else 0,
        frame_id="left" if known else "camera",
        rgb=rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        depth=(counts * 1e-4).astype(np.float32),
        label=rng.integers(0, 300, (48, 64)) if known else None,
        camera=Camera(64, 48, np.array(K) / 3 + np.diag([0, 0, 2 / 3]), lens, "rational_polynomial")
        if known
        else Camera(64, 48, np.array(K), np.zeros(5)),
        T_world_camera=T if known else None,
    )
    (tmp_path / "label.png").write_bytes(b"of an earlier frame")
    write_frame_folder(tmp_path, frame)
    back = read_frame_folder(tmp_path)
    for name in ("stamp_ns", "frame_id", "rgb", "depth", "label", "T_world_camera"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frame, name), err_msg=name)
    for name in ("width", "height", "K", "distortion", "model"):
        np.testing.assert_array_equal(getattr(back.camera, name), getattr(frame.camera, name), err_msg=name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["color.png", "depth.png"] + ["label.png"] * known + [
        "meta.json"
    ]
    odd = replace(frame, depth=rng.uniform(0.3, 6.0, (48, 64)).astype(np.float32))
    write_frame_folder(tmp_path, odd)
    np.testing.assert_allclose(read_frame_folder(tmp_path).depth, odd.depth, rtol=0, atol=0.51e-4)


def test_far_depth_is_kept_far(tmp_path: Path) -> None:
    depth = np.full((48, 64), 20.0, np.float32)
    depth[0, 0] = 100.0
    frame = Frame(np.zeros((48, 64, 3), np.uint8), depth, Camera(64, 48, np.array(K), np.zeros(5)))
    write_frame_folder(tmp_path, frame)
    back = read_frame_folder(tmp_path).depth
    assert back[0, 0] == pytest.approx(65.534) and (back.ravel()[1:] == np.float32(20.0)).all()


def test_what_a_folder_cannot_hold_is_refused(tmp_path: Path) -> None:
    camera = Camera(64, 48, np.array(K), np.zeros(5))
    frame = Frame(np.zeros((48, 64, 3), np.uint8), None, camera, stamp_ns=7, frame_id="c")
    write_frame_folder(tmp_path / "without", frame)
    back = read_frame_folder(tmp_path / "without")
    assert back.depth is None and back.stamp_ns == 7
    many = replace(frame, depth=np.ones((48, 64), np.float32), label=np.full((48, 64), 70_000))
    with pytest.raises(ValueError, match="object id 70000 does not fit"):
        write_frame_folder(tmp_path / "new", many)
    assert not (tmp_path / "new").exists()


def test_no_such_path_is_named(folder: Path) -> None:
    shutil.rmtree(folder)
    fails(folder, str(folder), "does not exist")


def test_a_frame_refuses_planes_of_other_sizes() -> None:
    camera = Camera(64, 48, np.array(K), np.zeros(5))
    rgb = np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(ValueError, match="depth is 32x24 px but colour is 64x48"):
        Frame(rgb, np.ones((24, 32), np.float32), camera, frame_id="c")
    with pytest.raises(ValueError, match="calibrated at 64x48"):
        Frame(np.zeros((24, 32, 3), np.uint8), None, camera, frame_id="c")
    depth = np.array([0.0, -1.0, np.inf, np.nan, 1.5], np.float32).repeat(64 * 48 // 5 + 1)[: 64 * 48].reshape(48, 64)
    frame = Frame(rgb, depth, camera, frame_id="c")
    assert set(frame.depth[np.isfinite(frame.depth)]) == {1.5}


@pytest.mark.skipif(not REAL.exists(), reason="../shared/data/ycbv_000002 is not beside this checkout")
def test_the_real_frame_reads() -> None:
    frame = read_frame_folder(REAL)
    assert frame.rgb.shape == (480, 640, 3)
    assert set(np.unique(frame.label)) == {0, 1, 3, 9, 11}
    assert 0.6 < np.nanmedian(frame.depth[frame.label == 1]) < 1.0


def test_what_no_source_is_gets_the_list_of_sources(folder: Path) -> None:
    fails(Path("realsense:0"), "realsense:0 does not exist", "oak, oak:ID, webcam:N, a video file", ".mcap")


def test_a_given_calibration_takes_the_place_of_the_recorded_one(folder: Path) -> None:
    given = Camera(64, 48, np.array(K), np.ones(5))
    assert next(iter(open_source(folder, given))).camera is given
    for path in (folder, None):
        with pytest.raises(ValueError, match="the camera is calibrated at 32x48 px but colour is"):
            next(iter(open_source(path, Camera(32, 48, np.array(K), np.zeros(5)))))


def test_what_is_recorded_is_not_live(folder: Path) -> None:
    for source in (open_source(folder), open_source(None)):
        assert not source.live
        source.close()  # and may be closed nevertheless


def test_a_name_of_half_letters_is_refused(folder: Path) -> None:
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"frame_id": "\udcff"}))
    fails(folder, "meta.json", "frame_id is '\\udcff'")
