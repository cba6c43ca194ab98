"""Depth of another camera, or of another size, in the pixels of the colour image."""

import numpy as np
from jaxtyping import Float, Float32

from calibration.camera import Camera


def registered(
    depth: Float32[np.ndarray, "a b"],
    depth_camera: Camera,
    camera: Camera,
    T_color_depth: Float[np.ndarray, "4 4"] | None = None,
) -> Float32[np.ndarray, "h w"]:
    """Depth (m along the colour camera's z; NaN where unknown) from a depth camera's picture.

    `T_color_depth`: p_color = T_color_depth @ p_depth, metres (None: the same place). Every depth pixel covers the
    pixels of its own width about the place where its point is seen; of several the nearest counts.
    """
    T = np.eye(4) if T_color_depth is None else T_color_depth
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    rays = depth_camera.rays(np.column_stack([u, v]))
    points = rays / rays[:, 2:] * depth[v, u, None] @ T[:3, :3].T + T[:3, 3]
    pixels = camera.project(points)
    usable = np.isfinite(pixels).all(axis=1)
    points, pixels = points[usable], pixels[usable]
    width = max(camera.K[0, 0] / depth_camera.K[0, 0], 1.0)
    reach = int(np.ceil(0.5 * width))
    found = np.full(camera.height * camera.width, np.inf, np.float32)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            at = np.rint(pixels).astype(np.int64) + np.array([dx, dy])
            inside = (np.abs(at - pixels) <= 0.5 * width + 1e-6).all(axis=1)
            inside &= ((at >= 0) & (at < [camera.width, camera.height])).all(axis=1)
            np.minimum.at(found, at[inside, 1] * camera.width + at[inside, 0], points[inside, 2].astype(np.float32))
    found[~np.isfinite(found)] = np.nan
    return found.reshape(camera.height, camera.width)
