"""Before a camera is opened: compile the programs of the first frame, and keep the garbage collector's pauses short."""

import gc
from dataclasses import replace

import jax
import numpy as np

from perception.inference.limits import Callbacks, Limits
from perception.inference.tracker import Look, Tracker
from perception.observation.segmentation import Segment, segment
from perception.sources.frame import Frame
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.compile_cache import rehearsal
from probnerf.inference import infer, suited
from probnerf.network_start import network_used
from probnerf.pixel_status import FREE, UNKNOWN
from probnerf.types import Posterior, StopReason


def warm_up(tracker: Tracker) -> None:
    """Infer an object of the shipped recording with a tracker of the same prior and configuration. Infer it once as if
    nothing occluded it (inference climbs), and once half hidden, as recorded (inference begins at the prior). With a
    posterior network both begin at the same place, and once is enough. It is a rehearsal: cached programs
    (`probnerf.compile_cache`) are read, others are compiled, and none is run.

    Raises KeyboardInterrupt if Ctrl-C ended it, even if the sampler caught it.

    A full garbage collection stops every thread. With the objects that JAX keeps for its programs it takes 0.1 to
    0.3 s, several periods of a camera. So the objects that exist by then are excluded from it.
    """
    frame = next(iter(Log(SHIPPED_LOG)))
    hidden = segment(frame)[0]
    trial = replace(tracker, _tracks={}, _names=set())
    with rehearsal():
        try:
            look = trial.look(frame, _alone(hidden))
        except ValueError:  # a prior of other objects: its own first frame compiles
            look = None
        if look is not None:
            _infer_twice(trial, look, frame, hidden)
    gc.collect()
    gc.freeze()


def _infer_twice(trial: Tracker, look: Look, frame: Frame, hidden: Segment) -> None:
    """The object alone, the same continued after an interruption, and half hidden where that begins elsewhere."""
    update = trial.infer(look, Limits(stages=1), Callbacks(on_answer=lambda _: None))
    if update.hypotheses.result == StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    again = trial.look(frame, _alone(hidden))
    assert again is not None
    _sampled(trial, again, trial._tracks[again.object_id].posterior)  # as for a next frame
    if network_used(trial.config.infer, trial.prior) is not None:
        return
    anew = trial.look(frame, hidden, lambda _: (0, True))
    assert anew is not None  # publishing it needs no new programs
    _sampled(trial, anew, _sampled(trial, anew, None))


def _sampled(trial: Tracker, look: Look, before: Posterior | None) -> Posterior:
    """One stage, from an answer that was cut short or from the prior."""
    observation = look._view.every_choice
    key, config = jax.random.key(0), suited(trial.config.infer, trial.prior.model)
    posterior, _ = infer(key, trial.prior.model, observation, config, before=before, stages=1)
    if posterior.result == StopReason.INTERRUPTED:
        raise KeyboardInterrupt
    return posterior


def _alone(segment: Segment) -> Segment:
    """The segment as if all that was hidden of its surroundings had been seen empty."""
    status = np.where(segment.status == UNKNOWN, FREE, segment.status).astype(segment.status.dtype)
    return replace(segment, status=status, occluder=np.zeros_like(segment.occluder))
