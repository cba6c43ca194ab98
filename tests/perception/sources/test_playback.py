"""A part of a recording, at its pace or faster, and a clear word where there is none."""

import time
from pathlib import Path

import pytest

from perception.sources.frame import Frame, StillSource
from perception.sources.playback import Playback, open_playback
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from tests.node.mugs import write_folder
from tests.perception.sources.test_recorder import START, frame

STEP = 33_333_333


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """31 frames at 30 Hz: one second."""
    path = tmp_path_factory.mktemp("log") / "second.mcap"
    with Recorder(path, wait=True) as recorder:
        for i in range(31):
            recorder.write_frame(frame(i))
    return Log(path)


def numbers(frames: list[Frame]) -> list[int]:
    return [(f.stamp_ns - START) // STEP for f in frames]


@pytest.mark.parametrize(
    ("start_s", "end_s", "first", "last"),
    [(0.0, None, 0, 30), (0.5, None, 16, 30), (0.0, 0.0, 0, 0), (0.033333333, 0.1, 1, 3), (0.9, 77.0, 28, 30)],
)
def test_a_range_holds_its_ends(log: Log, start_s: float, end_s: float | None, first: int, last: int) -> None:
    playback = Playback(log, 0.0, start_s, end_s)
    assert numbers(list(playback)) == numbers(list(playback)) == list(range(first, last + 1))
    assert playback.notes == []


def test_it_keeps_the_pace(log: Log) -> None:
    begun = time.monotonic()
    at = [time.monotonic() - begun for _ in Playback(log, 2.0, 0.5, 0.8)]
    ideal = [(i - 16) * STEP / 1e9 / 2.0 for i in range(16, 25)]
    assert len(at) == 9 and all(a >= i for a, i in zip(at, ideal, strict=True))  # never early


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ((0.0, 3.0, None), "second.mcap has no frame from 3 s on; it runs from 0 to 1.000 s"),
        ((0.0, 0.01, 0.02), "has no frame from 0.01 s to 0.02 s; it runs from 0 to 1.000 s"),
        ((0.0, -1.0, None), "from -1 s on is not a range"),
        ((0.0, 0.5, 0.2), "from 0.5 s to 0.2 s is not a range"),
        ((0.0, float("nan"), None), "from nan s on is not a range"),
        ((-1.0, 0.0, None), "pace is -1; give 1 for the recording's own"),
        ((float("inf"), 0.0, None), "pace is inf"),
    ],
)
def test_what_is_no_range_is_named(log: Log, given: tuple, says: str) -> None:
    with pytest.raises(ValueError) as caught:
        list(Playback(log, *given))
    assert says in str(caught.value) and "\n" not in str(caught.value) and log.path.name in str(caught.value)


def test_only_a_recording_has_a_range(log: Log, tmp_path: Path) -> None:
    assert numbers(list(open_playback(log.path, end_s=0.1))) == [0, 1, 2, 3]
    folder = write_folder(tmp_path / "table", frame(0))
    assert isinstance(open_playback(folder), StillSource)
    with pytest.raises(ValueError, match="table is no recording; omit --from and --to"):
        open_playback(folder, start_s=1.0)
