"""The command `farside calibrate`: pictures of a board become a camera file, or one line says why not."""

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

import node.commands.frame
from calibration.boards import parse_board
from calibration.calibrate import CalibrateConfig, calibrate
from calibration.camera_file import read_camera, write_camera
from calibration.coverage import coverage
from calibration.projection import projection
from node.__main__ import main
from node.commands.calibrate import find_views
from node.commands.calibration_options import Calibrate
from node.figures.calibration_figure import draw_calibration
from perception.sources.frame import Frame
from perception.sources.oak import camera_of_device_json
from perception.sources.open_source import open_source
from perception.sources.pictures import Picture
from perception.sources.recorder import write_log
from tests.calibration.boards import CAMERAS, SIZE, photograph, poses, views
from tests.calibration.test_boards import AWAY
from tests.perception.recorded import write_device_json
from tests.perception.sources.test_recording import CAMERA, frames, maker, record

BOARD = "charuco:7x5:0.035:0.026:DICT_5X5_100"


@pytest.fixture(scope="module")
def photographs() -> list[np.ndarray]:
    board = parse_board(BOARD)
    return [
        photograph("plumb_bob", board, T) for T in poses(CAMERAS["plumb_bob"], board, 6, 40.0, 1, AWAY["plumb_bob"])
    ]


def folder_of(path: Path, images: list[np.ndarray]) -> Path:
    path.mkdir()
    for i, image in enumerate(images):
        cv2.imwrite(str(path / f"{i:02}.png"), image)
    return path


def refused(args: list[str], capsys: pytest.CaptureFixture) -> str:
    capsys.readouterr()
    assert main(["calibrate", *args]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("farside: error: "), lines
    return lines[0]


def test_a_folder_becomes_a_camera_file(
    tmp_path: Path, photographs: list[np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    source = folder_of(tmp_path / "in", [*photographs, np.full((480, 640), 128, np.uint8)])
    out = tmp_path / "new" / "left.yaml"
    assert main(["calibrate", str(source), "--out", str(out), "--name", "left"]) == 0
    said = capsys.readouterr().out
    assert "6 used, 1 without the board" in said and "next view: " in said and "±" in said
    assert "at worst" in said and "halves" in said and "bent by" in said
    camera = read_camera(out)
    for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)):
        assert abs(camera.K[i, j] - CAMERAS["plumb_bob"].K[i, j]) < 5 * camera.K_std[i, j]
    assert camera.rms < 0.3 and "camera_name: left" in out.read_text()
    assert sorted(p.name for p in out.parent.iterdir()) == ["left.yaml", "left_views.png"]


def test_a_log_without_camera_info_becomes_one(
    tmp_path: Path, photographs: list[np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    make = maker("mcap")
    messages = [
        make.image("/cam/image_raw", i + 1, image, "mono8")
        for i, image in enumerate([photographs[0]] * 2 + photographs)
    ]
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(record(tmp_path / "log", "mcap", messages)), "--out", str(out)]) == 0
    assert "6 used, 2 too alike" in capsys.readouterr().out
    assert abs(read_camera(out).K[0, 0] / 430 - 1) < 0.01


def test_what_cannot_be_calibrated_is_refused_and_writes_nothing(
    tmp_path: Path, photographs: list[np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "camera.yaml"

    def says(source: Path, *parts: str, extra: tuple[str, ...] = ()) -> None:
        line = refused([str(source), "--out", str(out), *extra], capsys)
        assert all(part in line for part in parts), line
        assert not out.exists() and not (tmp_path / "camera_views.png").exists()

    two = folder_of(tmp_path / "two", photographs[:2])
    says(two, "2 different views", "take 3 or more")
    says(two, "is in none of 2 pictures", "check --board", extra=("--board", "chessboard:8x6:0.1"))
    says(two, "'chess' is not understood", extra=("--board", "chess"))
    says(two, "--every is 0", extra=("--every", "0"))
    says(
        folder_of(tmp_path / "sizes", [photographs[0], photographs[1][:400]]), "01.png is 640x400", "00.png is 640x480"
    )
    says(tmp_path / "absent", "absent does not exist")
    assert "ends in .yaml" in refused([str(two), "--out", str(tmp_path / "camera.txt")], capsys)
    assert "give one of SOURCE" in refused([], capsys)
    assert "give one of SOURCE" in refused([str(two), "--from", str(two)], capsys)


def test_a_focal_length_that_is_not_determined_is_not_saved(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    board = parse_board(BOARD)
    flat = [photograph("plumb_bob", board, T) for T in poses(CAMERAS["plumb_bob"], board, 5, 0.5, 2, AWAY["plumb_bob"])]
    out = tmp_path / "camera.yaml"
    line = refused([str(folder_of(tmp_path / "in", flat)), "--out", str(out)], capsys)
    assert "nothing is saved: the focal length is not determined" in line and "tilt" in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in"]


@pytest.mark.parametrize("name", ["board.pdf", "board.png"])
def test_a_target_is_printed(tmp_path: Path, name: str, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / name
    assert main(["calibrate", "--print-target", str(path), "--paper", "A3", "--board", "chessboard:8x6:0.03"]) == 0
    said = capsys.readouterr().out
    assert path.stat().st_size > 500 and "A3 at 100%" in said and "--board chessboard:8x6:0.03" in said
    assert "give squares" in refused(["--print-target", str(path), "--board", "chessboard:8x6:0.2"], capsys)


def test_the_stated_camera_is_written(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "camera.yaml"
    write_log(log, frames(2))
    assert main(["calibrate", "--from", str(log), "--out", str(out)]) == 0
    camera = read_camera(out)
    stated = frames(1)[0].camera
    np.testing.assert_array_equal(camera.K, stated.K)
    np.testing.assert_array_equal(camera.distortion, stated.distortion)
    assert camera.K_std is None and camera.rms is None
    again = tmp_path / "again.yaml"
    assert main(["calibrate", "--from", str(out), "--out", str(again)]) == 0
    assert again.read_text() == out.read_text()
    make = maker("mcap")
    bare = record(tmp_path / "bare", "mcap", [make.image("/cam/image", 1, np.zeros((8, 8, 3), np.uint8), "rgb8")])
    assert "no camera_info" in refused(["--from", str(bare), "--out", str(tmp_path / "b.yaml")], capsys)


def test_help_reads(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "--help"])
    said = capsys.readouterr().out
    assert ended.value.code == 0
    for word in ("--board", "--print-target", "--from", "--model", "equidistant", "print it at 100%"):
        assert word in said


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "new" / "views.png"
    result = calibrate(views("equidistant", 5), SIZE, "equidistant")
    draw_calibration(path, result, coverage(result.views, SIZE), projection(result))
    image = cv2.imread(str(path))
    assert image.shape[0] > 800 and len(np.unique(image.reshape(-1, 3), axis=0)) > 200


def test_the_real_chessboard(tmp_path: Path, shared_data: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "camera.yaml"
    args = [str(shared_data / "chessboard_wide"), "--board", "chessboard:8x6:0.108", "--out", str(out)]
    assert main(["calibrate", *args]) == 0
    camera = read_camera(out)
    assert abs(camera.K[0, 0] / 430.3 - 1) < 0.005 and camera.rms <= 0.18
    assert "12 used" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("end", "says"),
    [
        (KeyboardInterrupt(), "stopped; going on"),
        (OSError("webcam:0 gives no more"), "webcam:0 gives no more; going on"),
    ],
)
def test_what_ends_a_stream_keeps_what_was_found(photographs: list[np.ndarray], end: BaseException, says: str) -> None:
    """Each view is taken once, however long it is held before the camera."""

    def live() -> Iterator[Picture]:
        for i in range(18):
            shaken = np.roll(photographs[i // 3], i % 3, axis=1)
            yield Picture(f"frame {i}", np.repeat(shaken[..., None], 3, axis=2))
        raise end

    err = Console(record=True, file=io.StringIO(), width=200)
    found = find_views(live(), parse_board(BOARD), err, None, Calibrate("webcam:0"), CalibrateConfig())
    said = err.export_text()
    assert [v.name for v in found.views] == [f"frame {i}" for i in range(0, 18, 3)] and found.size == SIZE
    assert found.alike == 12 and found.unseen == []
    assert said.count("corners") == 6 and said.count("; next view: ") == 1
    assert f"{says} with the 6 views so far" in said


def test_a_lost_camera_without_a_view_is_its_own_error() -> None:
    def live() -> Iterator[Picture]:
        yield Picture("frame 0", np.zeros((48, 64, 3), np.uint8))
        raise OSError("webcam:0 gives no more")

    with pytest.raises(OSError, match="webcam:0 gives no more"):
        find_views(live(), parse_board(BOARD), Console(quiet=True), None, Calibrate("webcam:0"), CalibrateConfig())


def test_a_video_becomes_a_camera_file(
    tmp_path: Path, photographs: list[np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    video = tmp_path / "board.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    for image in photographs:
        for _ in range(2):
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    out = tmp_path / "camera.yaml"
    assert main(["calibrate", str(video), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert "6 used, 6 too alike" in said.out and "view 6: frame 10, " in said.err
    assert abs(read_camera(out).K[0, 0] / 430 - 1) < 0.01


def test_a_device_s_calibration_becomes_a_camera_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    device_json, out = write_device_json(tmp_path / "device.json"), tmp_path / "camera.yaml"
    told = ["--from", str(device_json), "--out", str(out)]
    assert main(["calibrate", *told, "--socket", "CAM_B", "--size", "320", "240"]) == 0
    camera, stated = read_camera(out), camera_of_device_json(device_json, "CAM_B", 320, 240)
    np.testing.assert_allclose(camera.K, stated.K)
    np.testing.assert_allclose(camera.distortion, stated.distortion)
    assert (camera.width, camera.height, camera.model) == (320, 240, stated.model)
    assert "CAM_Q' is unknown" in refused([*told, "--socket", "CAM_Q"], capsys)


def test_replay_takes_a_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    frame = next(iter(open_source(None)))
    K_std = np.diag([5.0, 5.0, 0.0])
    cameras = {
        "right.yaml": replace(frame.camera, K_std=K_std),
        "small.yaml": CAMERA,
    }
    for name, camera in cameras.items():
        write_camera(tmp_path / name, camera)

    def reached(frame: Frame, *_: object) -> None:
        np.testing.assert_array_equal(frame.camera.K_std, K_std)
        raise ValueError("reached")

    monkeypatch.setattr(node.commands.frame, "segment", reached)
    for name, says in (
        ("right.yaml", "shipped.mcap: reached"),
        ("small.yaml", "the camera is calibrated at 64x48 px but colour is 640x480"),
    ):
        assert main(["replay", "--camera", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 1
        assert says in capsys.readouterr().err
    bare = record(tmp_path / "bare", "mcap", [maker("mcap").image("/cam/image", 1, frame.rgb, "rgb8")])
    for given, says in (
        (["--camera", str(tmp_path / "right.yaml")], f"error: {bare}: reached"),
        ([], "or give a camera file"),
    ):
        assert main(["replay", str(bare), *given, "--out", str(tmp_path / "out")]) == 1
        assert says in capsys.readouterr().err
    assert main(["replay", "--camera", str(tmp_path / "absent.yaml"), "--out", str(tmp_path / "out")]) == 1
    assert "absent.yaml: no such camera file" in capsys.readouterr().err
