"""Open vessels: the near outer wall and what is seen over its rim, the far inner wall, are one thing."""

import numpy as np
from jaxtyping import Float

from perception.observation.support_plane import heights, horizontal, noise_growth

_LAYER = 0.008  # m; a level face lies within this of its height, up to 1 m from the camera
_ASIDE = 0.2  # of the width: how far what is inside may reach beyond the outer wall, to each side
_HIGHER = 0.015  # m; and above its rim


def is_inside(
    inner: Float[np.ndarray, "n 3"], outer: Float[np.ndarray, "m 3"], plane: Float[np.ndarray, "4"], focal: float
) -> bool:
    """Whether one cloud (camera frame, m) is the inside of the vessel whose outer wall is the other.

    A camera that looks down on a closed thing sees the face on its top. Where that face is missing, the thing is open,
    and what is seen over its rim no farther behind it than it is wide is its inside. `focal` is the camera's, px.
    """
    height = heights(outer, plane)
    top = float(np.percentile(height, 98))
    rim = outer[height > top - 0.25 * top]
    axes = horizontal(plane)
    away = axes @ np.median(rim, axis=0)  # from the camera's foot
    away /= max(float(np.linalg.norm(away)), 1e-9)
    aside = np.array([-away[1], away[0]])
    low, high = np.percentile(rim @ axes.T @ aside, [1, 99])
    width = high - low
    distance = float(np.median(np.linalg.norm(rim, axis=1)))
    sine = (plane[3] - top) / distance
    if width <= 0.0 or sine < 0.1:  # no face could be seen
        return False
    growth = float(np.median(noise_growth(rim)))
    scale = (focal / distance) ** 2  # px of a square metre that faces the camera
    face, wall = 0.25 * np.pi * width**2 * sine * scale, width * _LAYER * growth * scale
    if np.count_nonzero(height > top - _LAYER * growth) > 1.5 * wall + 0.25 * face:
        return False
    sides = inner @ axes.T @ aside
    margin = _ASIDE * width
    between = (sides > low - margin) & (sides < high + margin)
    behind = inner @ axes.T @ away - float(np.median(rim @ axes.T @ away))
    return bool(
        between.mean() > 0.95
        and np.percentile(heights(inner, plane), 98) < top + max(_HIGHER * growth, 0.1 * width)
        and -0.1 * width < np.median(behind) < width
        and np.percentile(behind, 95) < 1.2 * width
    )
