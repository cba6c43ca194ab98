"""A verdict is given at the risk that was asked for, and never of space that nobody looked at."""

from dataclasses import replace

import numpy as np
import pytest

from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.query import QueryResult, query
from perception.answers.regions import Box
from tests.perception.answers.test_query import BODY, _fill, _object


def _answer(few: float, outside: float = 0.0) -> QueryResult:
    return QueryResult(few, 0.0, few, {}, 0.0, outside, 0.0, 48.0, 0.0)


@pytest.mark.parametrize(
    ("few", "outside", "risk", "said"),
    [
        (0.98, 0.0, 0.05, "free"),
        (0.98, 0.1, 0.05, "unsure"),  # a part of it was never looked at
        (0.98, 0.0, 0.01, "unsure"),
        (0.94, 0.0, 0.05, "unsure"),
        (0.02, 0.5, 0.05, "occupied"),  # whatever the rest of it is
        (0.02, 0.0, 0.01, "unsure"),
        (0.5, 0.0, 0.49, "unsure"),
    ],
)
def test_a_verdict_abstains_where_the_risk_is_larger(few: float, outside: float, risk: float, said: str) -> None:
    assert _answer(few, outside).verdict(risk) == said


@pytest.mark.parametrize("risk", [0.0, 0.5, -1.0, float("nan")])
def test_a_risk_that_is_none_is_refused(risk: float) -> None:
    with pytest.raises(ValueError, match="above 0 and below"):
        _answer(0.98).verdict(risk)


def test_hypotheses_that_all_agree_leave_a_doubt_for_each_object() -> None:
    shapes = [_fill(BODY, ((0.08 + 0.01 * k, 0.08, -0.08), (0.09 + 0.01 * k, 0.09, 0.08))) for k in range(4)]
    one = _object(shapes, [0.25] * 4)
    two = replace(one, object_id=2)
    free = Box((-0.14, -0.14, 0.1), (-0.1, -0.1, 0.14))
    n = one.effective_hypotheses
    assert 2.0 < n <= 4.0
    alone, both = query([one], free, "object"), query([one, two], _in_camera(free), "camera")
    assert alone.p_free == both.p_free == 1.0
    assert alone.p_free_few == pytest.approx((n + 1) / (n + 2))
    assert both.p_free_few == pytest.approx(((n + 1) / (n + 2)) ** 2)


def test_one_population_that_did_not_fail_is_one_witness() -> None:
    shapes = [_fill(BODY, ((0.08 + 0.002 * k, 0.08, -0.08), (0.082 + 0.002 * k, 0.09, 0.08))) for k in range(30)]
    sure = replace(_object(shapes, [1 / 30] * 30), population=np.zeros(30, np.int32))
    lost = replace(sure, diagnostics=AnswerDiagnostics(failed_populations=3.0))
    free = Box((-0.14, -0.14, 0.1), (-0.1, -0.1, 0.14))
    assert query([lost], free, "object").p_free_few == pytest.approx(2 / 3)
    assert query([lost], free, "object").verdict(0.3) == "unsure"
    two = replace(lost, population=np.arange(30, dtype=np.int32) % 2)
    assert query([two], free, "object").p_free_few == query([sure], free, "object").p_free_few > 0.7


def _in_camera(box: Box) -> Box:
    """The box of the object frame in the camera's, for an object at (0, 0, 0.5)."""
    return Box((box.low[0], box.low[1], box.low[2] + 0.5), (box.high[0], box.high[1], box.high[2] + 0.5))


def test_nobody_looked_into_the_table() -> None:
    """Under the support plane nothing of an object is, and nothing is known."""
    mug = _object([_fill(BODY)], [1.0])
    under = Box((-0.05, -0.05, -0.16), (0.05, 0.05, -0.14))  # the plane is at -0.12 m
    r = query([mug], under, "object")
    assert r.verdict() == "unseen" and np.isnan(r.p_free) and r.unseen_fraction == 0.0
    beside = Box((0.11, 0.11, -0.11), (0.14, 0.14, 0.0))
    assert query([mug], beside, "object").outside_fraction == 0.0
    half = Box((0.11, 0.11, -0.15), (0.14, 0.14, -0.11))
    assert query([mug], half, "object").outside_fraction == pytest.approx(0.5, abs=0.05)
