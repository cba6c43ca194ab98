"""What the views of a calibration cover (places in the picture, tilts, distances), and which view to take next."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from calibration.calibrate import tilts
from calibration.fit import FittedView

GRID = (8, 6)  # cells over the picture's width and height
_TILT = 15.0  # degrees; a lean that counts
_FILLED = 0.6  # of the cells of a ninth of the picture
_NEAR = 0.25  # of the picture's area under the board: a near view
_RATIO = 1.5  # farthest to nearest distance
_FEW = 10  # views
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "middle", "right")
_SIDES = ("right side", "left side", "lower side", "upper side")


@dataclass(frozen=True, eq=False)
class Coverage:
    """Where, how tilted and how far the board was seen."""

    counts: Int[np.ndarray, "6 8"]  # corners per cell of the picture
    tilts: Float[np.ndarray, "v 2"]  # degrees: right side away, lower side away
    distances: Float[np.ndarray, "v"]  # m, along the camera's axis
    areas: Float[np.ndarray, "v"]  # share of the picture that lies under the corners

    def __str__(self) -> str:
        share = float((self.counts > 0).mean())
        lean = np.linalg.norm(self.tilts, axis=1)
        return (
            f"{100 * share:.0f}% of the picture, tilts {lean.min():.0f} to {lean.max():.0f} degrees,"
            f" distances {self.distances.min():.2f} to {self.distances.max():.2f} m"
        )


def coverage(views: Sequence[FittedView], size: tuple[int, int]) -> Coverage:
    """The coverage of fitted views in pictures of `size` (width, height; px)."""
    pixels = np.concatenate([f.view.pixels for f in views])
    counts = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=GRID[::-1], range=[[0, size[1]], [0, size[0]]])[0]
    middles = np.array([f.T_camera_board[:3, :3] @ f.view.points.mean(axis=0) + f.T_camera_board[:3, 3] for f in views])
    # A set of points in a parallelogram of area A has a covariance of determinant (A / 12)^2.
    areas = np.array([12.0 * np.sqrt(max(np.linalg.det(np.cov(f.view.pixels.T)), 0.0)) for f in views])
    return Coverage(counts.astype(int), tilts(views), middles[:, 2], areas / (size[0] * size[1]))


def next_views(seen: Coverage) -> list[str]:
    """The views to take next, the most useful first; empty if the coverage is good.

    Tilts determine the focal length, places the distortion, distances the principal point and the focal length.
    """
    advice = []
    leans = [seen.tilts[:, 0] > _TILT, seen.tilts[:, 0] < -_TILT, seen.tilts[:, 1] > _TILT, seen.tilts[:, 1] < -_TILT]
    missing = [side for side, lean in zip(_SIDES, leans, strict=True) if not lean.any()]
    if missing:
        sides = ", then its ".join(missing)
        advice.append(f"tilt the board by 30 to 45 degrees, so that its {sides} is farther from the camera")
    filled = np.array([[(c > 0).mean() for c in np.array_split(r, 3, axis=1)] for r in np.array_split(seen.counts, 3)])
    for row, column in sorted(np.argwhere(filled < _FILLED), key=lambda at: filled[tuple(at)]):
        place = "middle" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
        advice.append(f"hold the board at the {place} of the picture")
    if not (seen.areas > _NEAR).any():
        advice.append(
            f"bring the board nearer, until it fills half of the picture ({100 * seen.areas.max():.0f}% at most now)"
        )
    elif seen.distances.max() < _RATIO * seen.distances.min():
        advice.append(f"hold the board at {2 * seen.distances.min():.1f} m too, twice as far as now")
    if not advice and len(seen.areas) < _FEW:
        advice.append(f"take {_FEW} views or more ({len(seen.areas)} now)")
    return advice
