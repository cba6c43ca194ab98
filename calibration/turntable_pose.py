"""The camera's pose relative to a turntable's plate, from a ChArUco board that lies on it.

Plate frame (metres): origin at the board's centre, z up, x along the board's columns to the right as it is printed, y
towards its top edge. It turns with the plate, so in it the camera moves around the plate.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.boards import FEWEST_CORNERS, Board
from calibration.camera import Camera

_WORST_PX = 2.0  # mean distance of corners from where the pose puts them
_LEAST_SPREAD = 0.5  # squares: standard deviation of the corners across their longest line
_STEPS, _STEP_END = 50, 1e-10  # of the pose's fit; rad and m


class PlateNotFoundError(ValueError):
    """The plate cannot be located in a picture: one line that says what was seen."""


@dataclass(frozen=True, eq=False)
class PlatePose:
    """The camera's pose, and its uncertainty."""

    T_plate_camera: Float[np.ndarray, "4 4"]  # p_plate = T_plate_camera @ p_camera, m
    corners: int
    rms: float  # px


def T_board_plate(board: Board) -> Float[np.ndarray, "4 4"]:
    """From the plate frame to the board's."""
    width, height = board.size
    return np.array([[1, 0, 0, 0.5 * width], [0, -1, 0, 0.5 * height], [0, 0, -1, 0], [0, 0, 0, 1.0]])


def locate_plate(board: Board, camera: Camera, rgb: UInt8[np.ndarray, "h w 3"]) -> PlatePose:
    """The camera's pose over the plate in one picture. Raises PlateNotFoundError, which says what was seen instead."""
    corners = board.find(rgb)
    if corners is None:
        raise PlateNotFoundError(
            f"fewer than {FEWEST_CORNERS} corners of the board were found, or all in a line; show more of it, sharper"
            " and evenly lit, and check the board's description"
        )
    points, pixels = corners
    count = len(points)
    spread = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)[1] / np.sqrt(count)
    if spread < _LEAST_SPREAD * board.square:
        raise PlateNotFoundError(f"the {count} corners found lie almost in a line; show more of the board")
    fitted = fit_pose(points, pixels, camera)
    if fitted is None:
        raise PlateNotFoundError(f"no pose fits the {count} corners found; check the camera's calibration")
    T_camera_board, rms = fitted
    T_plate_camera = np.linalg.inv(T_camera_board @ T_board_plate(board))
    if rms > _WORST_PX or T_plate_camera[2, 3] <= 0:
        raise PlateNotFoundError(f"the board's corners are {rms:.1f} px off their pose; check the camera's calibration")
    return PlatePose(T_plate_camera, count, rms)


def fit_pose(
    points: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"], camera: Camera
) -> tuple[Float[np.ndarray, "4 4"], float] | None:
    """T_camera_board of a flat board by least squares in pixels, through the camera's own lens, and its rms (px)."""
    rays = camera.rays(pixels)
    seen = np.isfinite(rays).all(axis=1)
    if seen.sum() < FEWEST_CORNERS:
        return None
    ideal = rays[seen, :2] / rays[seen, 2:]
    found, turn, shift = cv2.solvePnP(points[seen], ideal, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    pose, best = np.concatenate([turn.ravel(), shift.ravel()]), np.inf
    step = np.zeros(6)
    for _ in range(_STEPS):  # Gauss-Newton; a step that does not lower the error is halved
        px, _, J = camera.project_posed(points, pose[:3] + step[:3], pose[3:] + step[3:])
        error = float(np.sum((px - pixels) ** 2))
        if not error < best:
            step = 0.5 * step
            continue
        pose, best = pose + step, error
        step = np.linalg.lstsq(J, (pixels - px).ravel(), rcond=None)[0]
        if np.abs(step).max() < _STEP_END:
            break
    T_camera_board = np.eye(4)
    T_camera_board[:3, :3], T_camera_board[:3, 3] = cv2.Rodrigues(pose[:3])[0], pose[3:]
    return T_camera_board, float(np.sqrt(best / len(points)))


def turned(T_plate_first: Float[np.ndarray, "4 4"], T_plate_second: Float[np.ndarray, "4 4"]) -> float:
    """Degrees in (-180, 180] that the plate turned between two views, counter-clockwise from above."""
    R = T_plate_first[:3, :3] @ T_plate_second[:3, :3].T  # a plate that turns forward sees the camera go backward
    return float(np.rad2deg(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])))


def plate_axis(T_plate_cameras: Float[np.ndarray, "n 4 4"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Where the plate's axis meets it (x, y in the plate frame, m), and the rms by which cameras leave their circle.

    The camera does not move, so in the plate frame its positions lie on a circle around the axis. Raises ValueError
    if they do not determine it: fewer than three, or all close together.
    """
    places = np.asarray(T_plate_cameras, np.float64)[:, :2, 3]
    centred = places - places.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)[-1] if len(places) > 2 else 0.0
    if spread < 0.02:
        raise ValueError(f"{len(places)} views do not tell the plate's axis; take three or more, well apart")
    # |p|^2 = 2 p.c + (r^2 - |c|^2), linear in c and the last term
    A = np.column_stack([2.0 * centred, np.ones(len(centred))])
    cx, cy, rest = np.linalg.lstsq(A, np.sum(centred**2, axis=1), rcond=None)[0]
    radius = np.sqrt(rest + cx * cx + cy * cy)
    off = np.hypot(centred[:, 0] - cx, centred[:, 1] - cy) - radius
    return np.array([cx, cy]) + places.mean(axis=0), float(np.sqrt(np.mean(off**2)))
