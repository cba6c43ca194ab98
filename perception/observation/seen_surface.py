"""Whether what a picture showed is gone: a later one sees through the place where its surface was."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.observation.segmentation import backproject
from perception.sources.frame import Frame

POINTS = 2000  # of a surface, evenly spread
BEYOND_M = 0.005  # behind a point, from which on a range has passed it
GONE = 0.7  # share of the points: those near the table stand before it alone


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Points of an object that a picture showed; none if it had no depth."""

    points: Float[np.ndarray, "n 3"]  # camera frame, m
    T_world_camera: Float[np.ndarray, "4 4"] | None


def seen_surface(frame: Frame, mask: np.ndarray) -> SeenSurface:
    """What a frame shows of an object with this mask (bool [h, w])."""
    if frame.depth is None:
        return SeenSurface(np.zeros((0, 3)), frame.T_world_camera)
    points = backproject(frame)[mask & np.isfinite(frame.depth)]
    return SeenSurface(points[:: max(1, len(points) // POINTS)], frame.T_world_camera)


def is_gone(surface: SeenSurface, frame: Frame) -> bool:
    """Whether the frame has measured ranges behind nearly all of a surface.

    A frame without depth there, or that does not look there, shows nothing. Without poses the camera has not moved.
    """
    if frame.depth is None or not len(surface.points):
        return False
    points = surface.points
    if surface.T_world_camera is not None and frame.T_world_camera is not None:
        T = np.linalg.inv(frame.T_world_camera) @ surface.T_world_camera
        points = points @ T[:3, :3].T + T[:3, 3]
    pixels = frame.camera.project(points)
    inside = np.isfinite(pixels).all(axis=1)
    u, v = np.round(pixels[inside]).astype(int).T
    height, width = frame.depth.shape
    shown = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth = frame.depth[v[shown], u[shown]]
    return bool((depth > points[inside][shown, 2] + BEYOND_M).sum() >= GONE * len(points))  # NaN is not beyond
