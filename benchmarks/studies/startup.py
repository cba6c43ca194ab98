"""Seconds of a start: from a new process to a node that may open its camera, with an empty and a filled cache.

The process does what `farside live` does before its first frame: it imports, loads the prior, and rehearses inference,
whose programs are read or compiled and not run. Their first run costs the first object more. So its first three stages
(and their answers) are timed beside those of the same object once more.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.harness.intervals import mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table

PARTS = ("imports", "prior", "programs", "whole")
OBJECTS = ("first_object", "again")
EMPTY, FILLED = "empty cache", "filled cache"


def _start(begun: float) -> dict[str, float]:
    """Seconds of each part, in this new process, which the parent began at `begun` (time.time)."""
    from perception.inference.tracker import Tracker
    from perception.inference.warm_up import warm_up
    from perception.observation.segmentation import segment
    from perception.sources.recording import Log
    from perception.sources.settings import SHIPPED_LOG
    from probnerf.prior.checkpoint import load_prior

    imported = time.time()
    prior = load_prior(None)
    loaded = time.time()
    warm_up(Tracker(prior))
    ready = time.time()
    frame = next(iter(Log(SHIPPED_LOG)))
    found, ends = segment(frame)[0], [time.time()]
    for _ in OBJECTS:
        Tracker(prior).update(frame, found, stages=3, on_answer=lambda _: None)
        ends.append(time.time())
    parts = (imported - begun, loaded - imported, ready - loaded, ready - begun, *np.diff(ends))
    return dict(zip((*PARTS, *OBJECTS), map(float, parts), strict=True))


def _started(cache: str) -> dict[str, float]:
    """`_start` in a new process that compiles into `cache`."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, "FARSIDE_PROGRAMS": cache}
    command = [sys.executable, "-m", "benchmarks.studies.startup", str(time.time())]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} ended with {run.returncode}:\n{run.stderr[-2000:]}")
    return json.loads(run.stdout.splitlines()[-1])


@dataclass(frozen=True)
class Options(TableOptions):
    """Seconds from a new process to a node that may open its camera."""

    n: int = 5
    """Starts with a filled cache."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    with tempfile.TemporaryDirectory() as cache:
        found = {EMPTY: [_started(cache)]}
        say(f"{EMPTY}: {found[EMPTY][0]['whole']:.1f} s")
        found[FILLED] = [_started(cache) for _ in range(1 if options.quick else options.n)]
    rows, lines = [], []
    for condition, starts in found.items():
        for part in (*PARTS, *OBJECTS):
            rows += mean_rows("startup", "node", condition, part, [s[part] for s in starts], "s")
        medians = (f"{np.median([s[part] for s in starts]):.1f}" for part in (*PARTS, *OBJECTS))
        lines.append([condition, str(len(starts)), *medians])
    return Summary(rows, [Table("Seconds of a start, medians", ("condition", "starts", *PARTS, *OBJECTS), lines)])


if __name__ == "__main__":
    print(json.dumps(_start(float(sys.argv[1]))))
