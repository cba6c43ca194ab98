"""Intrinsics from views of a board: the fit, its uncertainty, and reasons not to use it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from foundation.one_line import one_line

Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
# No corner detector is more accurate. It keeps a fit without residuals from reporting zero uncertainty.
_LEAST_NOISE_PX = 0.01


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
class BoardView:
    """Corners of a board in one picture."""

    name: str
    points: Float[np.ndarray, "n 3"]  # m, board frame, z = 0
    pixels: Float[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class FittedView:
    """A view with the pose that the calibration gives it."""

    view: BoardView
    T_camera_board: Float[np.ndarray, "4 4"]
    residuals: Float[np.ndarray, "n 2"]  # px, found less predicted

    @property
    def rms(self) -> float:
        """px, root of the mean squared distance."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera, the views used for it, and the views left out with the reason."""

    camera: Camera  # with K_std, distortion_std and rms
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

    Least squares over the intrinsics and the board's poses (Zhang 2000; OpenCV). Views that fit badly are left out one
    by one, the worst first, though never more than half. Standard deviations are those of least squares at the
    solution, for independent noise of the corners as large as the residuals. Reasons not to use the
    result are in `trouble`.
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
        camera, fitted = _fit(kept, size, model)
        errors = np.array([f.rms for f in fitted])
        worst, limit = int(errors.argmax()), max(config.outlier * float(np.median(errors)), config.outlier_px)
        if errors[worst] <= limit or 2 * (len(kept) - 1) < len(views) or len(kept) <= config.fewest_views:
            break
        times = errors[worst] / np.median(errors)
        why = f"its error is {errors[worst]:.2f} px, {times:.0f} times the median: blurred, bent, or corners mistaken?"
        dropped.append((kept.pop(worst).name, why))
    return Calibration(camera, fitted, tuple(dropped), _trouble(camera, fitted, config))


def _fit(views: Sequence[BoardView], size: tuple[int, int], model: Model) -> tuple[Camera, tuple[FittedView, ...]]:
    points, pixels = [v.points for v in views], [v.pixels for v in views]
    K: Any
    D: Any
    try:
        if model == "equidistant":
            K, D, rvecs, tvecs = _fit_fisheye(points, pixels, size)
        else:
            flags = cv2.CALIB_RATIONAL_MODEL if model == "rational_polynomial" else 0
            _, K, D, rvecs, tvecs, *_ = cv2.calibrateCameraExtended(
                [p.astype(np.float32) for p in points],
                [p.astype(np.float32).reshape(-1, 1, 2) for p in pixels],
                size,
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
        D = np.ravel(D)[: _COEFFICIENTS[model]]
        camera = Camera(size[0], size[1], K, D, model)
    except (cv2.error, ValueError) as error:
        what = getattr(error, "err", "") or one_line(error)
        raise ValueError(
            f"no {model} camera fits these {len(views)} views ({what}); take views with the board tilted by 30 degrees"
            " or more, or try another model"
        ) from None
    fitted, residuals, jacobians = [], [], []
    for view, rvec, tvec in zip(views, rvecs, tvecs, strict=True):
        rvec, tvec = np.reshape(rvec, 3), np.reshape(tvec, 3)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], tvec
        predicted, inner, outer = camera.project_posed(view.points, rvec, tvec)
        fitted.append(FittedView(view, T, view.pixels - predicted))
        residuals.append((view.pixels - predicted).ravel())
        jacobians.append((inner, outer))
    rss = float((np.concatenate(residuals) ** 2).sum())
    count = sum(len(r) for r in residuals)
    free = max(count - 4 - len(D) - 6 * len(views), 1)
    std = _deviations(jacobians) * max(np.sqrt(rss / free), _LEAST_NOISE_PX)
    K_std = np.array([[std[0], 0.0, std[2]], [0.0, std[1], std[3]], [0.0, 0.0, 0.0]])
    rms = float(np.sqrt(rss / (count / 2)))
    return Camera(size[0], size[1], K, D, model, K_std, std[4:], rms), tuple(fitted)


def _fit_fisheye(points: list[np.ndarray], pixels: list[np.ndarray], size: tuple[int, int]) -> tuple[Any, ...]:
    """K, distortion, rvecs and tvecs, the best of several starts: OpenCV fails from one that puts corners past 90 deg.

    Raises cv2.error where no start succeeds.
    """
    # The flags are cv2.fisheye's in OpenCV 4 and cv2's, with other values, in 5. No skew: it is no lens's.
    names = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_USE_INTRINSIC_GUESS")
    flags = sum(getattr(cv2.fisheye, name, None) or getattr(cv2, name) for name in names)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-9)
    fits, complaint = [], cv2.error("no start")
    for across in (180.0, 130.0, 90.0):  # degrees over the picture's longer side
        f = max(size) / np.radians(across)
        K = np.array([[f, 0.0, (size[0] - 1) / 2], [0.0, f, (size[1] - 1) / 2], [0.0, 0.0, 1.0]])
        shaped = [p.reshape(1, -1, 3) for p in points], [p.reshape(1, -1, 2) for p in pixels]
        try:
            fits.append(cv2.fisheye.calibrate(*shaped, size, K, np.zeros(4), flags=flags, criteria=criteria))
        except cv2.error as error:
            complaint = error
    if not fits:
        raise complaint
    return min(fits, key=lambda fit: fit[0])[1:]


def _deviations(
    jacobians: Sequence[tuple[Float[np.ndarray, "m p"], Float[np.ndarray, "m 6"]]],
) -> Float[np.ndarray, "p"]:
    """Standard deviations of the intrinsics for noise of 1 px: the root of the diagonal of (J^T J)^-1, poses marginal.

    Each view's derivatives by the intrinsics are reduced to what its own pose cannot imitate. OpenCV inverts the whole
    by a pseudo-inverse, which gives 0 for a parameter that is not determined; here it is very large.
    """
    reduced = []
    for inner, outer in jacobians:
        basis = np.linalg.qr(outer / np.maximum(np.linalg.norm(outer, axis=0), 1e-300))[0]
        reduced.append(inner - basis @ (basis.T @ inner))
    J = np.concatenate(reduced)
    scale = np.maximum(np.linalg.norm(np.concatenate([inner for inner, _ in jacobians]), axis=0), 1e-300)
    _, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    return np.sqrt(((Vt / np.maximum(s, 1e-12)[:, None]) ** 2).sum(axis=0)) / scale


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
