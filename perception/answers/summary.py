"""Summary of an object: its size, whether a hidden part sticks out, and where to look next."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from perception.answers.hypotheses import Hypotheses
from perception.answers.next_view import rank_views
from perception.answers.occupied_space import edge_lengths
from perception.answers.query import CAUTION
from probnerf.rendering.occupancy import voxel_centres

MARGIN_M = 0.01  # a part counts where it reaches farther than this beyond what was seen
_ABOVE = 60.0  # degrees; a view from higher is one from above
_DOUBT = 0.25  # a voxel is undecided where its probability is at least this far from 0 and 1
_SIDES: tuple["Side", ...] = ("front", "right", "back", "left")  # y points to the right of a camera that looks along -x
_LEAST_GAIN = 0.05  # nats; least expected gain of a next view that is suggested

Side = Literal["front", "left", "back", "right"]


@dataclass(frozen=True)
class Direction:
    """Direction of a camera, relative to the camera that saw the object and the object's upright axis."""

    side: Side  # of the object: "front" is the side that was seen, left and right are the picture's
    above: bool  # more than 60 degrees above the support plane
    gain_nats: float  # expected information gain of the picture from there


@dataclass(frozen=True)
class Undecided:
    """The largest unseen part of an object about which its shapes disagree."""

    volume_m3: float
    side: Side | None  # of the object's upright axis; None: about the axis


@dataclass(frozen=True, eq=False)
class Summary:
    """An object in a few numbers."""

    size_m: Float[np.ndarray, "3"]  # width (across the picture), depth (along the line of sight) and height
    p_sticks_out: float  # probability that an unseen part reaches more than 1 cm beyond what was seen
    p_sticks_out_se: float  # its Monte Carlo standard error
    p_least: float  # rule of succession: least probability that the number of hypotheses supports
    next_view: Direction | None  # None: no view has enough expected gain
    kinds: Mapping[str, float] = field(default_factory=dict)  # probabilities of what it is; empty: not known


def summarise(h: Hypotheses) -> Summary:
    """Size, hidden parts and next view of one object (`size`, `sticks_out`, `next_view`)."""
    p, se = h.estimate(sticks_out(h))
    if h.out_of_model:  # as in a query: with this weight all that was not seen is occupied
        p, se = (1 - CAUTION) * p + CAUTION, (1 - CAUTION) * se
    witnesses = 1.0 if h.alone else h.effective_hypotheses
    return Summary(size(h), float(p), float(se), 1.0 / (witnesses + 2.0), next_view(h), h.kinds)


def size(h: Hypotheses) -> Float[np.ndarray, "3"]:
    """Width, depth and height (m): per axis of the object frame the weighted median of the shapes' extents."""
    x, y, z = edge_lengths(h)
    return np.array([y, x, z])


def sticks_out(h: Hypotheses, margin_m: float = MARGIN_M) -> Bool[np.ndarray, "S"]:
    """Whether each hypothesis has an unseen part that reaches more than `margin_m` beyond what was seen.

    What was seen of a hypothesis is its solid voxels that are `seen`. They and their mirror image about its own upright
    axis (its pose's x and y) span a box along the object frame's axes: where the far side of the body is, if it is like
    the near side. A voxel sticks out if it is solid and unseen, and its centre is farther than the margin outside that
    box, to a side or above. So the back of a can does not count, and a handle behind a mug does.
    """
    centres = voxel_centres(h.grid)
    margin, width = margin_m / h.object_frame.half_extent, 2.0 / h.grid
    out = np.zeros(len(h.weights), bool)
    for s, shape in enumerate(h.solid):
        surface, hidden = centres[shape & h.seen], centres[shape & h.unseen]
        if not len(surface) or not len(hidden):
            out[s] = len(hidden) > 0
            continue
        axis = h.pose[s, 1:3]
        reach = np.abs(surface[:, :2] - axis).max(axis=0) + 0.5 * width
        top = surface[:, 2].max() + 0.5 * width
        out[s] = (np.abs(hidden[:, :2] - axis) > reach + margin).any() or (hidden[:, 2] > top + margin).any()
    return out


def next_view(h: Hypotheses) -> Direction | None:
    """Where the best of the views around the object is (`rank_views`); None where it promises less than 0.05 nats."""
    views = rank_views([h], count=1)
    gain = float(views.gain_nats[0])
    if gain < _LEAST_GAIN:
        return None
    x, y, z = views.T_object_camera[0, :3, 3]
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    return Direction(_SIDES[round(azimuth / 90.0) % 4], bool(elevation > _ABOVE), gain)


def undecided(h: Hypotheses) -> Undecided | None:
    """The largest connected unseen region above the plane in which every voxel is solid in 1/4 to 3/4 of the weight.

    Sheets of one voxel are left out: a wall is never known better. None: no such region.
    """
    doubtful = h.unseen & (np.abs(h.p_occupied - 0.5) <= 0.5 - _DOUBT)
    parts, count = ndimage.label(ndimage.binary_opening(doubtful, np.ones((2, 2, 2))))
    if not count:
        return None
    part = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    x, y, _ = voxel_centres(h.grid)[part].mean(axis=0) - [*(h.weights @ h.pose[:, 1:3]), 0.0]
    beside = np.hypot(x, y) * h.object_frame.half_extent > MARGIN_M
    side = _SIDES[round(np.degrees(np.arctan2(y, x)) / 90.0) % 4] if beside else None
    return Undecided(float(part.sum() * h.voxel_m**3), side)
