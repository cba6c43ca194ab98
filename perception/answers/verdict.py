"""Free, occupied, or no answer: what an answer's probability allows at a risk that the asker is ready to run."""

from typing import Literal

from perception.answers.query import QueryResult

Verdict = Literal["free", "occupied", "unsure"]


def verdict(result: QueryResult, risk: float = 0.05) -> Verdict:
    """Free or occupied where the hypotheses' chance of being wrong is at most `risk` in (0, 0.5), else unsure.

    The chance counts what so few hypotheses can tell: of one object, n effective ones that all agree leave 1 / (n + 2)
    (the rule of succession), so that a risk below that is never answered. Nothing is called free that reaches out of
    every object's cube, or into the table: nobody looked there. How often such calls are wrong of real unseen space is
    measured by `farside bench calibration`. Raises ValueError for another risk.
    """
    if not 0.0 < risk < 0.5:
        raise ValueError(f"risk is {risk:g}; give the chance of being wrong that you accept, above 0 and below 0.5")
    if 1.0 - result.p_free_few <= risk:
        return "free" if result.outside_fraction == 0.0 else "unsure"
    return "occupied" if result.p_free_few <= risk else "unsure"
