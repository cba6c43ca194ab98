"""Rigid transforms: what a pose must be, whoever gives it."""

import numpy as np
from jaxtyping import Bool, Float


def rigid(T: Float[np.ndarray, "*n 4 4"]) -> Bool[np.ndarray, "*n"]:
    """Whether each is a rotation R (R R^T = I to 1e-3, det R > 0) beside a translation, 0 0 0 1 below; all finite."""
    finite = np.isfinite(T).all(axis=(-2, -1))
    T = np.where(finite[..., None, None], T, 0.0)
    R = T[..., :3, :3]
    turns = (np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)) < 1e-3).all(axis=(-2, -1)) & (np.linalg.det(R) > 0)
    return finite & turns & (np.abs(T[..., 3, :] - [0, 0, 0, 1]) < 1e-6).all(axis=-1)


def look_at(position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """T_object_camera of an upright camera (OpenCV axes: x right, y down, z forward) that looks at `target`."""
    forward = np.asarray(target, float) - np.asarray(position, float)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:  # straight up or down: the picture's right is the object's +y
        right = np.array([0.0, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    transform = np.eye(4)
    transform[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    transform[:3, 3] = position
    return transform


def pinhole_rays(
    T_object_camera: Float[np.ndarray, "4 4"], focal_px: float, size: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and unit directions of a square picture's pixels, row by row; pixel centres lie at +0.5."""
    pixel = np.arange(size) + 0.5 - 0.5 * size
    v, u = np.meshgrid(pixel, pixel, indexing="ij")
    rays = np.stack([u, v, np.full_like(u, focal_px)], axis=-1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ T_object_camera[:3, :3].T
    origins = np.broadcast_to(T_object_camera[:3, 3], rays.shape)
    return origins.astype(np.float32), rays.astype(np.float32)
