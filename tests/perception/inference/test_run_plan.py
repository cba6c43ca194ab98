"""How many runs are wanted, when no further one is begun, and where their time went."""

import time
from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.inference.limits import NO_LIMITS, Limits
from perception.inference.run_plan import Findings, runs_wanted
from perception.inference.stopwatch import Stopwatch
from tests.properties.drawn import law


@pytest.mark.parametrize(
    ("done", "loss", "unexplained", "wanted"),
    [
        (1, 0.009, 0.0, 1),  # good enough
        (1, 0.029, 0.0, 3),  # 2.9 rounded up
        (4, 0.0101, 0.0, 5),
        (1, 0.5, 0.0, 6),  # all there may be
        (1, 0.009, 0.2, 6),
        (6, 0.5, 0.2, 6),
        (1, nan, 0.0, 6),
        (1, inf, 0.0, 6),
    ],
)
def test_how_many_runs_a_loss_takes(done: int, loss: float, unexplained: float, wanted: int) -> None:
    assert runs_wanted(Findings(done, loss, unexplained), most=6, tolerance=0.01, unexplained=0.1) == wanted
    assert runs_wanted(Findings(done, loss, unexplained), most=6, tolerance=inf, unexplained=1.0) == done
    assert runs_wanted(Findings(done, loss, unexplained), most=6, tolerance=0.0, unexplained=1.0) == 6


@law
@given(
    done=st.integers(1, 9), more=st.integers(0, 9), loss=st.floats(0.0, 1.0), worse=st.floats(0.0, 1.0),
    missed=st.floats(0.0, 1.0), tolerance=st.floats(1e-6, 0.1),
)  # fmt: skip
def test_a_worse_answer_wants_no_fewer_runs(
    done: int, more: int, loss: float, worse: float, missed: float, tolerance: float
) -> None:
    most = done + more
    wanted = runs_wanted(Findings(done, loss, missed), most, tolerance, 0.1)
    assert done <= wanted <= most
    assert wanted <= runs_wanted(Findings(done, loss + worse, missed), most, tolerance, 0.1)
    assert wanted <= runs_wanted(Findings(done, loss, min(missed + worse, 1.0)), most, tolerance, 0.1)
    if done < wanted < most:  # so many runs lose the tolerance, as the loss falls with their number; one fewer do not
        assert loss * done / wanted <= tolerance * (1.0 + 1e-9)
        assert wanted == done + 1 or loss * done / (wanted - 1) > tolerance


def test_limits_leave_room_for_a_run_that_fits() -> None:
    assert NO_LIMITS.reached(stages=10**6, now=1e9, next_run_s=1e6) is None
    assert Limits(stages=8).reached(7, now=0.0, next_run_s=1.0) is None
    assert Limits(stages=8).reached(8, now=0.0, next_run_s=1.0) == "stages"
    assert Limits(deadline=10.0).reached(8, now=7.0, next_run_s=2.9) is None
    assert Limits(deadline=10.0).reached(8, now=7.0, next_run_s=3.1) == "budget"


def test_a_part_within_a_part_counts_for_itself_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 3.0, 7.0, 20.0, 21.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    watch = Stopwatch()
    with watch.part("outer"), watch.part("inner"):
        pass
    with watch.part("inner"):
        pass
    assert watch.seconds == {"outer": 1.0 + 4.0, "inner": 2.0 + 1.0}
