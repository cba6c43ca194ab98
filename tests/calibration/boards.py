"""Boards before a known camera: their corners by projection, and pictures of them."""

from functools import cache

import cv2
import numpy as np

from calibration.boards import Board, parse_board
from calibration.camera import Camera
from calibration.fit import BoardView

K = np.array([[430.0, 0.0, 310.0], [0.0, 432.0, 221.0], [0.0, 0.0, 1.0]])
WIDE = np.array([[258.0, 0.0, 310.0], [0.0, 259.0, 221.0], [0.0, 0.0, 1.0]])
CAMERAS = {
    "plumb_bob": Camera(640, 480, K, np.array([-0.28, 0.07, 6e-4, -3e-4, 0.01])),
    "rational_polynomial": Camera(
        640, 480, K, np.array([0.4, 0.1, 1e-4, -6e-5, 0.02, 0.7, 0.2, 0.05]), "rational_polynomial"
    ),
    "equidistant": Camera(640, 480, WIDE, np.array([-0.02, 0.01, -0.004, 0.001]), "equidistant"),
}
SIZE = (640, 480)
CHESSBOARD = parse_board("chessboard:8x6:0.1")


def poses(
    camera: Camera, board: Board, count: int, tilt: float, seed: int, away: tuple[float, float] = (7, 18)
) -> list[np.ndarray]:
    """T_camera_board of `count` views that see the whole board `away` squares off, tilts up to `tilt` degrees."""
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    while len(found) < count:
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.radians(rng.uniform(-tilt, tilt, 3)) * [1, 1, 0.5])[0]
        ray = camera.rays(np.array([rng.uniform([100, 80], [540, 400])]))[0]
        T[:3, 3] = ray * rng.uniform(*away) * board.square - T[:3, :3] @ board.corners.mean(axis=0)
        px = camera.project(board.corners @ T[:3, :3].T + T[:3, 3])
        edge = 20 if board.radius else 5  # px
        if np.isfinite(px).all() and (px > edge).all() and (px < np.array(SIZE) - edge).all():
            found.append(T)
    return found


def views(model: str, count: int = 15, noise: float = 0.1, tilt: float = 40.0, seed: int = 0) -> list[BoardView]:
    """Exact corners with `noise` (px)."""
    rng = np.random.default_rng(seed + 1000)
    corners = CHESSBOARD.corners
    made = []
    for i, T in enumerate(poses(CAMERAS[model], CHESSBOARD, count, tilt, seed)):
        px = CAMERAS[model].project(corners @ T[:3, :3].T + T[:3, 3])
        made.append(BoardView(f"view {i}", corners, px + noise * rng.normal(size=px.shape)))
    return made


@cache
def rays_of(model: str) -> np.ndarray:
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    return CAMERAS[model].rays(np.column_stack([x.ravel(), y.ravel()]))


def photograph(model: str, board: Board, T: np.ndarray) -> np.ndarray:
    """A grey picture of the board with its white border before grey, a little blurred and noisy."""
    rays, R, t = rays_of(model), T[:3, :3], T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = ((rays * ((R[:, 2] @ t) / (rays @ R[:, 2]))[:, None] - t) @ R)[:, :2]
    # px per square of a drawing, blurred to about a pixel of the picture; whole modules of an AprilGrid's tags, too
    fine = 52 if board.kind == "aprilgrid" else 40
    across, down = board.squares
    drawing = np.full((round((down + 2) * fine), round((across + 2) * fine)), 230, np.uint8)
    for x0, y0, x1, y1 in np.rint((board.dark() / board.square + 1) * fine).astype(int):
        drawing[y0:y1, x0:x1] = 25
    if board.radius:
        discs, radius = (board.corners[:, :2] / board.square + 1) * fine - 0.5, board.radius / board.square * fine
        y, x = np.indices(drawing.shape)
        drawing[(np.hypot(x[..., None] - discs[:, 0], y[..., None] - discs[:, 1]) < radius).any(axis=-1)] = 25
    maps = (np.nan_to_num((at / board.square + 1) * fine - 0.5, nan=-1e3).clip(-1e3, 1e4)).astype(np.float32)
    maps = maps.reshape(SIZE[1], SIZE[0], 2)
    soft = cv2.GaussianBlur(drawing, (0, 0), 0.8)
    picture = cv2.remap(soft, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128)
    return (picture + np.random.default_rng(0).normal(size=picture.shape)).clip(0, 255).round().astype(np.uint8)
