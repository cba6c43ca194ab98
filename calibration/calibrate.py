"""Intrinsics from views of a board: the fit, its uncertainty, and reasons not to use it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.fit import Bend, BoardView, FittedView, Model, fit


@dataclass(frozen=True)
class CalibrateConfig:
    """When a view is left out, and the conditions for saving a calibration."""

    fewest_views: int = 3  # Zhang's method needs two for a pinhole without distortion; a third checks that they agree
    most_views: int = 60  # of a long recording, evenly spaced
    least_motion: float = 0.01  # of the picture's diagonal; a view whose corners moved less than this adds nothing
    stream_motion: float = 0.03  # the same, in a stream of pictures: a hand holds the board before a camera
    outlier: float = 3.0  # times the median view's error: a view beyond it is left out
    outlier_px: float = 0.3  # but none below this error
    focal_std: float = 0.01  # of the focal length; the largest standard deviation that may be saved
    rms: float = 0.004  # of the picture's width; a larger residual is not noise of the corners (2.6 px of 640)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera, the views used for it, and the views left out with the reason."""

    camera: Camera  # with K_std, distortion_std and rms
    covariance: Float[np.ndarray, "p p"]  # of (fx, fy, cx, cy, distortion)
    bend: Bend  # of the board
    views: tuple[FittedView, ...]
    dropped: tuple[tuple[str, str], ...]  # name, why
    trouble: str | None  # why this calibration must not be used, and what to do


def distinct(
    views: Sequence[BoardView], size: tuple[int, int], config: CalibrateConfig
) -> tuple[list[BoardView], list[tuple[str, str]]]:
    """The views that differ, at most `most_views`, and the others' names with the reason. `size`: width, height (px).

    Nearly equal views would count the same evidence twice, and make the standard deviations too small.
    """
    kept: list[BoardView] = []
    same: list[tuple[str, str]] = []
    least = config.least_motion * float(np.hypot(*size))
    for view in views:
        near = next((other for other in kept if motion(view, other) < least), None)
        if near is None:
            kept.append(view)
        else:
            same.append((view.name, f"nearly the same view as {near.name}"))
    if len(kept) > config.most_views:
        chosen = np.linspace(0, len(kept) - 1, config.most_views).round().astype(int)
        same += [(v.name, f"{config.most_views} views are enough") for i, v in enumerate(kept) if i not in chosen]
        kept = [kept[i] for i in chosen]
    return kept, same


def motion(a: BoardView, b: BoardView) -> float:
    """Mean distance (px) between the corners that two views share; infinite where they share none."""
    i, j = np.nonzero((a.points[:, None] == b.points).all(axis=-1))
    return float(np.linalg.norm(a.pixels[i] - b.pixels[j], axis=1).mean()) if len(i) else np.inf


def calibrate(
    views: Sequence[BoardView],
    size: tuple[int, int],
    model: Model = "plumb_bob",
    config: CalibrateConfig | None = None,
) -> Calibration:
    """The camera of pictures of `size` (width, height; px) that saw these views of one board.

    Least squares over the intrinsics, the board's poses and its bend (`calibration.fit`). Views that fit badly are left
    out one by one, the worst first, though never more than half. Standard deviations are by how the views disagree
    (`calibration.deviations`), as errors within one picture are not independent. Reasons not to use the result are in
    `trouble`.
    Raises ValueError if the views are too few or no camera fits at all.
    """
    config = config or CalibrateConfig()
    if len(views) < config.fewest_views:
        raise ValueError(
            f"{len(views)} different views of the board are too few to calibrate; take {config.fewest_views} or more,"
            " better 15, with the board tilted in different directions and in every part of the picture"
        )
    kept, dropped = list(views), []
    while True:
        found = fit(kept, size, model)
        errors = np.array([f.rms for f in found.views])
        worst, limit = int(errors.argmax()), max(config.outlier * float(np.median(errors)), config.outlier_px)
        if errors[worst] <= limit or 2 * (len(kept) - 1) < len(views) or len(kept) <= config.fewest_views:
            break
        times = errors[worst] / np.median(errors)
        why = f"its error is {errors[worst]:.2f} px, {times:.0f} times the median: blurred, bent, or corners mistaken?"
        dropped.append((kept.pop(worst).name, why))
    trouble = _trouble(found.camera, found.views, config)
    return Calibration(found.camera, found.covariance, found.bend, found.views, tuple(dropped), trouble)


def tilts(views: Sequence[FittedView]) -> Float[np.ndarray, "v 2"]:
    """How the board leans in each view (degrees): its right side away from the camera, and its lower side away.

    Against the plane of the picture, in its axes: boards with equal tilts give equal information on the focal length.
    """
    normals = np.array([f.T_camera_board[:3, 2] for f in views]).reshape(-1, 3)
    normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)  # away from the camera
    return np.degrees(np.arctan2(-normals[:, :2], normals[:, 2:]))


def _trouble(camera: Camera, views: Sequence[FittedView], config: CalibrateConfig) -> str | None:
    assert camera.K_std is not None and camera.rms is not None
    f, std = np.diag(camera.K)[:2], np.diag(camera.K_std)[:2]
    worst = int((std / f).argmax())
    relative = float(std[worst] / f[worst])
    if camera.rms > config.rms * camera.width:
        return (
            f"the corners miss their places by {camera.rms:.1f} px (RMS), {config.rms * camera.width:.1f} px may be"
            " saved: is the board flat, is it the one that was named, and is the model the lens's?"
        )
    if relative <= config.focal_std:
        return None
    largest = float(np.linalg.norm(tilts(views), axis=1).max())
    says = f"the focal length is not determined: {f[worst]:.0f} px with a standard deviation of "
    says += f"{100 * relative:.1f}%" if relative < 10 else "more than 1000%"
    says += f" ({100 * config.focal_std:g}% may be saved). "
    if largest < 15:
        says += (
            f"All views see the board nearly face on (tilts up to {largest:.0f} degrees), which does not tell a long"
        )
        says += " lens from a far board; add views with the board tilted by 30 to 45 degrees to each side"
    else:
        says += f"{len(views)} views are not enough, or too much alike; add views with other tilts (30 to 45 degrees),"
        says += " nearer and in other parts of the picture"
    return says
