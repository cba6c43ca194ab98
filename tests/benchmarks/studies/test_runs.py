"""Further runs: what a file of rows is summed up to, and how a measurement goes on."""

from pathlib import Path

import pytest

from benchmarks.harness.intervals import Figures
from benchmarks.harness.results import read_lines
from benchmarks.scenes.strangers import GSO
from benchmarks.studies.runs import COUNTS, Options, main, method_of, summary

Losses = tuple[float | None, ...]


def lines(name: str, seed: int, scores: tuple[float, ...], losses: Losses, explained: float) -> list[dict]:
    same = {"prior": "p", "settings": {}, "revision": "r", "machine": "m", "condition": GSO, "object": name}
    told = zip(COUNTS, scores, losses, strict=False)
    return [
        {**same, "seed": seed, "method": method_of(number), "balanced": score, "expected_loss": loss,
         "explained": explained, "seconds": 5.0 * number}
        for number, score, loss in told
    ]  # fmt: skip


def test_runs_are_paired_with_the_first() -> None:
    rows = lines("a", 0, (0.5, 0.4, 0.4, 0.4), (0.004,) * 4, 0.95)
    rows += lines("a", 1, (0.3, 0.4, 0.4, 0.2), (0.008, 0.006, 0.004, 0.003), 0.95)
    rows += lines("b", 0, (0.6, 0.6, 0.6, 0.6), (0.001,) * 4, 0.8)
    rows += lines("cut", 0, (0.9,), (0.001,), 0.95)  # not whole: not counted
    rows.append(
        {k: v for k, v in rows[0].items() if k not in ("balanced", "seconds")} | {"object": "c", "refused": "x"}
    )
    found = summary(rows, Options())
    of = Figures(found.rows)
    assert of(GSO, "1 run", "balanced") == pytest.approx(0.5) and of.count(GSO, "1 run", "balanced") == 2
    assert of(GSO, "4 runs", "above_one") == pytest.approx((0.3 - 0.4) / 2)
    assert of(GSO, "1 run", "spread") == pytest.approx(0.2) and of(GSO, "2 runs", "spread") == pytest.approx(0.0)
    assert of(GSO, "3 runs", "seconds") == pytest.approx(15.0)
    assert len(found.tables[0].lines) == 4 and found.picture().axes and summary([], Options()) is None


def test_a_loss_that_is_not_known_is_left_out() -> None:
    rows = lines("a", 0, (0.5, 0.4, 0.4, 0.4), (None, 0.001, 0.001, 0.001), 0.95)
    rows += lines("b", 0, (0.5, 0.4, 0.4, 0.4), (0.002,) * 4, 0.95)
    of = Figures(summary(rows, Options()).rows)
    assert of(GSO, "1 run", "expected_loss") == pytest.approx(0.002)


def test_a_measurement_that_ended_within_an_object_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def answers(path: Path, *_: object) -> list[dict]:
        asked.append(path.stem)
        if path.stem == "thin":
            return [{"refused": "too thin"} for _ in COUNTS]
        return [{"balanced": 0.5, "expected_loss": None, "explained": 0.9, "seconds": 1.0} for _ in COUNTS]

    monkeypatch.setattr("benchmarks.studies.runs.answers", answers)
    monkeypatch.setattr("benchmarks.studies.runs.files", lambda *_: [Path("a.obj"), Path("thin.obj")])
    options = Options(tmp_path, set="gso", results=tmp_path / "rows.jsonl")
    main(options)
    whole = read_lines(options.results)
    options.results.write_bytes(options.results.read_bytes()[:-9])  # killed while the last row was written
    asked.clear()
    main(options)
    assert asked == ["thin"] and read_lines(options.results) == whole
