"""When no further run is begun, and where the time of runs went."""

import time

import pytest

from perception.inference.limits import NO_LIMITS, Limits
from perception.inference.stopwatch import Stopwatch


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
