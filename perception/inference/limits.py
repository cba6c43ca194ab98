"""How long inference may go on, and who hears of it meanwhile."""

from collections.abc import Callable
from dataclasses import dataclass

from perception.answers.hypotheses import Hypotheses
from probnerf.sampling.hmc import StageInfo
from probnerf.types import StopReason


@dataclass(frozen=True)
class Limits:
    """What all runs of the sampler may take together. Without a deadline an answer depends on its inputs alone."""

    deadline: float | None = None  # on the clock of time.monotonic()
    stages: int | None = None

    def reached(self, stages: int, now: float, next_run_s: float) -> StopReason | None:
        """Which limit leaves no room for a further run after so many stages, if that takes `next_run_s` or more."""
        if self.stages is not None and stages >= self.stages:
            return StopReason.STAGES
        if self.deadline is not None and now + next_run_s > self.deadline:
            return StopReason.BUDGET
        return None


@dataclass(frozen=True)
class Callbacks:
    """Who hears of inference while it goes on."""

    on_stage: Callable[[StageInfo], bool | None] | None = None  # after each stage; True ends sampling
    on_answer: Callable[[Hypotheses], None] | None = None  # each answer, the last one, too
    guess: bool = True  # `on_answer` also gets what the encoder takes the object for: nothing better is known of it


NO_LIMITS = Limits()
NO_CALLBACKS = Callbacks()
