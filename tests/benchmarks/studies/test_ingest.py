"""The measurement of taking frames in loses none unaccounted, and its rows are what it saw."""

import time
from itertools import pairwise
from pathlib import Path

import pytest

from benchmarks.studies import ingest
from benchmarks.studies.ingest import FPS, Options, SyntheticCamera, main, take_in


def test_the_synthetic_camera_is_30_frames_a_second_by_its_own_clock() -> None:
    camera = SyntheticCamera(0.5)
    frames = list(camera)
    assert camera.due == 15 and len(frames) + camera.missed == 15
    steps = [(b.stamp_ns - a.stamp_ns) * FPS * 1e-9 for a, b in pairwise(frames)]
    assert all(step == pytest.approx(round(step), abs=1e-3) and step > 0.5 for step in steps)
    assert frames[0].rgb.shape == (480, 640, 3) and frames[0].depth is not None
    camera.close()
    assert list(camera) == []


def test_every_frame_is_accounted_for_when_inference_is_slow(tmp_path: Path) -> None:
    taken = take_in(0.6, tmp_path / "a.mcap", lambda _: time.sleep(0.15), lambda: None)
    assert taken.recorded <= taken.counts.received and len(taken.query_s) > 0
    assert taken.counts.received + taken.missed == taken.due == 18
    assert len(taken.listener_age) == taken.counts.received and taken.counts.dropped["recording"] == 0
    assert len(taken.newest_age) + taken.counts.dropped["newest"] <= taken.counts.received
    assert 1 <= len(taken.newest_age) < taken.counts.received
    assert min(taken.newest_age + taken.listener_age) >= 0.0


def test_rows_and_a_picture_come_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "inference", lambda: (lambda _: time.sleep(0.05), lambda: None))
    summary = main(Options(tmp_path, quick=True, seconds=0.4))
    rows = {(row.condition, row.metric): row for row in summary.rows}
    for condition in ("idle", "inference"):
        lost = rows[condition, "lost"]
        assert rows[condition, "frames_due"].value == 12 == lost.n
        assert rows[condition, "recorded"].value + lost.value == 12
        assert rows[condition, "newest_age_median"].unit == "ms"
    assert summary.picture().axes
    with pytest.raises(ValueError, match="seconds is 0; give more than 0"):
        main(Options(tmp_path, seconds=0.0))
