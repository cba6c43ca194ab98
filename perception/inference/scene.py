"""All objects of a frame, one after the other, within one budget of time."""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior
from probnerf.sampling.hmc import StageInfo
from probnerf.types import StopReason


def estimate_each(
    frame: Frame,
    segments: Sequence[Segment],
    prior: Prior,
    config: ControllerConfig | None = None,
    *,
    seed: int = 0,
    stages: int | None = None,
    deadline: float | None = None,
    kept_back_s: float = 0.0,
    on_stage: Callable[[int, StageInfo], bool | None] | None = None,
) -> Iterator[tuple[Segment, Estimate | ValueError]]:
    """Each segment's estimate, or the reason why there is none.

    An object gets its share of the time that is left until `deadline` (of `time.monotonic`), less `kept_back_s` that
    the caller spends on each answer; at least a second. `on_stage` gets the object's id with every stage. The iteration
    ends after an answer that Ctrl-C cut short.
    """
    for i, segment in enumerate(segments):
        budget = None
        if deadline is not None:
            budget = max((deadline - time.monotonic()) / (len(segments) - i) - kept_back_s, 1.0)
        try:
            result = estimate(
                frame, segment, prior, config, seed=seed, budget_s=budget, stages=stages,
                on_stage=None if on_stage is None else partial(on_stage, segment.id),
            )  # fmt: skip
        except ValueError as error:
            yield segment, error
            continue
        yield segment, result
        if result.hypotheses.result == StopReason.INTERRUPTED:
            return
