"""The fit of a camera to views of one board, which need not be flat."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from calibration.deviations import covariance
from foundation.one_line import one_line

Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
# No corner detector is more accurate. It keeps a fit without residuals from reporting zero uncertainty.
_LEAST_NOISE_PX = 0.01
# Standard deviation of a bend's coefficients: 1 mm at the edges of a board of 0.2 m, as of a sheet glued to a plate.
_BEND_STD = 0.01
_BENDS = 3
_STEPS, _HALVINGS = 30, 6


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
class Bend:
    """How a board is bent: its height is a quadratic in x and y about its middle."""

    middle: Float[np.ndarray, "2"]  # m, board frame
    half: float  # m, half of the board's longer side
    coefficients: Float[np.ndarray, "3"]  # of x^2, y^2 and x y, lengths and heights in units of `half`

    def shapes(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Height (m) of points of the board for each coefficient of 1."""
        x, y = ((points[:, :2] - self.middle) / self.half).T
        return np.column_stack([x**2, y**2, x * y]) * self.half

    def bent(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The places (m, board frame) of points that a flat board has at z = 0."""
        return points + (self.shapes(points) @ self.coefficients)[:, None] * [0.0, 0.0, 1.0]

    def depth(self, points: Float[np.ndarray, "n 3"]) -> float:
        """From the lowest to the highest of these points (m), over the plane that fits them best."""
        bent = self.bent(points)
        plane = np.column_stack([points[:, :2], np.ones(len(points))])
        return float(np.ptp(bent[:, 2] - plane @ np.linalg.lstsq(plane, bent[:, 2], rcond=None)[0]))


@dataclass(frozen=True, eq=False)
class Fit:
    """A camera that fits views best, with the poses and the bend of the board."""

    camera: Camera  # with K_std, distortion_std and rms
    views: tuple[FittedView, ...]
    bend: Bend
    covariance: Float[np.ndarray, "p p"]  # of (fx, fy, cx, cy, distortion)


@dataclass(frozen=True, eq=False)
class _State:
    """A guess, and how it misses the views' pixels."""

    camera: Camera
    poses: Float[np.ndarray, "v 6"]  # rotation vector and shift (m) of T_camera_board
    bend: Bend
    residuals: list[Float[np.ndarray, "m"]]
    inner: list[Float[np.ndarray, "m q"]]  # derivatives of each view's pixels by intrinsics and bend
    outer: list[Float[np.ndarray, "m 6"]]  # by its pose

    @property
    def rss(self) -> float:
        """px^2."""
        return float(sum(r @ r for r in self.residuals))

    def noise(self) -> float:
        """px, of one coordinate; at least what no detector goes below."""
        free = sum(map(len, self.residuals)) - self.inner[0].shape[1] - 6 * len(self.residuals)
        return max(float(np.sqrt(self.rss / max(free, 1))), _LEAST_NOISE_PX)


def fit(views: Sequence[BoardView], size: tuple[int, int], model: Model) -> Fit:
    """Least squares over intrinsics, poses and the bend of the board; `size` is width and height (px).

    It begins at OpenCV's solution for a flat board (Zhang 2000). A bend of 1 mm that is not fitted moves the focal
    length by many times what noise does; mrcal fits it for the same reason. Its coefficients have a prior about flat.
    Raises ValueError if no camera fits at all.
    """
    camera, poses = _flat_fit(views, size, model)
    corners = np.concatenate([v.points for v in views])[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    bend = Bend((low + high) / 2, float((high - low).max()) / 2, np.zeros(_BENDS))
    state = _refined(_state(camera, poses, bend, views), views)
    camera, p = state.camera, 4 + len(state.camera.distortion)
    prior = _prior(state)
    cov = covariance(*_without_pose(state), prior, state.noise())[:p, :p]
    std = np.sqrt(np.diag(cov))
    K_std = np.array([[std[0], 0.0, std[2]], [0.0, std[1], std[3]], [0.0, 0.0, 0.0]])
    rms = float(np.sqrt(2 * state.rss / sum(map(len, state.residuals))))
    fitted = []
    for view, pose, residuals in zip(views, state.poses, state.residuals, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(pose[:3])[0], pose[3:]
        fitted.append(FittedView(view, T, residuals.reshape(-1, 2)))
    return Fit(replace(camera, K_std=K_std, distortion_std=std[4:], rms=rms), tuple(fitted), state.bend, cov)


def _state(camera: Camera, poses: Float[np.ndarray, "v 6"], bend: Bend, views: Sequence[BoardView]) -> _State:
    residuals, inner, outer = [], [], []
    for view, pose in zip(views, poses, strict=True):
        pixels, by_camera, by_pose = camera.project_posed(bend.bent(view.points), pose[:3], pose[3:])
        up = by_pose[:, 3:] @ cv2.Rodrigues(pose[:3])[0][:, 2]  # by a point's own height
        residuals.append((view.pixels - pixels).ravel())
        inner.append(np.column_stack([by_camera, up[:, None] * bend.shapes(view.points).repeat(2, axis=0)]))
        outer.append(by_pose)
    return _State(camera, poses, bend, residuals, inner, outer)


def _prior(state: _State) -> Float[np.ndarray, "3 q"]:
    """Rows of least squares, px, that hold the bend's coefficients near zero."""
    columns = state.inner[0].shape[1]
    return state.noise() / _BEND_STD * np.eye(_BENDS, columns, columns - _BENDS)


def _without_pose(state: _State) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Each view's derivatives and residuals, less what its own pose can imitate, and the derivatives' whole lengths."""
    reduced, residuals = [], []
    for inner, outer, r in zip(state.inner, state.outer, state.residuals, strict=True):
        basis = np.linalg.qr(outer / np.maximum(np.linalg.norm(outer, axis=0), 1e-300))[0]
        reduced.append(inner - basis @ (basis.T @ inner))
        residuals.append(r - basis @ (basis.T @ r))
    return reduced, residuals, np.maximum(np.linalg.norm(np.concatenate(state.inner), axis=0), 1e-300)


def _refined(state: _State, views: Sequence[BoardView]) -> _State:
    """Gauss and Newton's steps, each shortened until it helps."""
    for _ in range(_STEPS):
        prior, b = _prior(state), state.bend.coefficients
        reduced, residuals, scale = _without_pose(state)
        J = np.concatenate([*reduced, prior]) / scale
        step = np.linalg.lstsq(J, np.concatenate([*residuals, -prior[:, -_BENDS:] @ b]), rcond=1e-12)[0] / scale
        turns = [
            np.linalg.lstsq(outer, r - inner @ step, rcond=1e-12)[0]
            for inner, outer, r in zip(state.inner, state.outer, state.residuals, strict=True)
        ]
        weight = (state.noise() / _BEND_STD) ** 2
        cost = state.rss + weight * float(b @ b)
        for halving in range(_HALVINGS):
            new = _moved(state, 0.5**halving * step, 0.5**halving * np.array(turns), views)
            if new is not None and new.rss + weight * float(new.bend.coefficients @ new.bend.coefficients) < cost:
                break
        else:
            return state
        less = cost - new.rss - weight * float(new.bend.coefficients @ new.bend.coefficients)
        state = new
        if less < 1e-9 * cost:
            break
    return state


def _moved(
    state: _State, step: Float[np.ndarray, "q"], turns: Float[np.ndarray, "v 6"], views: Sequence[BoardView]
) -> _State | None:
    """The guess a step further; None where that is no camera."""
    K = state.camera.K + np.array([[step[0], 0.0, step[2]], [0.0, step[1], step[3]], [0.0, 0.0, 0.0]])
    try:
        camera = replace(state.camera, K=K, distortion=state.camera.distortion + step[4:-_BENDS])
        bend = replace(state.bend, coefficients=state.bend.coefficients + step[-_BENDS:])
        return _state(camera, state.poses + turns, bend, views)
    except (cv2.error, ValueError):
        return None


def _flat_fit(
    views: Sequence[BoardView], size: tuple[int, int], model: Model
) -> tuple[Camera, Float[np.ndarray, "v 6"]]:
    """OpenCV's camera, and the views' rotation vectors and shifts, for a flat board. Raises ValueError."""
    points, pixels = [v.points for v in views], [v.pixels for v in views]
    K: Any
    D: Any
    try:
        if model == "equidistant":
            K, D, rvecs, tvecs = _fit_fisheye(points, pixels, size)
        else:
            flags = cv2.CALIB_RATIONAL_MODEL if model == "rational_polynomial" else 0
            _, K, D, rvecs, tvecs = cv2.calibrateCamera(
                [p.astype(np.float32) for p in points],
                [p.astype(np.float32).reshape(-1, 1, 2) for p in pixels],
                size,
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
        camera = Camera(size[0], size[1], K, np.ravel(D)[: _COEFFICIENTS[model]], model)
    except (cv2.error, ValueError) as error:
        what = getattr(error, "err", "") or one_line(error)
        raise ValueError(
            f"no {model} camera fits these {len(views)} views ({what}); take views with the board tilted by 30 degrees"
            " or more, or try another model"
        ) from None
    poses = [np.concatenate([np.reshape(r, 3), np.reshape(t, 3)]) for r, t in zip(rvecs, tvecs, strict=True)]
    return camera, np.array(poses)


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
