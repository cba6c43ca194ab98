"""Kinds: the scores are what they say, and a prior without a network is refused."""

import numpy as np
import pytest

from benchmarks.studies.kinds import ALL, METHOD, Options, main, source_rows, summary
from probnerf.types import KINDS
from tests.priors import TABLETOP

RNG = np.random.default_rng(0)


def _figures(p: np.ndarray, kind: np.ndarray) -> dict[str, float]:
    return {row.metric: row.value for row in source_rows("here", p, kind)}


def test_a_constant_forecast_of_the_shares_gains_nothing() -> None:
    kind = np.repeat(np.arange(len(KINDS)), [50, 30, 20])
    found = _figures(np.tile([0.5, 0.3, 0.2], (100, 1)), kind)
    assert found["log_score"] == pytest.approx(-np.dot([0.5, 0.3, 0.2], np.log([0.5, 0.3, 0.2])))
    assert found["gap"] == pytest.approx(0.0, abs=1e-12)
    assert found["ece"] == pytest.approx(0.0, abs=1e-12)


def test_true_probabilities_are_calibrated_and_certain_errors_are_not() -> None:
    p = RNG.dirichlet([0.5] * len(KINDS), 4000)
    kind = np.array([RNG.choice(len(KINDS), p=one) for one in p])
    found = _figures(p, kind)
    assert found["gap_q975"] < 0.0
    assert found["ece"] < 0.02
    wrong = _figures(np.eye(len(KINDS))[(kind + 1) % len(KINDS)], kind)
    assert wrong["gap_q025"] > 0.0
    assert wrong["ece"] == pytest.approx(2.0 / 3.0)


def test_the_gate_is_judged_on_all_objects_together() -> None:
    p = RNG.dirichlet([0.5] * len(KINDS), 600)
    kind = np.array([RNG.choice(len(KINDS), p=one) for one in p])
    found = summary({"one": (p[:300], kind[:300]), "other": (p[300:], kind[300:])})
    (table,) = found.tables
    assert [line[0] for line in table.lines] == ["one", "other", ALL]
    assert [("pass" in cell) for cell in table.lines[-1][-2:]] == [True, True]
    assert not any("pass" in cell or "FAIL" in cell for line in table.lines[:-1] for cell in line)
    assert {row.n for row in found.rows if row.condition == ALL and row.method == METHOD} == {600}
    assert found.picture is not None
    assert len(found.picture().axes) == 1


def test_a_prior_without_a_network_is_refused() -> None:
    with pytest.raises(ValueError, match="no posterior network"):
        main(Options(n=1, quick=True, prior=TABLETOP))
