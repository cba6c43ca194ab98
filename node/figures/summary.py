"""An object's answer in words, its numbers, and the sampler's diagnostics: for `replay`, `view` and the picture."""

import numpy as np
from jaxtyping import Float

from perception.answers.hypotheses import Hypotheses
from perception.answers.summary import MARGIN_M, Direction, Summary, Undecided, undecided
from probnerf.types import StopReason

CM3 = 1e6  # per cubic metre


def hidden_volume(h: Hypotheses) -> tuple[float, Float[np.ndarray, "3"]]:
    """Space in the cube above the plane that the camera did not see (m^3), and how much of it is solid (m^3): the 5, 50
    and 95% weighted quantiles over hypotheses.
    """
    hidden = h.unseen
    solid = h.solid[:, hidden].sum(axis=1) * h.voxel_m**3
    quantiles = np.quantile(solid, [0.05, 0.5, 0.95], weights=h.weights, method="inverted_cdf")
    return float(hidden.sum() * h.voxel_m**3), quantiles


def answer(s: Summary) -> str:
    """What a robot's user acts on, in one line: what it is, size, chance of a hidden part, next view."""
    width, depth, height = 100.0 * s.size_m
    chance = f"{s.p_sticks_out:.0%}" if s.p_sticks_out >= s.p_least else f"less than {s.p_least:.0%}"
    return (
        f"{_kinds(s)}about {width:.0f} × {depth:.0f} × {height:.0f} cm (width, depth, height); {chance} chance that "
        f"an unseen part reaches more than {100.0 * MARGIN_M:.0f} cm beyond what was seen; {_advice(s.next_view)}"
    )


def _kinds(s: Summary) -> str:
    """`vessel 80%, other 20%; `, the likeliest first; empty where nothing tells what it is."""
    likely = sorted(s.kinds.items(), key=lambda item: -item[1])
    named = ", ".join(f"{name} {p:.0%}" for i, (name, p) in enumerate(likely) if i == 0 or p >= 0.005)
    return f"{named}; " if named else ""


def _advice(view: Direction | None) -> str:
    if view is None:
        return "another view would tell little"
    places = {"front": "the front", "left": "the left", "back": "behind", "right": "the right"}
    above = {"front": "above", "left": "above on the left", "back": "above and behind", "right": "above on the right"}
    return f"look next from {(above if view.above else places)[view.side]}"


def figures(h: Hypotheses) -> dict[str, str]:
    """The answer's numbers with units, in the order of reading."""
    space, (low, middle, high) = hidden_volume(h)
    return {
        "unseen space": f"{CM3 * space:.0f} cm³",
        "solid in it": f"{CM3 * middle:.0f} cm³ ({CM3 * low:.0f} to {CM3 * high:.0f})",
        "undecided": _doubt(undecided(h)),
        "hypotheses": f"{len(h.weights)} ({h.effective_hypotheses:.1f} effective)",
    }


def _doubt(part: Undecided | None) -> str:
    """Where shapes disagree most."""
    if part is None:
        return "no part of it"
    places = {"front": "in front", "left": "on the left", "back": "behind", "right": "on the right"}
    where = "in its middle" if part.side is None else places[part.side]
    return f"{CM3 * part.volume_m3:.0f} cm³ {where} (25 to 75%)"


def diagnostics(h: Hypotheses) -> dict[str, str]:
    """Numbers about the sampler, for those who tune it."""
    d = h.diagnostics
    evidence, error = d.log_evidence, d.log_evidence_se
    populations = len(np.unique(h.population)) + h.failed
    return {
        "stopped": f"{h.result}, stage {h.stage}",
        "ESS": _number(d.ess, ".0f"),
        "log evidence": f"{evidence:.1f} ± {_number(error, '.1f')} nats" if np.isfinite(evidence) else "none",
        "acceptance": _number(d.acceptance, ".2f"),
        "R-hat": _number(d.r_hat, ".2f"),
        "divergences": _number(d.divergences, ".0f"),
        "failed populations": f"{h.failed} of {populations}",
    }


def unexplained(h: Hypotheses) -> str:
    """Why an answer is flagged `out_of_model`: the object, or too little time."""
    if h.result in (StopReason.CONVERGED, StopReason.UNDERWAY):
        return "out of model: no shape of the prior explains this view"
    cut = f"no shape found so far explains this view: the sampler was cut short ({h.result})"
    return f"{cut}; give it more time, and check the camera's matrix if that does not help"


def warnings(h: Hypotheses) -> list[str]:
    """What makes the answer doubtful, and what to do about it."""
    lines = []
    if h.out_of_model:
        lines.append(f"{unexplained(h)}; queries answer with caution")
    elif h.result == StopReason.BUDGET:
        lines.append(
            "the time was up before the sampler converged: the answer is less certain than it can be; raise the budget"
        )
    if (share := h.object_frame.sight_sigma) > 0.0:
        known = f"distance and size are known to {100 * share:.1f}%"
        if h.object_frame.along_sigma > 0.0:
            alone = "from the camera's height and tilt alone; measure these well, or use a depth camera"
            lines.append(f"no depth: {known}, {alone}")
        else:
            lines.append(f"{known}, the stated error of depth's scale")
    if not h.inside_view:
        lines.append("the picture's border cuts the object off: move the camera until all of it is in the picture")
    if h.alone:
        lines.append(
            f"the answer rests on one of {h.failed + 1} populations, the others failed: its error is not known, and "
            'queries answer "unsure"; take another view, or repeat with another seed'
        )
    return lines


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "none"
