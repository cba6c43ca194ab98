"""Stands for inference, after the real `observe`: keeps what it was asked, answers with the true mug."""

from types import SimpleNamespace
from typing import Any

from perception.inference.inference import Estimate
from perception.inference.settings import ControllerConfig
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
