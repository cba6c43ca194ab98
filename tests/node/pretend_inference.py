"""Stands for inference, after the real `observe`: keeps what it was asked, answers with the true mug."""

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from perception.answers.hypotheses import Hypotheses
from perception.inference.inference import Estimate
from perception.inference.limits import Callbacks, Limits
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Change, Look, Tracker, Update
from perception.observation.rays import observe
from perception.observation.segmentation import Segment
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior
from probnerf.types import StopReason
from tests.node.mugs import mug_hypotheses


class Asked:
    """Takes the place of `inference_of`."""

    def __init__(self) -> None:
        self.calls: list[dict] = []
        self.result = StopReason.CONVERGED

    def __call__(self, frame: Frame, found: Segment, prior: Prior, config: ControllerConfig, **asked: Any) -> Any:
        observe(frame, found, config.observe, asked["seed"])
        self.calls.append({"id": found.id, "prior": prior, "config": config, **asked})
        h = mug_hypotheses(frame, found, [1.0, -1.0], [0.5, 0.5], 16, seed=asked["seed"], result=self.result)
        interrupted = self.result == StopReason.INTERRUPTED
        return SimpleNamespace(
            done=not interrupted,
            answer=h,
            interrupted=interrupted,
            loss=0.0,
            guess=lambda: None,
            begin=lambda: None,
            step=lambda *_: True,
            stop=lambda reason: None,
            estimate=lambda: Estimate(h, None, None, None, h.object_frame, 1.5),
        )


def pretend_live(
    monkeypatch: pytest.MonkeyPatch, answers: Callable[[Look], list[Hypotheses]], first: bool = True
) -> list[Limits]:
    """Have the node's tracker find these answers to a look: the first of them at once (or not), the rest in one step.
    The limits that inferences get are returned as they come.
    """
    asked: list[Limits] = []

    def begin(self: Tracker, look: Look, limits: Limits, callbacks: Callbacks) -> Any:
        asked.append(limits)
        made, hear = answers(look), callbacks.on_answer
        assert hear is not None
        inference = SimpleNamespace(done=False, answer=None, interrupted=False, loss=0.0, begin=lambda: None)

        def guess() -> None:
            if first:
                inference.answer = made[0]
                hear(made[0])

        def step(*_: Any) -> bool:
            for h in made[1:]:
                hear(h)
            inference.answer, inference.done = made[-1], True
            inference.interrupted = made[-1].result == StopReason.INTERRUPTED
            return True

        inference.guess, inference.step, inference.stop = guess, step, lambda reason: None
        inference.estimate = lambda: SimpleNamespace(hypotheses=inference.answer)
        return inference

    monkeypatch.setattr(Tracker, "begin", begin)
    monkeypatch.setattr(Tracker, "keep", lambda self, look, found: Update(Change.NEW, found.hypotheses, 1, 0.0, 0.0))
    return asked


def pretend_estimate(
    frame: Frame, found: Segment, prior: Prior, config: ControllerConfig, *, seed: int, **limits: Any
) -> Estimate:
    """Takes the place of `estimate`, in other processes, too: the true mug, whose handle's place hangs on the seed."""
    h = mug_hypotheses(frame, found, [1.0 + seed, -1.0], [0.75, 0.25], 16, seed=seed)
    return Estimate(h, None, None, None, h.object_frame, 1.5)


def deadly_estimate(frame: Frame, found: Segment, *args: Any, seed: int, **limits: Any) -> Estimate:
    """The same; but its process is killed at object 2, as often as the folder FARSIDE_TEST_DEATHS has files."""
    for death in Path(os.environ["FARSIDE_TEST_DEATHS"]).iterdir() if found.id == 2 else ():
        with suppress(FileNotFoundError):  # another process died of it
            death.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
    return pretend_estimate(frame, found, *args, seed=seed)
