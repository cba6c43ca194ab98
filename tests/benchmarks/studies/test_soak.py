"""The soak: its rounds are summed and kept, a lost frame is no success, and a round of the real path loses nothing."""

import time
from pathlib import Path

import pytest

from benchmarks.harness import study
from benchmarks.studies import soak


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """What each pretended round of 50 ms counts."""
    found = {"acknowledged": 100, "read": 98, "lost": 0, "asked": 7, "unanswered": 0}

    def pretended(path: Path, how: str, seconds: float, seed: int) -> tuple[dict[str, int], float | None]:
        time.sleep(0.05)
        return found, None if how == "killed" else 0.25

    monkeypatch.setattr(soak, "one_round", pretended)
    return found


def test_rounds_are_summed_and_kept(tmp_path: Path, counts: dict[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "FOLDER", tmp_path)
    options = soak.Options(tmp_path, keep=True, minutes=0.12 / 60)
    summary = soak.main(options)
    value = {(row.method, row.metric): row.value for row in summary.rows}
    rounds = sum(v for (_, metric), v in value.items() if metric == "rounds")
    assert rounds >= 1 and value["all rounds", "acknowledged"] == 100 * rounds
    assert value["all rounds", "asked"] == 7 * rounds and value["orderly", "memory_slope"] == 0.25
    study.report("soak", summary, options)
    kept = study.kept_tables("soak")
    assert kept is not None
    (table,) = kept[2]
    assert len(table.lines) == len(summary.rows)


def test_a_lost_frame_is_an_error(tmp_path: Path, counts: dict[str, int]) -> None:
    counts["lost"] = 2
    with pytest.raises(ValueError, match="2 recorded frames are lost and 0 questions unanswered"):
        soak.main(soak.Options(tmp_path, minutes=0.04 / 60))


@pytest.mark.slow
def test_a_round_of_ten_seconds_loses_nothing(tmp_path: Path) -> None:
    found, slope = soak.one_round(tmp_path / "soak.mcap", "orderly", 10.0, 0)
    assert found["acknowledged"] > 50 and found["asked"] > 2 and slope is not None
    assert found["lost"] == 0 and found.get("unanswered", 0) == 0
