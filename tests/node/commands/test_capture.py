"""`farside capture`, with a controller behind a pseudo-terminal and a camera that sees the plate where it turned to."""

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import node.commands.capture
from node.__main__ import main
from node.commands.capture import FreshFrames
from perception.sources.frame import Frame
from probnerf.training.srn_dataset import read_instance, read_views
from tests.calibration.grbl import Grbl
from tests.perception.turning import BOARD, HIGH, LOW, Turning

TEXT = "charuco:7x7:0.03:0.022:DICT_4X4_50"


class Watching:
    """A live source: a frame shows the plate at the controller's angle now. `stop_after` frames it is interrupted."""

    def __init__(self, scene: Turning, angle: Callable[[], float], stop_after: int = 1000, end_after: int = 1000):
        self.scene, self.angle, self.stop_after, self.end_after = scene, angle, stop_after, end_after
        self.notes: list[str] = []
        self.count = 0

    def __iter__(self) -> Iterator[Frame]:
        while self.count < self.end_after:
            if self.count >= self.stop_after:
                raise KeyboardInterrupt
            self.count += 1
            yield self.scene.frame(self.angle(), time.monotonic_ns())


def plain(text: str) -> str:
    """Without the table's frame and line breaks."""
    return " ".join(text.replace("│", " ").split())


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    def start(grbl: Grbl, *more: str, scene: Turning | None = None, views: int = 6, **limits: int) -> int:
        source = Watching(scene or Turning(), lambda: grbl.angle - grbl.wco, **limits)
        monkeypatch.setattr(node.commands.capture, "open_source", lambda name: source)
        common = ["--out", str(tmp_path / "set"), "--instance", "block", "--views", str(views), "--settle", "0"]
        return main(["capture", "--source", "fake", "--port", grbl.port, "--speed", "3000", *common, *more])

    return start


def test_a_turn_becomes_a_data_set(run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scene = Turning()
    with Grbl(wco=40.0) as grbl:
        assert run(grbl, scene=scene) == 0
        moves = [line for line in grbl.received if "G1" in line]
    assert [float(line.split("G1X")[1].split("F")[0]) for line in moves] == [0, 60, 120, 180, 240, 300]
    found = read_instance(tmp_path / "set" / "block")
    for index, T in enumerate(found.T_world_camera):
        error = np.linalg.inv(scene.T_plate_camera(60.0 * index)) @ T
        assert np.linalg.norm(error[:3, 3]) < 0.006
    assert found.rgb.shape == (6, 360, 360, 3) and (found.focal, found.centre) == (498.0, (180.0, 180.0))
    assert found.scale == pytest.approx(2 * HIGH[2] / 1.4, rel=0.05)
    np.testing.assert_allclose(found.barycentre[:2], 0.5 * (LOW + HIGH)[:2], atol=0.003)
    views = read_views(tmp_path / "set", 32)  # as training takes them: the block's base stands on z = -0.75
    assert views.rgb.shape == (1, 6, 32, 32, 3) and 0.05 < (views.range < 0).mean() < 0.5
    red, green, blue = (np.abs(views.rgb[0].astype(int) - paint).sum(-1) < 60 for paint in
                        ([170, 34, 34], [34, 136, 51], [34, 51, 170]))  # fmt: skip
    assert blue.any(axis=(1, 2)).all() and (red | green).any(axis=(1, 2)).all()
    said = plain(capsys.readouterr().out)
    assert "6 of 6" in said and "counter-clockwise from above" in said
    assert "mm from the board's centre" in said and "degrees from the commanded turns" in said
    sides = re.search(r"(\d+) x (\d+) x (\d+) mm", said)
    assert sides is not None
    np.testing.assert_allclose([int(n) for n in sides.groups()], 1000 * (HIGH - LOW), atol=5)


def test_a_stopped_capture_keeps_its_views_and_goes_on(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "set" / "block"
    with Grbl() as grbl:
        assert run(grbl, views=4, stop_after=3) == 130  # one frame to begin with, then two views
    assert "2 of 4" in (said := capsys.readouterr().out) and "the same command continues" in said
    kept = {path: path.read_bytes() for path in folder.glob("*/*")}
    assert len(read_instance(folder).mask) == 2
    (folder / "rgb" / "000002.png").write_bytes(b"killed while writing")  # and no pose
    with Grbl() as grbl:
        assert run(grbl, views=4) == 0
        assert sum("G1" in line for line in grbl.received) == 2
    assert all(path.read_bytes() == data for path, data in kept.items())
    assert len(read_instance(folder).mask) == 4
    with Grbl() as grbl:
        assert run(grbl, views=4) == 0 and not grbl.received  # all there: the table is left alone
        assert run(grbl, views=5) == 1
        assert "was captured with --views 4, not 5; give the same" in capsys.readouterr().err
        assert run(grbl, "--board", "charuco:5x7:0.03:0.022:DICT_4X4_50", views=4) == 1
        assert "was captured with --board charuco:7x7" in capsys.readouterr().err


def test_a_view_without_its_board_is_taken_again_or_skipped(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    with Grbl() as grbl:
        assert run(grbl, views=3, scene=Turning(hidden=frozenset({120}))) == 0
    out, err = capsys.readouterr()
    assert "view 1 at 120.0 degrees is skipped: fewer than 8 corners of the board were found" in plain(err)
    assert "2 of 3, skipped [1]" in plain(out)
    with Grbl() as grbl:  # the hand is gone
        assert run(grbl, views=3) == 0
    assert len(read_instance(tmp_path / "set" / "block").mask) == 3
    with Grbl() as grbl:
        assert (
            run(grbl, "--instance", "none", "--retakes", "0", views=2, scene=Turning(hidden=frozenset({0, 180}))) == 1
        )
    assert "the board was seen in none of 2 views; check --board" in capsys.readouterr().err
    assert not (tmp_path / "set" / "none").exists()
    with Grbl() as grbl:
        assert run(grbl, "--instance", "bare", "--retakes", "0", views=2, scene=Turning(block=False)) == 1
    assert "no object was found on the plate" in plain(capsys.readouterr().err)


def test_without_depth_the_white_surroundings_tell(run: Callable[..., int], tmp_path: Path) -> None:
    with Grbl() as grbl:
        assert run(grbl, views=4, scene=Turning(depth=False)) == 0
    found = read_instance(tmp_path / "set" / "block")
    assert 2 * HIGH[2] / 1.4 * 0.9 < found.scale < 2 * (HIGH[2] + 0.03) / 1.4
    assert json.loads((tmp_path / "set" / "block" / "capture.json").read_text())["low"] == []


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"alarm_on": "G21G90G94G1X180", "alarm": 1}, "ALARM:1, Hard limit has been triggered"),
        ({"hang_up_on": "G21G90G94G1X180"}, "is gone"),
    ],
)
def test_a_fault_midway_keeps_what_was_taken(
    faults: dict, said: str, run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    with Grbl(**faults) as grbl:
        assert run(grbl, views=2) == 1
    out, err = capsys.readouterr()
    assert said in err and err.startswith("farside: error: turntable on") and err.count("\n") == 1
    assert "1 of 2" in out and len(read_instance(tmp_path / "set" / "block").mask) == 1


def test_what_is_missing_or_wrong_is_one_line(
    run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def error(*args: str) -> str:
        assert main(["capture", "--out", str(tmp_path), *args]) == 1
        said = capsys.readouterr().err
        assert said.startswith("farside: error: ") and said.count("\n") == 1
        return said

    assert "no --source was given" in error()
    assert "no serial port was named; " in error("--source", "x")
    assert "/dev/ttyNOT: no such serial port; " in error("--source", "x", "--port", "/dev/ttyNOT")
    for board, says in (("charuco:7x7:0.03:0.02:DICT_1X1", "names no dictionary"), ("chessboard:7x7:0.03", "two ways")):
        assert says in error("--source", "x", "--port", "p", "--board", board)
    assert "--views is 0" in error("--views", "0")
    assert "--background no.png does not exist" in error("--source", "x", "--port", "p", "--background", "no.png")
    assert "'../x' is no folder name" in error("--instance", "../x")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    assert "holds files that are no capture's" in error("--instance", "mine")
    (tmp_path / "mine" / "capture.json").write_text("{")
    assert "capture.json is damaged" in error("--instance", "mine")
    with Grbl() as grbl:
        assert run(grbl, views=2, end_after=1) == 1
    assert "the source has no more frames" in capsys.readouterr().err
    assert TEXT == str(BOARD)


def test_frames_that_waited_are_passed_over() -> None:
    """Frames come late, by clocks that do not agree: none taken shows the time before it was asked for."""
    now = [5_000]

    class Queue:
        def __init__(self) -> None:
            self.notes: list[str] = []

        def __iter__(self) -> Iterator[Frame]:
            blank = Turning(block=False).frame(0.0)
            for stamp in range(1_000_000, 1_000_000 + 40_000, 10):
                yield Frame(blank.rgb, None, blank.camera, stamp_ns=stamp, frame_id="c")

    frames = FreshFrames(Queue(), clock=lambda: now[0])
    now[0] += 2_000
    assert frames.take().stamp_ns == 1_002_000
    assert frames.take().stamp_ns == 1_002_010
    now[0] += 30_000
    with pytest.raises(ValueError, match="do not get newer: 2000 were older than the turn"):
        frames.take()
