"""The page's texts as HTML: legends, the answer about a box, and warnings about the scene."""

import time
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from node.figures import voxel_renderer
from node.figures.query_answer import rows
from node.figures.summary import warnings
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import QueryResult
from probnerf.types import StopReason

OCCUPIED = ("#fff1d6", "#fdbb84", "#ef6548", "#990000")  # p_occupied from 0 to 1
DISAGREEMENT = ("#fde8ee", "#fa9fb5", "#c51b8a", "#49006a")  # entropy from 0 to log 2
GAIN = ("#c7d7ea", "#08519c")  # expected information gain of a next view, from 0 to the best one's
SCALES = {  # colour scales of the cloud: the ramp, its title and the labels of its ends
    "probability occupied": (OCCUPIED, ("probability that unseen space is occupied", "0", "1")),
    "disagreement": (DISAGREEMENT, ("disagreement: entropy over log 2", "all agree", "evenly split")),
}
LAYERS = {  # parts that can be hidden: label, scene node
    "hypothesis": "/shapes",
    "unseen space": "/unseen",
    "seen points": "/seen",
    "camera": "/camera",
    "support plane": "/plane",
    "box": "/ask",
    "next views": "/next",
}
FREE, BLOCKED = "#1a9850", "#d73027"
_STOPPED = {
    StopReason.CONVERGED: "the sampler finished",
    StopReason.BUDGET: "the time was up before the sampler finished",
    StopReason.STAGES: "stopped at the requested number of stages",
    StopReason.STOPPED: "stopped by the calling program",
    StopReason.INTERRUPTED: "stopped by the user",
    StopReason.UNDERWAY: "the sampler is still running",
}


# what a verdict at the usual risk (`QueryResult.verdict`, as `farside query` gives it) means
MEANING = {
    "free": "all of the box is free, at a risk of 5%",
    "occupied": "something is in the box, at a risk of 5%",
    "unsure": "more than 5% chance of being wrong, or a part of the box that nobody looked at",
    "unseen": "nobody looked there: no object's shapes were inferred in the box",
}


def box(inner: str, size: str = "13px") -> str:
    """A paragraph of the panel."""
    return f'<div style="padding:2px 12px;font-size:{size};line-height:1.45">{inner}</div>'


def answer(result: QueryResult, centre: Float[np.ndarray, "3"], size: Float[np.ndarray, "3"], frame: str) -> str:
    """The answer about a box: the probability that it is free in large, and its corners to repeat the question."""
    grey = 'style="color:#666;padding-right:8px;vertical-align:top"'
    cells = "".join(f"<tr><td {grey}>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in rows(result)[1:])
    corners = " ".join(f"{v:.3f}" for v in (*(centre - 0.5 * size), *(centre + 0.5 * size)))
    return box(
        f'<div style="font-size:22px;font-weight:600;color:{paint(result)}">{odds(result)}</div>'
        f'<div style="color:#666">{escape(MEANING[result.verdict()])}</div><table>{cells}</table>'
        f'<div style="color:#666;font-size:11px">frame {escape(frame)}: <code>--box {corners}</code></div>'
    )


def odds(result: QueryResult) -> str:
    """The verdict, and P(free) with its standard error."""
    verdict = result.verdict()
    return verdict if verdict == "unseen" else f"{verdict}: P(free) = {result.p_free:.2f} ± {result.p_free_se:.2f}"


def paint(result: QueryResult) -> str:
    """The box's colour: free, occupied, or neither (amber)."""
    return {"free": FREE, "occupied": BLOCKED}.get(result.verdict(), "#d08700")


def rgb(colour: str) -> tuple[int, int, int]:
    """A hexadecimal colour as 0 to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def hypothesis(rank: int, count: int, weight: float) -> str:
    """Which hypothesis is shown; rank from 1."""
    return f"hypothesis {rank} of {count}, weight {100 * weight:.1f}%"


def surfaces() -> str:
    """What the meshes' colours mean."""
    seen, unseen = (
        "#" + bytes(np.round(255 * c).astype(np.uint8)).hex() for c in (voxel_renderer.SEEN, voxel_renderer.UNSEEN)
    )
    return box(_patches([(seen, "surface that the camera saw"), (unseen, "supposed: out of its sight")]))


def statuses() -> str:
    """What the picture's tints mean."""
    return box(_patches([(colour, name) for name, colour in voxel_renderer.STATUS.values()], "  "))


def scale(ramp: Sequence[str], title: str, low: str, high: str) -> str:
    """A bar of colours with its ends named."""
    return box(
        f"<div>{escape(title)}</div>"
        f'<div style="height:12px;border-radius:3px;background:linear-gradient(to right,{",".join(ramp)})"></div>'
        f'<div style="display:flex;justify-content:space-between;color:#666"><span>{escape(low)}</span>'
        f"<span>{escape(high)}</span></div>"
    )


def state(scene: Sequence[Hypotheses], now_ns: int | None = None) -> str:
    """For each object the warnings, the progress of inference, its Monte Carlo error and its age, in plain words."""
    lines = []
    for h in scene:
        name = f"object {h.object_id}" + (f" ({escape(h.label)})" if h.label else "")
        lines.append(f"<b>{name}</b>")
        if h.out_of_model:
            lines.append(_marked("OUT OF MODEL", BLOCKED))
        lines += [f'<span style="color:#a04000">⚠ {escape(line)}</span>' for line in warnings(h)]
        if not warnings(h):
            lines.append(f'<span style="color:{FREE}">✓ no doubts raised</span>')
        lines.append(f"after stage {h.stage}; {_STOPPED[h.result]}")
        lines.append(
            f"{len(h.weights)} hypotheses, {h.effective_hypotheses:.1f} effective; Monte Carlo error "
            f"±{h.monte_carlo_error:.3f} of the mean unseen occupancy"
        )
    first = scene[0]
    lines.append(f'<span style="color:#666">{escape(first.frame_id)}, {age(first.stamp_ns, now_ns)}</span>')
    return box("<br>".join(lines), "12px")


def views(gains: Sequence[float], entropy: float) -> str:
    """Ranked next views with their expected information gain, and the largest possible gain (nats)."""
    lines = [f"<b>{i}</b>&ensp;+{gain:.2f} nats" for i, gain in enumerate(gains, start=1)]
    first = f"expected information gain of a picture from there (of {entropy:.2f} nats at most):"
    return box("<br>".join([first, *lines]))


def age(stamp_ns: int, now_ns: int | None = None) -> str:
    """How long ago a frame was taken."""
    if stamp_ns <= 0:
        return "a frame without a time"
    seconds = ((time.time_ns() if now_ns is None else now_ns) - stamp_ns) * 1e-9
    for unit, length in (("days", 86_400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit} old"
    return f"{seconds:.1f} s old"


def _patches(entries: Sequence[tuple[str, str]], between: str = "<br>") -> str:
    square = (
        '<span style="display:inline-block;width:11px;height:11px;border-radius:2px;margin-right:5px;background:{}">'
    )
    return between.join(f"{square.format(colour)}</span>{escape(name)}" for colour, name in entries)


def _marked(text: str, colour: str) -> str:
    return f'<span style="background:{colour};color:#fff;padding:1px 6px;border-radius:3px">{text}</span>'
