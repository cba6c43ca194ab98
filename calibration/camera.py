"""The camera with its lens: pixels to rays and points to pixels, by the distortion model itself."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

# Lengths of OpenCV's distortion vector for each ROS model name.
DISTORTION_LENGTHS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
# Undistortion is iterative; OpenCV's default of 5 steps leaves up to a pixel at the corners of a wide lens.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
_INVERSE_TOLERANCE_PX = 0.05


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera at one image size. Axes: x right, y down, z forward; pixel centres at whole numbers.

    Models have their ROS names. `equidistant` is OpenCV's fisheye (Kannala and Brandt 2006): a ray at the angle theta
    from the axis falls at the radius theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), in focal lengths.
    Raises `ValueError` if a field cannot be a camera's.
    """

    width: int  # px
    height: int  # px
    K: Float[np.ndarray, "3 3"]  # px, last row 0 0 1
    distortion: Float[np.ndarray, "d"]  # OpenCV's order (k1, k2, p1, p2, k3, ...); equidistant: k1 to k4
    model: str = "plumb_bob"  # or "rational_polynomial", "equidistant" (also given as "fisheye")
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
        model = "equidistant" if self.model == "fisheye" else self.model
        if model not in DISTORTION_LENGTHS:
            raise ValueError(f"distortion model {model!r} is unknown; use {' or '.join(DISTORTION_LENGTHS)}")
        distortion = np.array(self.distortion, dtype=np.float64).ravel()
        lengths = DISTORTION_LENGTHS[model]
        if distortion.size not in lengths or not np.isfinite(distortion).all():
            wanted = " or ".join(map(str, lengths))
            raise ValueError(f"distortion {distortion.tolist()} does not fit {model}: {wanted} finite numbers wanted")
        for name, of in (("K_std", K), ("distortion_std", distortion), ("rms", np.zeros(()))):
            if (values := getattr(self, name)) is None:
                continue
            values = np.asarray(values, np.float64)
            if values.shape != of.shape or not (values >= 0).all():
                wanted = f"{'x'.join(map(str, of.shape))} numbers" if of.shape else "one number"
                raise ValueError(f"{name} is {values.tolist()}; {wanted} wanted, 0 or more")
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", distortion)

    def rays(self, pixels: Float[np.ndarray, "n 2"] | Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions, camera frame, through pixels (x, y); NaN where no ray from before the camera meets one."""
        px = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        if len(px) == 0:
            return np.zeros((0, 3))
        if self.model == "equidistant" or not self.distortion.any():  # exact; and the skew counts, which OpenCV ignores
            xy = (px - self.K[:2, 2]) / [self.K[0, 0], self.K[1, 1]]
            xy[:, 0] -= self.K[0, 1] / self.K[0, 0] * xy[:, 1]
        else:
            # OpenCV 4 has a function of its own for the criteria, which 5 takes in undistortPoints.
            undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
            xy = undistort(px[:, None], self.K, self.distortion, R=None, P=None, criteria=_CRITERIA).reshape(-1, 2)
        if self.model == "equidistant":
            radius = np.linalg.norm(xy, axis=1)
            theta = self._angle(radius)
            rays = np.column_stack([np.sinc(theta / np.pi)[:, None] * xy, np.cos(theta)])
            rays[:, :2] *= (theta / np.where(radius > 0, radius, 1.0))[:, None]
            return rays
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        if self.distortion.any():  # OpenCV answers even where its iteration diverged
            with np.errstate(over="ignore"):  # far beyond the tolerance
                error = np.linalg.norm(self.project(rays) - px, axis=1)
            rays[~(error < _INVERSE_TOLERANCE_PX)] = np.nan
        return rays

    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels (x, y) of points in the camera frame (any unit); NaN for points not in front of the camera."""
        xyz = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if len(xyz) == 0:
            return np.zeros((0, 2))
        if self.model == "equidistant":
            across = np.linalg.norm(xyz[:, :2], axis=1)
            radius = self._radius(np.arctan2(across, xyz[:, 2]))
            flat = xyz[:, :2] * (radius / np.where(across > 0, across, 1.0))[:, None]
            px = flat @ self.K[:2, :2].T + self.K[:2, 2]
        elif self.distortion.any():
            px = cv2.projectPoints(xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.K, self.distortion)[0]
            px = np.asarray(px, dtype=np.float64).reshape(-1, 2)
        else:
            x, y, z = xyz.T
            with np.errstate(divide="ignore", invalid="ignore"):  # row by row: BLAS gains nothing on so small a matrix
                px = np.stack([(a * x + b * y + c * z) / z for a, b, c in self.K[:2]], axis=-1)
        px[~(xyz[:, 2] > 0)] = np.nan
        return px

    def project_posed(
        self, points: Float[np.ndarray, "n 3"], turn: Float[np.ndarray, "3"], shift: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m p"], Float[np.ndarray, "m 6"]]:
        """Pixels of a body's points, and their derivatives by the intrinsics and by the pose.

        The pose is T_camera_body as a rotation vector `turn` and a `shift` (the unit of `points`); m = 2n rows are
        x and y of each point in turn. Intrinsics are (fx, fy, cx, cy, distortion), the pose is (turn, shift).
        """
        if self.model == "equidistant":
            px, J = cv2.fisheye.projectPoints(points.reshape(1, -1, 3), turn, shift, self.K, self.distortion)
            inner, outer = J[:, :8], J[:, 8:14]
        else:
            px, J = cv2.projectPoints(points, turn, shift, self.K, self.distortion)[:2]
            inner, outer = J[:, 6 : 10 + len(self.distortion)], J[:, :6]
        return np.reshape(px, (-1, 2)), inner, outer

    def _radius(self, theta: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """The fisheye's radius (focal lengths) at the angle theta from the axis."""
        return theta * np.polynomial.polynomial.polyval(theta**2, [1.0, *self.distortion])

    def _angle(self, radius: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """The inverse of `_radius`, by bisection up to 90 degrees or to where the lens folds over; NaN beyond."""
        grid = np.linspace(0.0, np.pi / 2, 1000)
        falls = np.flatnonzero(np.diff(self._radius(grid)) <= 0)
        end = grid[falls[0]] if len(falls) else grid[-1]
        low, high = np.zeros_like(radius), np.full_like(radius, end)
        for _ in range(50):  # to 1e-15 rad
            middle = (low + high) / 2
            below = self._radius(middle) < radius
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.where(radius < self._radius(np.array([end])), (low + high) / 2, np.nan)
