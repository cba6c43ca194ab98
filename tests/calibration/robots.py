"""A robot before a board: pictures' corners, and what the robot says of its gripper, with noise of both."""

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.boards import parse_board
from calibration.fit import BoardView
from calibration.hand_eye import Eye, PosedView
from tests.calibration.boards import CAMERAS, poses

BOARD = parse_board("chessboard:8x6:0.03")
CAMERA = CAMERAS["plumb_bob"]


def placed(turn: list[float], shift: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return T


X = placed([0.1, -0.3, 2.0], [0.03, -0.05, 0.08])  # T_parent_camera
Y = placed([2.9, 0.2, 0.1], [0.5, 0.1, 0.02])  # T_other_board


def gripper(T_camera_board: np.ndarray, eye: Eye) -> np.ndarray:
    """T_base_gripper of a view."""
    T_parent_other = X @ T_camera_board @ np.linalg.inv(Y)
    return np.linalg.inv(T_parent_other) if eye == "in-hand" else T_parent_other


def posed_views(
    eye: Eye, seed: int = 0, count: int = 15, px: float = 0.1, turn: float = 0.1, shift: float = 5e-4
) -> list[PosedView]:
    """Noise of the corners (px) and of the robot (degrees and m, each axis)."""
    rng, made = np.random.default_rng(seed), []
    for i, T in enumerate(poses(CAMERA, BOARD, count, 40.0, seed)):
        pixels = CAMERA.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])
        error = placed(np.radians(turn) * rng.normal(size=3), shift * rng.normal(size=3))
        view = BoardView(f"{i:02}.png", BOARD.corners, pixels + px * rng.normal(size=pixels.shape))
        made.append(PosedView(view, gripper(T, eye) @ error))
    return made
