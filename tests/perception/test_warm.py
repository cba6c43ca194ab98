"""Warming up compiles with a tracker of its own, and passes a Ctrl-C on."""

import gc
from dataclasses import replace
from typing import Any

import jax
import pytest

from benchmarks.occluded import carton_seeds, half_hidden
from benchmarks.scene import vessel_view
from benchmarks.unseen import any_view
from perception.track import Tracker, Update
from perception.warm import warm_up
from probnerf import smc
from probnerf.infer import explained, opacity_grids
from probnerf.modes import mixture_of_modes
from probnerf.prior import PRESETS, ProbNeRF
from probnerf.store import Prior, load_prior
from tests.node.shapes import body_with_handle


def _tracker(monkeypatch: pytest.MonkeyPatch, outcome: str | Exception) -> tuple[Tracker, list[Tracker]]:
    asked = []

    def update(self: Tracker, frame: Any, segment: Any, **limits: Any) -> Update:
        asked.append(self)
        if isinstance(outcome, Exception):
            raise outcome
        assert limits["stages"] == 1 and limits["on_answer"](None) is None
        return Update("new", replace(body_with_handle(), result=outcome), 1, 0.0, 0.0)

    monkeypatch.setattr(Tracker, "update", update)
    monkeypatch.setattr("perception.warm._go_on", lambda trial, *_: asked.append(trial))
    return Tracker(Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {}, "x"), seed=3), asked


def test_another_tracker_of_the_same_settings_looks_and_looks_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker, asked = _tracker(monkeypatch, "stages")
    before = gc.get_freeze_count()
    try:
        warm_up(tracker)
        assert gc.get_freeze_count() > before  # what is there is no longer looked through
    finally:
        gc.unfreeze()
    assert len(asked) == 4 and asked[0] is asked[1] and asked[2] is asked[3] and asked[0] is not asked[2]
    for trial in asked:
        assert trial is not tracker and trial.prior is tracker.prior and trial.seed == 3
        assert trial.config == tracker.config
        assert trial._tracks is not tracker._tracks and trial._names is not tracker._names


def test_a_ctrl_c_that_the_sampler_took_is_passed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _ = _tracker(monkeypatch, "interrupted")
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
def test_nothing_large_is_left_for_the_first_frame_to_compile() -> None:
    """Of an object seen well and of one half hidden, neither of which is in the recording."""
    tracker = Tracker(load_prior())
    try:
        warm_up(tracker)
    finally:
        gc.unfreeze()
    programs: tuple[Any, ...] = (
        smc._start,
        smc._stage,
        smc._reference_start,
        mixture_of_modes,
        opacity_grids,
        explained,
    )
    before = [f.jitted._cache_size() for f in programs]
    for picture in (any_view(2_000_001), half_hidden(2_000_003, next(carton_seeds(range(2_000_004, 2_000_999))))):
        assert picture is not None
        view = vessel_view(picture)
        tracker = Tracker(load_prior())
        tracker.update(view.frame, view.segment, stages=3, on_answer=lambda _: None)
        assert [f.jitted._cache_size() for f in programs] == before
