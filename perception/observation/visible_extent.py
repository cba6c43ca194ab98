"""Place and size of a body on its plane, from the points of it that are seen."""

import numpy as np
from jaxtyping import Bool, Float

_LOOKS_DOWN = np.radians(8.0)  # least angle at which a top's far side can be distinguished from its near side
_PROTRUDES = 1.36  # half widths from the axis: the prior's handles and spouts end here (`tabletop_sampler.REACH_LIMIT`)


def visible_body(
    seen: Float[np.ndarray, "n 3"], hidden: Bool[np.ndarray, "n"], camera_height: float
) -> tuple[Float[np.ndarray, "2"], float, float, bool]:
    """Horizontal centre, width and height (m) of a body from its visible points (x to the camera, y, height; m).

    Where the camera looks down on the top (the last answer), the top's chords have the axis in their middle, and
    medians over chords pass over handles and spouts. Where it does not, only the near side is seen, and the axis is
    half a width behind it, as in a body of revolution. A side that borders on something `hidden` is not the body's end:
    then the axis is half a width, taken from the top's depth, from the other side.

    Where more than a handle or spout protrudes (a hammer's shaft, a pan's handle, an animal's body behind its head),
    there is no such body: then centre and width are of all that is seen.
    """
    x, y, z = seen.T
    height = float(np.percentile(z, 99))
    low, high, low_cut, high_cut = _extents(y, z, hidden)
    middle, length = (low + high) / 2, high - low
    centre_y = float(np.median(middle[length <= np.median(length)]))  # a handle at the side reaches over other heights
    radius = float(np.percentile(np.minimum(centre_y - low, high - centre_y), 90))  # and over one side alone
    front = np.abs(y - centre_y) < 0.35 * radius
    centre_x = float(np.percentile(x[front] if front.any() else x, 95)) - radius
    width = 2.0 * radius
    top = z > height - max(0.01, 0.1 * height)
    top_seen = bool(np.arctan2(camera_height - height, -np.median(x)) > _LOOKS_DOWN and top.sum() > 50)
    if top_seen:
        back, near, _, _ = _extents(x[top], y[top], hidden[top])
        left, right, _, _ = _extents(y[top], x[top], hidden[top])
        centre_x, centre_y = float(np.median(back + near)) / 2, float(np.median(left + right)) / 2
        # The longest side in any direction: most chords of a box, some of a disc, few of a handle are that long.
        for angle in np.radians(np.arange(0.0, 180.0, 15.0)):
            along, over = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
            start, end, _, _ = _extents(along[top], over[top], hidden[top])
            width = max(width, float(np.percentile(end - start, 70)))
    if (low_cut.mean() > 0.4) != (high_cut.mean() > 0.4):
        at_high = high_cut.mean() > 0.4
        centre_y = float(np.percentile(low, 30)) + width / 2 if at_high else float(np.percentile(high, 70)) - width / 2
    centre, across = np.array([centre_x, centre_y]), seen[:, :2]
    reach = float(np.percentile(np.linalg.norm(across - centre, axis=1), 98))
    if reach > _PROTRUDES * max(width, height) / 2:
        centre, width, _ = whole_extent(across)
    return centre, width, height, top_seen


def whole_extent(across: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float, float]:
    """Middle, longest and shorter side of the smallest of the rectangles about points (1% left out at each end)."""
    angle = np.radians(np.arange(0.0, 90.0, 5.0))
    axes = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    axes = np.stack([axes, axes[:, ::-1] * [-1.0, 1.0]], axis=1)  # [angle, axis, 2]
    low, high = np.percentile(across @ np.swapaxes(axes, 1, 2), [1, 99], axis=1)  # [angle, axis]
    best = int(np.argmin(np.prod(high - low, axis=1)))
    sides = (high - low)[best]
    return ((low + high)[best] / 2) @ axes[best], float(sides.max()), float(sides.min())


def _extents(
    along: Float[np.ndarray, "n"], over: Float[np.ndarray, "n"], hidden: Bool[np.ndarray, "n"], bins: int = 12
) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b"], Bool[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
    """Ends of the points' extent in one coordinate, in equal bins of another, and whether the ends border on hidden."""
    low, high = np.percentile(over, [1, 99])
    at = np.floor((over - low) / max(high - low, 1e-9) * bins)
    rows = []
    for inside in [at == b for b in range(bins) if (at == b).sum() >= 5] or [at == at]:
        first, last = np.percentile(along[inside], [1, 99])
        margin = 0.05 * (last - first)
        cuts = [hidden[inside & end].mean() > 0.3 for end in (along <= first + margin, along >= last - margin)]
        rows.append((first, last, *cuts))
    first, last, first_cut, last_cut = np.array(rows).T
    return first, last, first_cut > 0, last_cut > 0
