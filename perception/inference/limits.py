"""Limits on inference, and callbacks for its progress."""

from collections.abc import Callable
from dataclasses import dataclass

from perception.answers.hypotheses import Hypotheses
from probnerf.sampling.hmc import StageInfo
from probnerf.types import StopReason


@dataclass(frozen=True)
class Limits:
    """Limits for all runs of the sampler together. Without a deadline an answer depends only on its inputs."""

    deadline: float | None = None  # on the clock of time.monotonic()
    stages: int | None = None

    def reached(self, stages: int, now: float, next_run_s: float) -> StopReason | None:
        """The limit that rules out a further run after `stages`, if that takes `next_run_s` or more."""
        if self.stages is not None and stages >= self.stages:
            return StopReason.STAGES
        if self.deadline is not None and now + next_run_s > self.deadline:
            return StopReason.BUDGET
        return None


@dataclass(frozen=True)
class Callbacks:
    """Callbacks during inference."""

    on_stage: Callable[[StageInfo], bool | None] | None = None  # after each stage; True ends sampling
    on_answer: Callable[[Hypotheses], None] | None = None  # each answer, the last one, too
    guess: bool = True  # `on_answer` also gets the encoder's guess


NO_LIMITS = Limits()
NO_CALLBACKS = Callbacks()
