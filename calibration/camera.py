"""The pinhole camera with lens distortion: pixels to rays and points to pixels."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

# Lengths of OpenCV's distortion vector that each ROS model name stands for.
_DISTORTION_LENGTHS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14)}
# Undistortion is iterative; OpenCV's default of 5 steps leaves up to a pixel at the corners of a wide lens.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
_INVERSE_TOLERANCE_PX = 0.05


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera at one image size. Axes: x right, y down, z forward; pixel centres at whole numbers.

    Raises `ValueError` where a field cannot be a camera's.
    """

    width: int  # px
    height: int  # px
    K: Float[np.ndarray, "3 3"]  # px, last row 0 0 1
    distortion: Float[np.ndarray, "d"]  # OpenCV's order (k1, k2, p1, p2, k3, ...); zeros: none
    model: str = "plumb_bob"  # or "rational_polynomial"
    K_std: Float[np.ndarray, "3 3"] | None = None  # px, standard deviations
    distortion_std: Float[np.ndarray, "d"] | None = None
    rms: float | None = None  # px, of the calibration that made it

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise ValueError(f"camera size is {self.width}x{self.height} px; both must be positive")
        K = np.array(self.K, dtype=np.float64)
        if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
            raise ValueError(
                f"camera matrix {K.tolist()} is not a finite 3x3 with positive focal lengths; calibrate again"
            )
        if not np.allclose(K[2], [0.0, 0.0, 1.0]):
            raise ValueError(f"camera matrix has last row {K[2].tolist()}; it must be 0 0 1 (is it transposed?)")
        if self.model not in _DISTORTION_LENGTHS:
            raise ValueError(f"distortion model {self.model!r} is unknown; use {' or '.join(_DISTORTION_LENGTHS)}")
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        lengths = _DISTORTION_LENGTHS[self.model]
        if distortion.size not in lengths or not np.isfinite(distortion).all():
            wanted = " or ".join(map(str, lengths))
            raise ValueError(
                f"distortion {distortion.tolist()} does not fit {self.model}: {wanted} finite numbers wanted"
            )
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", distortion)

    def rays(self, pixels: Float[np.ndarray, "n 2"] | Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions, camera frame, through pixels (x, y); NaN where the lens model has no inverse."""
        px = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if len(px) == 0:
            return np.zeros((0, 3))
        if self.distortion.any():
            xy = cv2.undistortPoints(px, self.K, self.distortion, criteria=_CRITERIA).reshape(-1, 2)
        else:  # exact, and the skew is honoured, which OpenCV ignores
            xy = (px.reshape(-1, 2) - self.K[:2, 2]) / [self.K[0, 0], self.K[1, 1]]
            xy[:, 0] -= self.K[0, 1] / self.K[0, 0] * xy[:, 1]
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        if self.distortion.any():  # OpenCV answers even where its iteration diverged
            error = np.linalg.norm(self.project(rays) - px.reshape(-1, 2), axis=1)
            rays[~(error < _INVERSE_TOLERANCE_PX)] = np.nan
        return rays

    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels (x, y) of points in the camera frame (any unit); NaN for points not in front of the camera."""
        xyz = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if len(xyz) == 0:
            return np.zeros((0, 2))
        if self.distortion.any():
            px = cv2.projectPoints(xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.K, self.distortion)[0]
            px = np.asarray(px, dtype=np.float64).reshape(-1, 2)
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                px = (xyz @ self.K.T)[:, :2] / xyz[:, 2:]
        px[~(xyz[:, 2] > 0)] = np.nan
        return px
