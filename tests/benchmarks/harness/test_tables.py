"""Tables of figures: intervals beside means, and gates that say whether they are passed."""

import numpy as np

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.tables import FAIL, PASS, Table, gated, ranged, verdict


def test_mean_rows_carry_their_interval() -> None:
    mean, low, high = mean_rows("x", "m", "c", "score", [1.0, 2.0, np.nan, 3.0], "nats")
    assert (mean.value, mean.n, low.metric, high.metric) == (2.0, 3, "score_q025", "score_q975")
    assert low.value < 2.0 < high.value
    gap = Figures(gap_rows("x", "m", "c", "gap", [1.0, 2.0, 4.0], [1.0, 1.0, 1.0])).interval("c", "m", "gap")
    assert gap.n == 3 and gap.low < gap.mean < gap.high and abs(gap.mean - 4 / 3) < 1e-12


def test_a_figure_that_is_not_there_is_nan_and_of_no_object() -> None:
    of = Figures(mean_rows("x", "m", "c", "score", [1.0, 2.0], ""))
    assert np.isnan(of("c", "another", "score")) and of.count("c", "another", "score") == 0
    assert ("c", "m", "score") in of and of.methods("c") == ["m"] and of.conditions() == ["c"]


def test_a_gate_is_passed_at_its_ends_and_by_no_nan() -> None:
    assert verdict(0.03, most=0.03) == verdict(0.87, 0.87, 0.93) == PASS
    assert verdict(0.031, most=0.03) == verdict(0.86, 0.87, 0.93) == verdict(float("nan")) == FAIL
    assert gated("0.5", 0.5, most=0.4) == "0.5: FAIL"


def test_a_table_is_aligned_on_a_terminal_and_a_failure_is_bold_on_a_page() -> None:
    table = Table("Scores", ("method", "score"), [["a", "1: pass"], ["longer", "2: FAIL"]])
    assert table.text().splitlines()[3:] == ["  a       1: pass", "  longer  2: FAIL"]
    assert table.markdown().splitlines() == [
        "Scores:", "", "| method | score |", "|---|---|", "| a | 1: pass |", "| longer | 2: **FAIL** |",
    ]  # fmt: skip
    for values, shown in (([1.0, 1.0], "1.0 (1.0 to 1.0)"), ([1.0], "1.0")):
        assert ranged(Figures(mean_rows("x", "m", "c", "s", values, "")).interval("c", "m", "s"), 1) == shown
