"""Whether what a picture showed is gone: a later one sees through the place where its surface was."""

import numpy as np
from jaxtyping import Bool

from perception.sources.frame import Frame

POINTS = 2000  # of a surface, evenly spread
BEYOND_M = 0.005  # behind a point, from which on a range has passed it
GONE = 0.7  # share of the points: those near the table stand before it alone


def is_gone(before: Frame, mask: Bool[np.ndarray, "h w"], frame: Frame) -> bool:
    """Whether the frame has measured ranges behind nearly all of the surface that `before` showed in `mask`.

    A frame without depth there, or that does not look there, shows nothing. Without poses the camera has not moved.
    """
    if before.depth is None or frame.depth is None:
        return False
    v, u = np.nonzero(mask & np.isfinite(before.depth))
    v, u = (a[:: max(1, len(v) // POINTS)] for a in (v, u))
    if not len(v):
        return False
    rays = before.camera.rays(np.column_stack([u, v]))
    points = rays / rays[:, 2:] * before.depth[v, u, None]  # camera frame, m
    if before.T_world_camera is not None and frame.T_world_camera is not None:
        T = np.linalg.inv(frame.T_world_camera) @ before.T_world_camera
        points = points @ T[:3, :3].T + T[:3, 3]
    pixels = frame.camera.project(points)
    inside = np.isfinite(pixels).all(axis=1)
    u, v = np.round(pixels[inside]).astype(int).T
    height, width = frame.depth.shape
    shown = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = frame.depth[v[shown], u[shown]]
    return bool((depth > points[inside][shown, 2] + BEYOND_M).sum() >= GONE * len(points))  # NaN is not beyond
