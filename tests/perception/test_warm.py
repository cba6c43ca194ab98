"""Warming up compiles with a tracker of its own, and passes a Ctrl-C on."""

import gc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest

from benchmarks.occluded import carton_seeds, half_hidden
from benchmarks.scene import vessel_view
from benchmarks.unseen import any_view
from perception.track import Tracker, Update
from perception.warm import warm_up
from probnerf import programs, smc
from probnerf.infer import explained, opacity_grids
from probnerf.modes import mixture_of_modes
from probnerf.prior import PRESETS, ProbNeRF
from probnerf.store import Prior, load_prior
from probnerf.types import UNKNOWN
from tests.node.shapes import body_with_handle


def _tracker(monkeypatch: pytest.MonkeyPatch, outcome: str | Exception, then: str = "stages") -> tuple[Tracker, list]:
    """A tracker, and what is asked of one like it: updates, looks and samples, of which none is made."""
    asked: list = []

    def update(self: Tracker, frame: Any, segment: Any, **limits: Any) -> Update:
        asked.append((self, "update", bool((segment.status == UNKNOWN).any())))
        if isinstance(outcome, Exception):
            raise outcome
        assert limits["stages"] == 1 and limits["on_answer"](None) is None
        monkeypatch.setitem(self.__dict__["_tracks"], 1, SimpleNamespace(posterior="its own"))
        return Update("new", replace(body_with_handle(), result=outcome), 1, 0.0, 0.0)

    def look(self: Tracker, frame: Any, segment: Any, how: Any = None) -> Any:
        hidden = bool((segment.status == UNKNOWN).any())
        asked.append((self, "look", hidden, how is not None and how(1)[1]))
        return SimpleNamespace(object_id=1, _view=SimpleNamespace(observation=hidden))

    def infer(key: Any, model: Any, observation: Any, config: Any, *, before: Any, stages: int) -> Any:
        asked.append(("sample", observation, before))
        return SimpleNamespace(result=then), None

    monkeypatch.setattr(Tracker, "update", update)
    monkeypatch.setattr(Tracker, "look", look)
    monkeypatch.setattr("perception.warm.infer", infer)
    return Tracker(Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {}, "x"), seed=3), asked


def test_another_tracker_of_the_same_settings_looks_and_looks_again_and_at_the_object_half_hidden(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker, asked = _tracker(monkeypatch, "stages")
    before = gc.get_freeze_count()
    try:
        warm_up(tracker)
        assert gc.get_freeze_count() > before  # what is there is no longer looked through
    finally:
        gc.unfreeze()
    trial = asked[0][0]
    assert trial is not tracker and trial.prior is tracker.prior and trial.seed == 3
    assert trial.config == tracker.config and not tracker._tracks and trial._names is not tracker._names
    assert asked[:3] == [(trial, "update", False), (trial, "look", False, False), ("sample", False, "its own")]
    assert asked[3:5] == [(trial, "look", True, True), ("sample", True, None)]  # begun anew, from the prior,
    assert asked[5][:2] == ("sample", True) and asked[5][2].result == "stages"  # and gone on with


@pytest.mark.parametrize(("outcome", "then"), [("interrupted", "stages"), ("stages", "interrupted")])
def test_a_ctrl_c_that_the_sampler_took_is_passed_on(monkeypatch: pytest.MonkeyPatch, outcome: str, then: str) -> None:
    tracker, _ = _tracker(monkeypatch, outcome, then)
    with pytest.raises(KeyboardInterrupt):
        warm_up(tracker)


def test_a_prior_of_other_objects_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, asked = _tracker(monkeypatch, ValueError("object 1 measures 9 cm and sedans are 4 m"))
    try:
        warm_up(tracker)
    finally:
        gc.unfreeze()
    assert len(asked) == 1


@pytest.mark.slow
@pytest.mark.parametrize("kept", [False, True])
def test_nothing_large_is_left_for_the_first_frame_to_compile(
    kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an object seen well and of one half hidden, neither of which is in the recording; also after a rehearsal."""
    if kept:
        monkeypatch.setattr(programs, "_folder", lambda: tmp_path)
    tracker = Tracker(load_prior())
    try:
        warm_up(tracker)
    finally:
        gc.unfreeze()
    large: tuple[Any, ...] = (
        smc._start,
        smc._stage,
        smc._reference_start,
        mixture_of_modes,
        opacity_grids,
        explained,
    )

    def ready() -> list[int]:
        return [len(f._ready) if kept else f.jitted._cache_size() for f in large]

    before = ready()
    assert min(before) > 0
    for picture in (any_view(2_000_001), half_hidden(2_000_003, next(carton_seeds(range(2_000_004, 2_000_999))))):
        assert picture is not None
        view = vessel_view(picture)
        tracker = Tracker(load_prior())
        tracker.update(view.frame, view.segment, stages=3, on_answer=lambda _: None)
        assert ready() == before
