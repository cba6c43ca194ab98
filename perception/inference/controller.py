"""From a frame's segment to published hypotheses, with as many sampler runs as the scene needs (`inference`)."""

import time
from collections.abc import Callable

from perception.answers.hypotheses import Hypotheses
from perception.inference.inference import Estimate, Inference
from perception.inference.limits import NO_CALLBACKS, NO_LIMITS, Callbacks, Limits
from perception.inference.publish import ConditionedView
from perception.inference.settings import ControllerConfig
from perception.observation.object_frame import ObjectFrame
from perception.observation.rays import observations
from perception.observation.segmentation import Segment
from perception.observation.visibility import seen_voxels
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior
from probnerf.sampling.hmc import StageInfo
from probnerf.types import Posterior

__all__ = ["Estimate", "estimate", "infer_view", "inference_of"]


def estimate(
    frame: Frame,
    segment: Segment,
    prior: Prior,
    config: ControllerConfig | None = None,
    *,
    seed: int = 0,
    known: ObjectFrame | None = None,
    budget_s: float | None = None,
    stages: int | None = None,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    on_answer: Callable[[Hypotheses], None] | None = None,
) -> Estimate:
    """Hypotheses about one object of a frame; first ones, made more cheaply, go to `on_answer` while it works.

    With `stages` and no budget the answer is a function of the inputs alone. `known` is the object's own cube where its
    pose is known already (the handle at +x), so that only its shape is inferred.

    Raises ValueError where the segment cannot be observed (too small, outside the prior's range of sizes).
    """
    limits = Limits(None if budget_s is None else time.monotonic() + budget_s, stages)
    callbacks = Callbacks(on_stage, on_answer)
    return _finished(
        inference_of(frame, segment, prior, config, seed=seed, known=known, limits=limits, callbacks=callbacks)
    )


def inference_of(
    frame: Frame,
    segment: Segment,
    prior: Prior,
    config: ControllerConfig | None = None,
    *,
    seed: int = 0,
    known: ObjectFrame | None = None,
    limits: Limits = NO_LIMITS,
    callbacks: Callbacks = NO_CALLBACKS,
) -> Inference:
    """The inference of one object of a frame, not begun. Raises as `estimate`."""
    config = config or ControllerConfig()
    chosen, cube = observations(frame, segment, config.observe, seed, known)
    seen = seen_voxels(frame, segment, cube, config.grid)
    view = ConditionedView(frame, segment, chosen, cube, seen, pose_known=known is not None)
    return Inference(view, prior, config, seed, limits=limits, callbacks=callbacks)


def infer_view(
    view: ConditionedView,
    prior: Prior,
    config: ControllerConfig,
    *,
    seed: int = 0,
    before: Posterior | None = None,
    limits: Limits = NO_LIMITS,
    callbacks: Callbacks = NO_CALLBACKS,
) -> Estimate:
    """Sample the posterior of a view and publish it. `before` is an interrupted posterior of the same view."""
    return _finished(Inference(view, prior, config, seed, before, limits, callbacks))


def _finished(inference: Inference) -> Estimate:
    inference.begin()
    while not inference.done:
        inference.step()
    return inference.estimate()
