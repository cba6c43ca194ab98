"""What is said of an object in a few numbers: the same in `replay`'s table, in `view` and under the picture."""

import numpy as np
from jaxtyping import Float

from perception.answers.hypotheses import Hypotheses

CM3 = 1e6  # per cubic metre
R_HAT = 1.1  # above it chains have not mixed (Gelman et al., BDA3, section 11.4)


def hidden_volume(h: Hypotheses) -> tuple[float, Float[np.ndarray, "3"]]:
    """Space in the cube above the plane that the camera did not see (m^3), and how much of it is solid (m^3): the 5, 50
    and 95% weighted quantiles over hypotheses.
    """
    hidden = h.unseen
    solid = h.solid[:, hidden].sum(axis=1) * h.voxel_m**3
    quantiles = np.quantile(solid, [0.05, 0.5, 0.95], weights=h.weights, method="inverted_cdf")
    return float(hidden.sum() * h.voxel_m**3), quantiles


def figures(h: Hypotheses) -> dict[str, str]:
    """Short names and values with units, in the order of reading."""
    space, (low, middle, high) = hidden_volume(h)
    d = h.diagnostics
    evidence, error = d.get("log_evidence", np.nan), d.get("log_evidence_se", np.nan)
    return {
        "hypotheses": f"{len(h.weights)} ({h.effective_hypotheses:.1f} effective)",
        "ESS": _number(d.get("ess", np.nan), ".0f"),
        "log evidence": f"{evidence:.1f} ± {_number(error, '.1f')} nats" if np.isfinite(evidence) else "none",
        "unseen space": f"{CM3 * space:.0f} cm³",
        "solid in it": f"{CM3 * middle:.0f} cm³ ({CM3 * low:.0f} to {CM3 * high:.0f})",
        "acceptance": _number(d.get("acceptance", np.nan), ".2f"),
        "stopped": f"{h.result}, stage {h.stage}",
    }


def unexplained(h: Hypotheses) -> str:
    """Why an answer that is flagged `out_of_model` is: the object, or too little time to tell."""
    if h.result in ("converged", "underway"):
        return "out of model: no shape of the prior explains this view"
    return f"no shape found so far explains this view: the sampler was cut short ({h.result}); give it more time"


def warnings(h: Hypotheses) -> list[str]:
    """What makes the answer doubtful, if anything."""
    out = []
    if h.out_of_model:
        out.append(f"{unexplained(h)}; its answers are cautious")
    if (share := h.object_frame.sight_sigma) > 0.0:
        out.append(f"no depth: distance and size are known to {100 * share:.1f}% by the camera's height and tilt alone")
    if not h.inside_view:
        out.append("the picture's border cuts the object off")
    if (r_hat := h.diagnostics.get("r_hat", np.nan)) > R_HAT:
        out.append(f"the sampler's populations disagree (R-hat {r_hat:.2f}): other shapes may fit too")
    left = len(np.unique(h.population))
    if h.failed >= left:
        unknown = ": how far off it may be is not known" if h.alone else ""
        out.append(
            f"the answer rests on {left} of the sampler's {h.failed + left} populations; the others failed{unknown}"
        )
    if h.diagnostics.get("divergences", 0.0) > 0:
        out.append(f"{h.diagnostics['divergences']:.0f} divergent trajectories")
    return out


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else "none"
