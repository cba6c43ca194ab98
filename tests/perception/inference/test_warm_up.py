"""Warming up compiles with a tracker of its own, and passes a Ctrl-C on."""

import gc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.scenes.cartons import carton_seeds, half_hidden
from benchmarks.scenes.conditions import any_view
from benchmarks.scenes.vessels import vessel_view
from perception.inference.limits import Callbacks, Limits
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Change, Tracker, Update
from perception.inference.warm_up import _alone, warm_up
from perception.observation.segmentation import segment
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf import compile_cache, inference, shapes
from probnerf.kernel import library
from probnerf.likelihood import pixel_terms
from probnerf.pixel_status import UNKNOWN
from probnerf.prior import posterior_network
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.sampling import modes, tempered_smc
from probnerf.settings import InferConfig, quick_smc
from probnerf.types import StopReason
from tests.node.shapes import body_with_handle


def _tracker(monkeypatch: pytest.MonkeyPatch, outcome: str | Exception, then: str = "stages") -> tuple[Tracker, list]:
    """A tracker, and what is asked of one like it: looks, inferences and samples, of which none is made."""
    asked: list = []

    def infer_look(self: Tracker, look: Any, limits: Limits, callbacks: Callbacks) -> Update:
        asked.append((self, "infer", look._view.every_choice))
        assert limits == Limits(stages=1) and callbacks.on_answer(None) is None
        monkeypatch.setitem(self.__dict__["_tracks"], 1, SimpleNamespace(posterior="its own"))
        return Update(Change.NEW, replace(body_with_handle(), result=StopReason(outcome)), 1, 0.0, 0.0)

    def look(self: Tracker, frame: Any, segment: Any, how: Any = None) -> Any:
        hidden = bool((segment.status == UNKNOWN).any())
        asked.append((self, "look", hidden, how is not None and how(1)[1]))
        if isinstance(outcome, Exception):
            raise outcome
        return SimpleNamespace(object_id=1, _view=SimpleNamespace(every_choice=hidden))

    def infer(key: Any, model: Any, observation: Any, config: Any, *, before: Any, stages: int) -> Any:
        asked.append(("sample", observation, before))
        return SimpleNamespace(result=then), None

    monkeypatch.setattr(Tracker, "infer", infer_look)
    monkeypatch.setattr(Tracker, "look", look)
    monkeypatch.setattr("perception.inference.warm_up.infer", infer)
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
    assert asked[:2] == [(trial, "look", False, False), (trial, "infer", False)]
    assert asked[2:4] == [(trial, "look", False, False), ("sample", False, "its own")]
    assert asked[4:6] == [(trial, "look", True, True), ("sample", True, None)]  # begun anew, from the prior,
    assert asked[6][:2] == ("sample", True) and asked[6][2].result == "stages"  # and gone on with


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


def _programs() -> list[Any]:
    """Of inference, all of them."""
    modules = (tempered_smc, inference, shapes, modes, posterior_network, pixel_terms)
    return [f for module in modules for f in vars(module).values() if isinstance(f, compile_cache.Program)]


@pytest.mark.slow
@pytest.mark.parametrize("kept", [False, True])
def test_nothing_large_is_left_for_the_first_frame_to_compile(
    kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an object seen well and of one half hidden, neither of which is in the recording; also after a rehearsal that
    read what another had kept, which changes no answer.
    """
    prior, every = load_prior(), _programs()
    assert len(every) > 8

    def warmed() -> list[int]:
        for f in every:
            monkeypatch.setattr(f, "_ready", {})
        try:
            warm_up(Tracker(prior))
        finally:
            gc.unfreeze()
        return ready()

    def ready() -> list[int]:
        return [len(f._ready) if kept else f.jitted._cache_size() for f in every]

    pictures = any_view(2_000_001), half_hidden(2_000_003, next(carton_seeds(range(2_000_004, 2_000_999))))
    views = [vessel_view(picture) for picture in pictures if picture is not None]
    assert len(views) == 2

    def answers() -> list[np.ndarray]:
        given = dict(stages=3, on_answer=lambda _: None)
        return [Tracker(prior).update(v.frame, v.segment, **given).hypotheses.opacity for v in views]

    monkeypatch.setattr(compile_cache, "_folder", lambda: None)  # a command that ran here before may have named one
    expected = answers() if kept else []
    if kept:
        monkeypatch.setattr(compile_cache, "_folder", lambda: tmp_path)
        warmed()
    before = warmed()
    assert sum(n > 0 for n in before) > 8
    found = answers()
    assert ready() == before
    for one, other in zip(expected, found, strict=False):
        np.testing.assert_array_equal(one, other)


@pytest.mark.nightly
def test_without_the_kernel_a_rehearsal_finds_the_sizes_of_its_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Programs have each view's own sizes there, which are found by running what decides them, as without a rehearsal:
    the same object's answer is the same, and compiles nothing.
    """
    monkeypatch.setattr(library, "available", lambda: False)
    small = quick_smc(2, 4)
    inference = replace(InferConfig(), lattice=8, smc=small, smc_from_prior=small)
    config = ControllerConfig(infer=replace(inference, modes=replace(inference.modes, starts=4)))
    prior = Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {}, "x")
    frame = next(iter(Log(SHIPPED_LOG)))
    alone = _alone(segment(frame)[0])

    def answer() -> np.ndarray:
        given = dict(stages=3, on_answer=lambda _: None)
        return Tracker(prior, config).update(frame, alone, **given).hypotheses.opacity

    expected = answer()
    assert np.ptp(expected) > 0
    monkeypatch.setattr(compile_cache, "_folder", lambda: tmp_path)
    for _ in range(2):  # compiled and kept; read
        for f in _programs():
            monkeypatch.setattr(f, "_ready", {})
        try:
            warm_up(Tracker(prior, config))
        finally:
            gc.unfreeze()
    kept = set(tmp_path.iterdir())
    assert len(kept) > 8
    found = answer()
    assert set(tmp_path.iterdir()) == kept
    assert np.mean(found != expected) < 0.01  # of 255 steps: kept programs are compiled with another option, and round
