"""Views of a bent board by a known camera, with the errors of real corners: alike within a picture."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from calibration.boards import parse_board
from calibration.camera import Camera
from calibration.fit import BoardView, Model

SIZE = (640, 480)
BOARD = parse_board("chessboard:8x6:0.03")
BOW = (0.0005, 0.002)  # m, from the lowest corner to the highest
_TILT = 40.0  # degrees
_WHITE, _SMOOTH = 0.05, 0.1  # px, medians over pictures: errors of single corners, and those that neighbours share
_SPREAD = 0.4  # of the logarithms of both
_BLUR = 1.5  # errors along the blur are larger by up to this, times those of single corners
_WAVES = 8  # that a smooth error is made of


def bent_views(model: Model, count: int, seed: int) -> tuple[Camera, list[BoardView]]:
    """A random camera, and `count` views of one board that is bent to a sphere or a cylinder (`BOW`)."""
    rng = np.random.default_rng(seed)
    camera, corners = _camera(rng, model), BOARD.corners
    middle = corners.mean(axis=0)
    half = float((corners - middle)[:, 0].max())
    bent = corners + np.outer(_heights((corners - middle)[:, :2], rng), [0.0, 0.0, 1.0])
    views: list[BoardView] = []
    while len(views) < count:
        R = Rotation.from_rotvec(np.radians(rng.uniform(-_TILT, _TILT, 3)) * [1, 1, 0.5]).as_matrix()
        ray = camera.rays(rng.uniform([60, 50], [580, 430])[None])[0]
        shift = ray / ray[2] * 2 * half * camera.K[0, 0] / (rng.uniform(0.25, 0.7) * SIZE[0]) - R @ middle
        placed = bent @ R.T + shift
        pixels = camera.project(placed)
        if (placed[:, 2] > half / 5).all() and (pixels > 5).all() and (pixels < np.array(SIZE) - 5).all():
            length = 2 * half * camera.K[0, 0] / float(np.linalg.norm(shift))  # px, of the board
            views.append(BoardView(f"view {len(views)}", corners, pixels + _errors(pixels, length, rng)))
    return camera, views


def _camera(rng: np.random.Generator, model: Model) -> Camera:
    if model == "equidistant":
        f = rng.uniform(230, 300)
        distortion = rng.normal([-0.02, 0.01, -0.004, 0.001], [0.02, 0.005, 0.001, 0.0005])
    else:
        f = rng.uniform(420, 700)
        distortion = np.array([rng.uniform(-0.35, 0.1), rng.uniform(-0.1, 0.1), *rng.normal(0, 5e-4, 2), 0.0])
    cx, cy = rng.normal([320, 240], 10)
    K = np.array([[f, 0.0, cx], [0.0, f * rng.normal(1.0, 0.002), cy], [0.0, 0.0, 1.0]])
    return Camera(*SIZE, K, distortion, model)


def _heights(at: Float[np.ndarray, "n 2"], rng: np.random.Generator) -> Float[np.ndarray, "n"]:
    """m, of the corners over the plane; `at` are their places about the middle."""
    across = rng.uniform(0, np.pi)
    cylinder = (at @ [np.cos(across), np.sin(across)]) ** 2
    square = cylinder if rng.random() < 0.5 else (at**2).sum(axis=1)
    return rng.uniform(*BOW) * rng.choice([-1.0, 1.0]) * square / np.ptp(square)


def _errors(pixels: Float[np.ndarray, "n 2"], length: float, rng: np.random.Generator) -> Float[np.ndarray, "n 2"]:
    """px: independent ones, larger along a blur, and ones that vary smoothly over the board of `length` px."""
    white, smooth = np.exp(rng.normal(np.log([_WHITE, _SMOOTH]), _SPREAD))
    blur = rng.uniform(0, np.pi)
    errors = white * rng.normal(size=pixels.shape)
    along = white * rng.uniform(0, _BLUR) * rng.normal(size=len(pixels))
    waves = pixels @ rng.normal(0, 3 / length, (2, _WAVES)) + rng.uniform(0, 2 * np.pi, _WAVES)
    return (
        errors
        + np.outer(along, [np.cos(blur), np.sin(blur)])
        + np.cos(waves) @ rng.normal(0, smooth * np.sqrt(2 / _WAVES), (_WAVES, 2))
    )
