"""Before a camera is opened: compile what its first frame would wait for, and keep the garbage collector short."""

import gc
from dataclasses import replace

import jax
import numpy as np

from perception.log import Log
from perception.segment import Segment, segment
from perception.source import SHIPPED_LOG, Frame
from perception.track import Tracker
from probnerf.infer import infer
from probnerf.types import FREE, UNKNOWN


def warm_up(tracker: Tracker) -> None:
    """Look at an object of the shipped recording with a tracker of the same prior and configuration: as it is there,
    half hidden, for which inference begins at the prior, and as if nothing stood before it, for which it climbs.

    Raises KeyboardInterrupt where Ctrl-C ended it, which the sampler may keep for itself.

    A full garbage collection stops every thread. Over what JAX keeps of its programs it takes 0.1 to 0.3 s, several
    periods of a camera, so what is there by then is set aside from it.
    """
    frame = next(iter(Log(SHIPPED_LOG)))
    hidden = segment(frame)[0]
    try:
        for seen in (_alone(hidden), hidden):
            trial = replace(tracker, _tracks={}, _names=set())
            update = trial.update(frame, seen, stages=1, on_answer=lambda _: None)
            if update.hypotheses.result == "interrupted":
                raise KeyboardInterrupt
            _go_on(trial, frame, seen)
    except ValueError:  # a prior of other objects: its own first frame compiles
        pass
    gc.collect()
    gc.freeze()


def _go_on(trial: Tracker, frame: Frame, segment: Segment) -> None:
    """What a next frame asks, and the sampler where the answer was cut short; to publish that needs nothing new."""
    look = trial.look(frame, segment)
    assert look is not None
    before, observation = trial._tracks[look.object_id].posterior, look._view.observation
    infer(jax.random.key(0), trial.prior.model, observation, trial.config.infer, before=before, stages=1)


def _alone(segment: Segment) -> Segment:
    """The segment as if all that was hidden of its surroundings had been seen empty."""
    status = np.where(segment.status == UNKNOWN, FREE, segment.status).astype(segment.status.dtype)
    return replace(segment, status=status, occluder=np.zeros_like(segment.occluder))
