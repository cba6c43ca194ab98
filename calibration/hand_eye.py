"""Where a camera is on a robot (hand-eye calibration), from views of a board and the robot's pose at each of them.

In hand: the camera moves with the gripper, the board lies still in the robot's base frame. To hand: the camera stands
still in the base frame, and the gripper holds the board. With X = T_parent_camera (the parent is the gripper, or the
base), Y = T_other_board (the base, or the gripper) and A = T_parent_other of a view, T_camera_board = X^-1 A Y of both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from calibration.deviations import covariance
from calibration.fit import BoardView
from calibration.turntable_pose import fit_pose

Eye = Literal["in-hand", "to-hand"]
Matrix = Float[np.ndarray, "4 4"]
_HALF_TURN = np.radians(170.0)  # near 180 degrees a turn's axis has two signs
_LEAST_NOISE_PX = 0.01  # as in calibration.fit
_ROUNDS = 5
_TIMES = 5.0  # the median: two turns that should be alike, and are not
_CHI2_MEDIAN = 0.455  # of a squared standard normal


@dataclass(frozen=True)
class HandEyeConfig:
    """When a view is left out, and the conditions for saving a result."""

    fewest_views: int = 5  # three determine it; the others tell how certain it is
    second_axis: float = 4.0  # degrees; RMS of the turns about the axis of which there is second least
    disagreement: float = 3.0  # degrees; of the turns that robot and board make between two views, the median
    outlier: float = 4.0  # times the median view's error: a view beyond it is left out
    outlier_px: float = 1.0  # but none below this error
    rms: float = 0.02  # of the picture's width; a larger residual is no robot's inaccuracy
    turn_std: float = 1.0  # degrees, largest deviation that may be saved
    shift_std: float = 0.01  # m


@dataclass(frozen=True, eq=False)
class PosedView:
    """A view of the board, and where the robot says that it was."""

    view: BoardView
    T_base_gripper: Matrix


@dataclass(frozen=True, eq=False)
class Miss:
    """How far a view is from what the result and the robot say of it."""

    name: str
    rms_px: float  # of the corners
    turn: float  # degrees, of the gripper, from where the robot says to where the picture puts it
    shift: float  # m


@dataclass(frozen=True, eq=False)
class HandEye:
    """Where the camera is, and how certain that is."""

    eye: Eye
    T_parent_camera: Matrix  # of the gripper if in hand, of the base if to hand
    T_other_board: Matrix  # of the base, or of the gripper
    std: Float[np.ndarray, "6"]  # of T_parent_camera: turns about the parent's axes (rad), shifts along them (m)
    rms: float  # px
    misses: tuple[Miss, ...]
    dropped: tuple[tuple[str, str], ...]  # name, why
    trouble: str | None  # why this result must not be used, and what to do


def hand_eye(
    views: Sequence[PosedView], camera: Camera, eye: Eye = "in-hand", config: HandEyeConfig | None = None
) -> HandEye:
    """The camera's pose on the gripper or in the base frame, from views of one flat board that does not move in the
    other one.

    It begins at the closed form of Park and Martin (1994), and minimises the squared error in pixels over
    T_parent_camera, T_other_board and the robot's own errors, whose size is estimated, too (`_solved`). Views that fit
    badly are left out, though never more than half. Deviations are by how the views
    disagree (`calibration.deviations`); those of the stated focal lengths and principal point are added.
    Raises ValueError where the views are too few, or their motions do not determine it.
    """
    config = config or HandEyeConfig()
    if len(views) < config.fewest_views:
        raise ValueError(
            f"{len(views)} pictures with the board and a pose are too few; take {config.fewest_views} or more, better"
            " 15, with the gripper turned by 30 degrees or more about different axes"
        )
    seen = [_seen(view, camera) for view in views]
    kept = [s for s in seen if s is not None]
    dropped = [(v.view.name, "no pose of the board fits it") for v, s in zip(views, seen, strict=True) if s is None]
    if len(kept) < config.fewest_views:
        raise ValueError(
            f"{len(kept)} pictures in which the board has a pose are too few; check the camera's calibration"
        )
    _check_motions(kept, config)
    rough = _solved(kept, eye, robust=True)
    rms = np.array([s.rms_px(rough, camera) for s in kept])
    limit = max(config.outlier * float(np.median(rms)), config.outlier_px)
    for worst in np.argsort(-rms)[: min(len(kept) // 2, len(kept) - config.fewest_views)]:
        if rms[worst] > limit:
            times = rms[worst] / np.median(rms)
            why = f"its error is {rms[worst]:.1f} px, {times:.0f} times the median: is its pose another picture's?"
            dropped.append((kept[worst].view.name, why))
    kept = [s for s in kept if s.view.name not in {name for name, _ in dropped}]
    _check_motions(kept, config)
    found = _solved(kept, eye)
    rms = np.array([s.rms_px(found, camera) for s in kept])
    std = np.sqrt(np.diag(_covariance(kept, found, camera)))[:6]
    misses = []
    for s, px, E in zip(kept, rms.tolist(), found.errors(kept), strict=True):
        misses.append(Miss(s.view.name, px, float(np.degrees(np.linalg.norm(E[:3]))), float(np.linalg.norm(E[3:]))))
    whole = float(np.sqrt(np.mean(rms**2)))
    trouble = _trouble(whole, std, kept, camera, eye, config)
    return HandEye(eye, found.X, found.Y, std, whole, tuple(misses), tuple(dropped), trouble)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A view with the pose of the board that its picture gives, and how certain that is."""

    view: BoardView
    T_base_gripper: Matrix
    T_camera_board: Matrix
    J: Float[np.ndarray, "m 6"]  # derivatives of the pixels by a step of that pose
    by_camera: Float[np.ndarray, "6 4"]  # a step of that pose by fx, fy, cx, cy
    rss: float  # px^2

    def other_in_parent(self, eye: Eye) -> Matrix:
        """A = T_parent_other."""
        return np.linalg.inv(self.T_base_gripper) if eye == "in-hand" else self.T_base_gripper

    def rms_px(self, found: "_Solution", camera: Camera) -> float:
        """Of the corners, from where X, Y and the robot put them."""
        T = np.linalg.inv(found.X) @ self.other_in_parent(found.eye) @ found.Y
        return float(np.sqrt(2 * np.mean((_pixels(self.view, T, camera)[0] - self.view.pixels.ravel()) ** 2)))


@dataclass(frozen=True, eq=False)
class _Solution:
    eye: Eye
    X: Matrix
    Y: Matrix
    whitening: Float[np.ndarray, "n 6 6"] | None = None  # of each view's error

    def errors(self, views: Sequence[_Seen], step: Float[np.ndarray, "6"] | None = None) -> Float[np.ndarray, "n 6"]:
        """Where pictures put the gripper, from where the robot says it is: rotation vectors and shifts (m).

        `step` moves all T_camera_board.
        """
        M = np.stack([v.T_camera_board if step is None else _moved(v.T_camera_board, step) for v in views])
        T_parent_other = self.X @ M @ np.linalg.inv(self.Y)
        there = np.linalg.inv(T_parent_other) if self.eye == "in-hand" else T_parent_other
        T = np.linalg.inv(np.stack([v.T_base_gripper for v in views])) @ there
        return np.column_stack([Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]])

    def by_board(self, views: Sequence[_Seen]) -> Float[np.ndarray, "n 6 6"]:
        """The errors' derivatives by a step of T_camera_board."""
        return _derivatives(lambda step: self.errors(views, step).ravel()).reshape(-1, 6, 6)


def _derivatives(of: Callable[[np.ndarray], np.ndarray]) -> Float[np.ndarray, "m 6"]:
    steps = 1e-6 * np.eye(6)
    return np.column_stack([(of(step) - of(-step)) / 2e-6 for step in steps])


def _pixels(view: BoardView, T: Matrix, camera: Camera) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m p"]]:
    """Pixels of the corners, and their derivatives by the intrinsics."""
    turn = cv2.Rodrigues(T[:3, :3])[0].ravel()
    pixels, inner, _ = camera.project_posed(view.points, turn, T[:3, 3])
    return pixels.ravel(), inner


def _seen(posed: PosedView, camera: Camera) -> _Seen | None:
    """None where no pose of the board fits."""
    view = posed.view
    if (fitted := fit_pose(view.points, view.pixels, camera)) is None:
        return None
    M, rms = fitted
    J = _derivatives(lambda step: _pixels(view, _moved(M, step), camera)[0])
    by_camera = -np.linalg.lstsq(J, _pixels(view, M, camera)[1][:, :4], rcond=None)[0]
    return _Seen(view, posed.T_base_gripper, M, J, by_camera, rms**2 * len(view.points))


def _check_motions(views: Sequence[_Seen], config: HandEyeConfig) -> None:
    """Raises ValueError where robot and board do not turn alike, or only about one axis."""
    robot, board = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in _motions(views, "in-hand"))
    apart = np.degrees(np.abs(np.linalg.norm(robot, axis=1) - np.linalg.norm(board, axis=1)))
    if (median := float(np.median(apart))) > config.disagreement:
        raise ValueError(
            f"between two pictures the robot and the board turn by angles that differ by {median:.0f} degrees (median):"
            " are these the poses of these pictures, in this order, and are their quaternions x y z w?"
        )
    spread = np.degrees(np.sqrt(np.linalg.eigvalsh(robot.T @ robot / len(robot)).clip(0.0)))  # rising
    if spread[1] < config.second_axis:
        raise ValueError(
            f"the gripper turns about one axis alone (about another by {spread[1]:.1f} degrees, RMS), which leaves the"
            " camera's place along it open; add pictures with the gripper turned by 30 degrees or more about another"
        )


def _motions(views: Sequence[_Seen], eye: Eye) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 4 4"]]:
    """P = A_j A_i^-1 and Q = M_j M_i^-1 of all pairs of views, M = T_camera_board: P X = X Q."""
    A, M = [v.other_in_parent(eye) for v in views], [v.T_camera_board for v in views]
    pairs = list(combinations(range(len(views)), 2))
    return tuple(np.stack([T[j] @ np.linalg.inv(T[i]) for i, j in pairs]) for T in (A, M))  # type: ignore[return-value]


def _closed_form(views: Sequence[_Seen], eye: Eye) -> tuple[Matrix, Matrix]:
    """X and Y by Park and Martin (1994): first the rotation of X from the axes of the turns, then its shift."""
    P, Q = _motions(views, eye)
    p, q = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (P, Q))
    angles = np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)
    apart = np.abs(angles[0] - angles[1])  # large where one of the two has a wrong pose
    good = (apart <= _TIMES * np.median(apart)) & (np.maximum(*angles) < _HALF_TURN)
    # of the sum of p q^T the orthogonal factor, their (M^T M)^-1/2 M^T, and right-handed
    U, _, Vt = np.linalg.svd(p[good].T @ q[good])
    X = np.eye(4)
    X[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    lhs = P[good, :3, :3] - np.eye(3)
    rhs = Q[good, :3, 3] @ X[:3, :3].T - P[good, :3, 3]
    X[:3, 3] = np.linalg.lstsq(lhs.reshape(-1, 3), rhs.ravel(), rcond=None)[0]
    Ys = np.stack([np.linalg.inv(v.other_in_parent(eye)) @ X @ v.T_camera_board for v in views])
    Y = np.eye(4)
    Y[:3, :3] = Rotation.from_matrix(Ys[:, :3, :3]).mean().as_matrix()
    Y[:3, 3] = np.median(Ys[:, :3, 3], axis=0)
    return X, Y


def _moved(T: Matrix, step: Float[np.ndarray, "6"]) -> Matrix:
    """Turned by a rotation vector about the axes of the frame that T leads to, and shifted along them."""
    new = T.copy()
    new[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3]
    new[:3, 3] += step[3:]
    return new


def _solved(views: Sequence[_Seen], eye: Eye, robust: bool = False) -> _Solution:
    """X and Y that explain the pixels best, if each of the robot's poses may be wrong by a turn and a shift.

    A robot's error of a tenth of a degree moves all corners of a picture by several times their own noise. Least
    squares in pixels alone takes such an error for as many independent ones as there are corners. So a view's error is
    the pose that its picture gives the gripper, with the covariance of corners (to first order) plus the robot's; the
    size of the latter is what the views do not explain otherwise, estimated in turn with X and Y. `robust` gives views
    that are far off little weight, for them to be found.
    """
    found = _Solution(eye, *_closed_form(views, eye))
    px = np.sqrt(sum(v.rss for v in views) / max(sum(len(v.J) - 6 for v in views), 1))
    noise = max(float(px), _LEAST_NOISE_PX)
    of_board = noise**2 * np.stack([np.linalg.inv(v.J.T @ v.J) for v in views])
    share = 6 * len(views) / (6 * len(views) - 12)  # of the errors, which X and Y have taken up in part
    loss: dict[str, Any] = {"method": "trf", "loss": "cauchy", "f_scale": 2.0} if robust else {"method": "lm"}
    for _ in range(_ROUNDS):
        E, F = found.errors(views), found.by_board(views)
        of_corners = F @ of_board @ F.transpose(0, 2, 1)
        squares = np.median(E**2, axis=0) / _CHI2_MEDIAN if robust else np.mean(share * E**2, axis=0)
        rest = squares - np.diagonal(of_corners, axis1=1, axis2=2).mean(axis=0)
        robot = [max(float(rest[k].mean()), 0.0) for k in (slice(3), slice(3, 6))]
        W = np.linalg.inv(np.linalg.cholesky(of_corners + np.diag(np.repeat(robot, 3))))

        def errors(step: np.ndarray, at: _Solution = found, W: np.ndarray = W) -> np.ndarray:
            return np.einsum("nij,nj->ni", W, _stepped(at, step).errors(views)).ravel()

        step = least_squares(errors, np.zeros(12), x_scale="jac", max_nfev=100, **loss).x
        found = replace(_stepped(found, step), whitening=W)
    return found


def _stepped(found: _Solution, step: Float[np.ndarray, "12"]) -> _Solution:
    return replace(found, X=_moved(found.X, step[:6]), Y=_moved(found.Y, step[6:]))


def _covariance(views: Sequence[_Seen], found: _Solution, camera: Camera) -> Float[np.ndarray, "12 12"]:
    """Of the jackknife over views, and of the camera's errors, which all views share."""
    W = found.whitening
    assert W is not None
    none = np.zeros(6)
    by_X = _derivatives(lambda step: _stepped(found, np.concatenate([step, none])).errors(views).ravel())
    by_Y = _derivatives(lambda step: _stepped(found, np.concatenate([none, step])).errors(views).ravel())
    J = list(W @ np.column_stack([by_X, by_Y]).reshape(-1, 6, 12))
    errors = list(np.einsum("nij,nj->ni", W, -found.errors(views)))
    by_camera = W @ found.by_board(views) @ np.stack([v.by_camera for v in views])
    every, rest = np.concatenate(J), np.concatenate(errors)
    noise = max(float(np.sqrt(rest @ rest / max(len(rest) - 12, 1))), 1.0)
    cov = covariance(J, errors, np.maximum(np.linalg.norm(every, axis=0), 1e-300), np.zeros((0, 12)), noise)
    if camera.K_std is None:
        return cov
    shifts = np.linalg.lstsq(every, by_camera.reshape(-1, 4), rcond=None)[0]
    shifts = shifts * camera.K_std[[0, 1, 0, 1], [0, 1, 2, 2]]
    return cov + shifts @ shifts.T


def _trouble(
    rms: float, std: Float[np.ndarray, "6"], views: Sequence[_Seen], camera: Camera, eye: Eye, config: HandEyeConfig
) -> str | None:
    if rms > config.rms * camera.width:
        other: Eye = "to-hand" if eye == "in-hand" else "in-hand"
        turned = _solved(views, other)
        instead = float(np.sqrt(np.mean([v.rms_px(turned, camera) ** 2 for v in views])))
        limit = config.rms * camera.width
        far = f"{rms:.0f} px (RMS)" if rms < camera.width else "more than the picture's width"
        says = f"the corners miss their places by {far}, {limit:.0f} px may be saved: "
        if instead < min(0.2 * rms, limit):
            return says + (
                f"with --eye {other} they miss by {instead:.1f} px, so the camera is there, or the poses are inverted"
                " (T_base_gripper is wanted)"
            )
        return says + (
            "are the poses those of these pictures, in metres with quaternions x y z w, and did the board stay where it"
            " was?"
        )
    turn, shift = float(np.degrees(std[:3].max())), float(std[3:].max())
    if turn > config.turn_std or shift > config.shift_std:
        return (
            f"the camera's pose is not determined: standard deviations up to {1000 * shift:.1f} mm and {turn:.2f}"
            f" degrees ({1000 * config.shift_std:g} mm and {config.turn_std:g} degrees may be saved); add pictures with"
            " the gripper turned by 30 degrees or more about different axes"
        )
    return None
