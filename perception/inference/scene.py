"""All objects of a frame, one after the other, within one budget of time."""

import time
from collections.abc import Callable, Iterator, Sequence

from perception.inference.controller import Estimate
from perception.observation.segmentation import Segment
from probnerf.types import StopReason


def estimate_each(
    segments: Sequence[Segment],
    estimate_one: Callable[[Segment, float | None], Estimate],
    deadline: float | None = None,
    kept_back_s: float = 0.0,
) -> Iterator[tuple[Segment, Estimate | ValueError]]:
    """Each segment's estimate, or the reason why there is none.

    `estimate_one` gets a segment and its budget (s): its share of the time that is left until `deadline` (of
    `time.monotonic`; None: no budget), less `kept_back_s` that the caller spends on each answer; at least a second. The
    iteration ends after an answer that Ctrl-C cut short.
    """
    for i, segment in enumerate(segments):
        budget = None
        if deadline is not None:
            budget = max((deadline - time.monotonic()) / (len(segments) - i) - kept_back_s, 1.0)
        try:
            result = estimate_one(segment, budget)
        except ValueError as error:
            yield segment, error
            continue
        yield segment, result
        if result.hypotheses.result == StopReason.INTERRUPTED:
            return
