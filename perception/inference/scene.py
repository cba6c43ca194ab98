"""All objects of a frame, together, within one budget of time."""

import math
import time
from collections.abc import Callable, Generator, Sequence

from perception.inference.inference import Estimate, Inference
from perception.observation.segmentation import Segment
from probnerf.types import StopReason

Answered = tuple[Segment, Estimate | ValueError]


def estimate_scene(
    segments: Sequence[Segment],
    start: Callable[[Segment, float | None], Inference],
    deadline: float | None = None,
    kept_back_s: float = 0.0,
) -> Generator[Answered, None, None]:
    """Each segment's estimate as soon as it is done, or the reason why there is none.

    Without a `deadline` (of `time.monotonic`) one object is finished after the other. With one, all objects get their
    first answers; then each a run of the sampler, in its share of the time that is left; then, as long as there is
    room, runs that were cut are made anew, the object first whose unseen space may gain most (`Inference.loss`). At the
    end every object has the best answer that there was time for. `start` makes an inference that ends at a time.
    `kept_back_s` is what the caller spends on each answer. After Ctrl-C, also one that is thrown in, all present
    answers are given; where none of them says so, KeyboardInterrupt is raised then.
    """
    if deadline is not None and len(segments) > 1:
        yield from _in_rounds(segments, start, deadline - kept_back_s * len(segments))
        return
    for segment in segments:
        try:
            inference = start(segment, None if deadline is None else max(deadline - kept_back_s, time.monotonic() + 1))
            inference.begin()
        except ValueError as error:
            yield segment, error
            continue
        try:
            while not inference.done:
                inference.step()
        except KeyboardInterrupt:
            if inference.answer is None:
                raise
            inference.stop(StopReason.INTERRUPTED)
        yield segment, inference.estimate()
        if inference.interrupted:
            return


def _in_rounds(
    segments: Sequence[Segment], start: Callable[[Segment, float | None], Inference], end: float
) -> Generator[Answered, None, None]:
    waiting = list[tuple[Segment, Inference]]()
    reason, caught = StopReason.BUDGET, False
    try:
        answer_s = yield from _first_answers(segments, start, end, waiting)
        if (yield from _runs(waiting, end, answer_s)):
            reason = StopReason.INTERRUPTED
    except KeyboardInterrupt:  # between two stages of the sampler, which takes note of others itself
        reason, caught = StopReason.INTERRUPTED, True
    for segment, inference in waiting:
        inference.stop(reason)
        if inference.answer is not None:
            caught = caught and not inference.interrupted  # the answer says so
            yield segment, inference.estimate()
    if caught:
        raise KeyboardInterrupt


def _first_answers(
    segments: Sequence[Segment],
    start: Callable[[Segment, float | None], Inference],
    end: float,
    waiting: list[tuple[Segment, Inference]],
) -> Generator[Answered, None, float]:
    """Puts objects with their first answers on the list. The time that the slowest took, s."""
    answer_s = 0.0
    for segment in segments:
        begun = time.monotonic()
        try:
            inference = start(segment, end)
            inference.guess()
        except ValueError as error:
            yield segment, error
            continue
        waiting.append((segment, inference))
        answer_s = max(answer_s, time.monotonic() - begun)
    return answer_s


def _runs(waiting: list[tuple[Segment, Inference]], end: float, answer_s: float) -> Generator[Answered, None, bool]:
    """Takes what is done off the list. Whether Ctrl-C ended it."""
    given = dict[int, float]()  # seconds of each first run, at most
    for i, (segment, inference) in enumerate(waiting):
        now = time.monotonic()
        share = given[segment.id] = (end - now) / (len(waiting) - i)
        if share <= 0.0 and inference.answer is not None:
            continue
        inference.begin()
        if not inference.done:
            inference.step(now + max(share - answer_s, 0.5))
        if inference.interrupted:
            return True
    while waiting:
        for segment, inference in [pair for pair in waiting if pair[1].done]:
            waiting.remove((segment, inference))
            yield segment, inference.estimate()
        left = end - time.monotonic()
        # a run that was cut is made anew only where it may get as far
        need = [0.75 * max(given[segment.id], 0.0) if it.loss == math.inf else 0.0 for segment, it in waiting]
        open_to = [it for (_, it), seconds in zip(waiting, need, strict=True) if left > seconds]
        if not open_to:
            break
        chosen = max(open_to, key=lambda inference: inference.loss)
        chosen.step()
        if chosen.interrupted:
            return True
    return False
