"""How many runs of the sampler an answer takes, given what the runs so far found."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Findings:
    """Findings of all runs so far together."""

    runs: int
    expected_loss: float  # nats per voxel of unseen space, from having few populations (NaN: unknown)
    unexplained: float  # share of the informative pixels that the shapes do not explain, 0 to 1


def runs_wanted(found: Findings, most: int, tolerance: float, unexplained: float) -> int:
    """How many runs the answer takes, `found.runs` at least and `most` at most.

    The expected loss falls as 1 over the number of runs: where n runs lose l, n l / tolerance runs lose the tolerance
    (nats a voxel). Where shapes leave a larger share of the pixels than `unexplained` unexplained, or the loss is not
    known, all runs that may be made are wanted. An infinite tolerance accepts any loss, known or not.
    """
    if found.unexplained > unexplained:
        return most
    if found.expected_loss <= tolerance or math.isinf(tolerance):
        return found.runs
    if tolerance == 0.0 or not math.isfinite(found.expected_loss):
        return most
    enough = math.ceil(min(found.runs * found.expected_loss / tolerance, most))
    return min(most, max(found.runs + 1, enough))
