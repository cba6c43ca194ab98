"""Frames as people have them: JPEG, .npy and .npz, depth of another camera, label maps of segmenters."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder, write_frame_folder
from perception.sources.label_map import read_label_map
from perception.sources.open_source import open_source
from perception.sources.registration import registered
from tests.perception.cylinders import CAMERA, CAN, Cylinder, looking_down, picture


@pytest.fixture(scope="module")
def frame() -> Frame:
    return picture(CAN, Cylinder(0.14, 0.05, 0.03, 0.08))


@pytest.fixture
def folder(tmp_path: Path, frame: Frame) -> Path:
    write_frame_folder(tmp_path / "table", frame)
    return tmp_path / "table"


def arrays(frame: Frame) -> dict[str, np.ndarray]:
    return {"rgb": frame.rgb, "depth": frame.depth, "K": frame.camera.K, "segmap": frame.label}


def test_colour_may_be_jpeg(folder: Path, frame: Frame) -> None:
    (folder / "color.png").unlink()
    data = cv2.imencode(".jpg", frame.rgb[..., ::-1])[1].tobytes()
    (folder / "rgb.jpg").write_bytes(data)
    assert np.abs(read_frame_folder(folder).rgb.astype(int) - frame.rgb).mean() < 4
    (folder / "rgb.jpg").write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=r"rgb\.jpg .* is cut short"):
        read_frame_folder(folder)


@pytest.mark.parametrize("kind", ["metres", "counts"])
def test_depth_may_be_an_array(folder: Path, frame: Frame, kind: str) -> None:
    (folder / "depth.png").unlink()
    values = frame.depth if kind == "metres" else np.nan_to_num(frame.depth / 1e-4).astype(np.uint16)
    np.save(folder / "depth.npy", values)
    np.testing.assert_allclose(read_frame_folder(folder).depth, frame.depth, atol=2e-4)


def test_a_frame_folder_written_over_another_leaves_none_of_it(folder: Path, frame: Frame) -> None:
    np.save(folder / "depth.npy", np.ones_like(frame.depth))
    np.save(folder / "label.npy", np.ones_like(frame.label))
    write_frame_folder(folder, frame)
    np.testing.assert_allclose(read_frame_folder(folder).depth, frame.depth, atol=2e-4)


def test_a_frame_in_one_file(tmp_path: Path, frame: Frame) -> None:
    np.savez(tmp_path / "a.npz", **arrays(frame), T_world_camera=looking_down())
    (read,) = open_source(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.rgb, frame.rgb)
    np.testing.assert_array_equal(read.depth, frame.depth)
    np.testing.assert_array_equal(read.label, frame.label)
    np.testing.assert_array_equal(read.camera.K, frame.camera.K)
    np.testing.assert_array_equal(read.T_world_camera, looking_down())


def test_a_frame_in_one_file_with_other_names_and_units(tmp_path: Path, frame: Frame) -> None:
    millimetres = np.nan_to_num(1e3 * frame.depth).astype(np.uint16)
    np.savez(tmp_path / "b.npz", color=frame.rgb / 255.0, Depth=millimetres[..., None], intrinsics=frame.camera.K)
    (read,) = open_source(tmp_path / "b.npz")
    np.testing.assert_array_equal(read.rgb, frame.rgb)
    np.testing.assert_allclose(read.depth, frame.depth, atol=1.1e-3)
    assert read.label is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rgb": None}, "has no array rgb"),
        ({"K": None}, "has no array K"),
        ({"K": np.eye(4)}, "K is [4, 4]"),
        ({"segmap": np.zeros((5, 5))}, "the label map is 5x5"),
        ({"segmap": np.full((240, 320), 0.5)}, "values that are no ids"),
        ({"depth": np.full((240, 320), 800.0)}, "give metres"),
        ({"rgb": np.array(["a"])}, "holds <U1; save numbers"),
    ],
)
def test_a_bad_frame_in_one_file_is_named(tmp_path: Path, frame: Frame, change: dict, says: str) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **{k: v for k, v in {**arrays(frame), **change}.items() if v is not None})
    with pytest.raises(ValueError, match=r"bad\.npz") as caught:
        open_source(path)
    assert says in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no", "cut"])
def test_a_broken_file_is_named(tmp_path: Path, frame: Frame, content: bytes | str) -> None:
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, **arrays(frame))
    path.write_bytes(path.read_bytes()[:-300] if content == "cut" else content)
    with pytest.raises(ValueError, match=r"bad\.npz is not a whole \.npz file"):
        open_source(path)


def test_an_array_that_unpacks_to_far_more_than_a_frame_is_refused(tmp_path: Path, frame: Frame) -> None:
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, **{**arrays(frame), "depth": np.zeros((9000, 9000))})
    assert path.stat().st_size < 2_000_000
    with pytest.raises(ValueError, match=r"depth\.npy unpacks to \d+ MB"):
        open_source(path)


@pytest.mark.parametrize("kind", ["ids.png", "ids.npy", "masks.npy", "masks.npz"])
def test_label_maps_of_segmenters(tmp_path: Path, frame: Frame, kind: str) -> None:
    path = tmp_path / kind
    masks = np.stack([frame.label == 1, frame.label == 2])
    if path.suffix == ".png":
        cv2.imwrite(str(path), frame.label.astype(np.uint8))
    elif path.suffix == ".npz":
        np.savez(path, masks=masks)
    else:
        np.save(path, frame.label if "ids" in kind else masks)
    np.testing.assert_array_equal(read_label_map(path, (240, 320)), frame.label)


def test_depth_of_another_camera_comes_to_the_colours_pixels(frame: Frame) -> None:
    """A depth camera of half the size, 5 cm beside: what it measures is what the colour camera would have."""
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.05
    small = Camera(160, 120, CAMERA.K * [[0.5], [0.5], [1.0]], np.zeros(5))
    T = looking_down()
    things = CAN, Cylinder(0.14, 0.05, 0.03, 0.08)
    beside = picture(*things, T=T @ T_color_depth, camera=small, noise=0.0)
    exact = picture(*things, T=T, noise=0.0)
    found = registered(beside.depth, small, CAMERA, T_color_depth)
    both = np.isfinite(found) & np.isfinite(exact.depth)
    inside = np.zeros_like(both)
    inside[20:-20, 30:-30] = True
    assert both[inside].mean() > 0.9
    error = np.abs(found - exact.depth)[both & inside]
    assert np.median(error) < 0.003 and np.percentile(error, 90) < 0.02


def test_depth_of_another_size_needs_its_camera(folder: Path, frame: Frame) -> None:
    small = frame.depth[::2, ::2]
    (folder / "depth.png").unlink()
    np.save(folder / "depth.npy", small)
    with pytest.raises(ValueError, match="depth_camera_matrix_px"):
        read_frame_folder(folder)
    meta = json.loads((folder / "meta.json").read_text())
    meta["depth_camera_matrix_px"] = (frame.camera.K * [[0.5], [0.5], [1.0]]).tolist()
    (folder / "meta.json").write_text(json.dumps(meta))
    found = read_frame_folder(folder).depth
    close = np.abs(found - frame.depth)[100:200, 100:200]
    assert found.shape == frame.depth.shape and np.nanmedian(close) < 0.004
