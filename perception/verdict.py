"""Free, occupied, or no answer: what an answer's probability allows at a risk that the asker is ready to run."""

import math
from typing import Literal

from perception.query import QueryResult

Verdict = Literal["free", "occupied", "unsure"]


def verdict(result: QueryResult, risk: float = 0.05) -> Verdict:
    """Free or occupied where the chance of being wrong is at most `risk` in (0, 0.5), else unsure.

    The chance counts what so few hypotheses can tell: with n effective ones that all agree it is 1 / (n + 2) (the rule
    of succession), so that a risk below that is never answered. Of a region that reaches out of every object's cube
    nothing is called free: nobody looked there. Raises ValueError for another risk.
    """
    if not 0.0 < risk < 0.5:
        raise ValueError(f"risk is {risk:g}; give the chance of being wrong that you accept, above 0 and below 0.5")
    n = result.effective_hypotheses
    p_free = (n * result.p_free + 1.0) / (n + 2.0) if math.isfinite(n) else result.p_free
    if 1.0 - p_free <= risk:
        return "free" if result.outside_fraction == 0.0 else "unsure"
    return "occupied" if p_free <= risk else "unsure"
