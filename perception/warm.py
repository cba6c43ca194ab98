"""Before a camera is opened: compile what its first frame would wait for, and keep the garbage collector short."""

import gc
from dataclasses import replace

from perception.log import Log
from perception.segment import segment
from perception.source import SHIPPED_LOG
from perception.track import Tracker


def warm_up(tracker: Tracker) -> None:
    """Look at an object of the shipped recording with a tracker of the same prior and configuration.

    Raises KeyboardInterrupt where Ctrl-C ended it, which the sampler may keep for itself.

    A full garbage collection stops every thread. Over what JAX keeps of its programs it takes 0.1 to 0.3 s, several
    periods of a camera, so what is there by then is set aside from it.
    """
    frame = next(iter(Log(SHIPPED_LOG)))
    trial = replace(tracker, _tracks={}, _names=set())
    try:
        for _ in range(2):  # an answer that was cut short is gone on with
            update = trial.update(frame, segment(frame)[0], stages=1, on_answer=lambda _: None)
            if update.hypotheses.result == "interrupted":
                raise KeyboardInterrupt
    except ValueError:  # a prior of other objects: its own first frame compiles
        pass
    gc.collect()
    gc.freeze()
