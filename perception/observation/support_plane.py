"""Planes that things may stand on, found in a frame's points."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

from perception.observation.settings import PlaneConfig


def noise_growth(points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """How much more than within 1 m a sensor's depth errs at points in the camera frame (m): with depth squared."""
    return np.maximum(1.0, points[..., 2] ** 2)


def heights(points: Float[np.ndarray, "... 3"], plane: Float[np.ndarray, "4"]) -> Float[np.ndarray, "..."]:
    """Signed distance of points to a plane (m), positive above."""
    return points @ plane[:3] + plane[3]


def planes(points: Float[np.ndarray, "h w 3"], config: PlaneConfig) -> list[Float[np.ndarray, "4"]]:
    """The planes (n, d) of a frame, the camera on their upper side.

    RANSAC over triplets of points up to a quarter of the picture apart, one plane after the other, each refitted to its
    inliers by total least squares. Planes of fewer than `least` of the points are none.
    """
    rng = np.random.default_rng(config.seed)
    size = np.array(points.shape[:2])
    pixels = np.argwhere(np.isfinite(points[..., 2]))
    pixels = pixels[rng.permutation(len(pixels))[:20_000]]
    cloud = points[pixels[:, 0], pixels[:, 1]]
    slab = config.tolerance * noise_growth(cloud)
    free = np.ones(len(cloud), bool)  # not yet on a plane
    found = []
    for _ in range(config.most):
        if free.sum() < max(3, config.least * len(cloud)):
            break
        seeds = pixels[rng.choice(np.flatnonzero(free), config.triplets)]
        corners = [points[seeds[:, 0], seeds[:, 1]]]
        for _ in range(2):
            near = np.clip(seeds + rng.integers(-size // 4, size // 4 + 1, seeds.shape), 0, size - 1)
            corners.append(points[near[:, 0], near[:, 1]])
        normals = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        length = np.linalg.norm(normals, axis=1)
        usable = length > 1e-9  # false for NaN corners too
        normals, origins = normals[usable] / length[usable, None], corners[0][usable]
        if not len(normals):
            continue
        sparse = cloud[free][:2000]
        distance = np.abs(sparse @ normals.T - np.einsum("ij,ij->i", normals, origins))
        at = int((distance < slab[free][:2000, None]).sum(axis=0).argmax())
        plane = np.append(normals[at], -normals[at] @ origins[at])
        for _ in range(4):
            on = free & (np.abs(heights(cloud, plane)) < slab)
            if on.sum() < 3:
                break
            centre = cloud[on].mean(axis=0)
            normal = np.linalg.eigh(np.cov((cloud[on] - centre).T))[1][:, 0]
            plane = np.append(normal, -normal @ centre)
        plane *= np.sign(plane[3]) or 1.0
        free &= ~on
        if on.mean() >= config.least:
            found.append(plane)
    return found


def upward(plane: Float[np.ndarray, "4"]) -> float:
    """How readily a plane is taken for a support: a quarter if it isn't across the picture's upward direction."""
    return 1.0 if -plane[1] > 0.1 else 0.25


def on_plane(
    points: Float[np.ndarray, "h w 3"], plane: Float[np.ndarray, "4"], config: PlaneConfig
) -> Bool[np.ndarray, "h w"]:
    """The pixels that see a plane, or something as high."""
    return np.abs(heights(points, plane)) < config.tolerance * noise_growth(points)


def support_of(
    points: Float[np.ndarray, "h w 3"],
    label: Int[np.ndarray, "h w"],
    candidates: Sequence[Float[np.ndarray, "4"]],
    config: PlaneConfig,
) -> Float[np.ndarray, "4"]:
    """Of candidates (at least one), the support of labelled pixels: the largest of those that carry most labels."""
    given, measured = label > 0, np.isfinite(points[..., 2])
    cloud = points[given & measured][::7]
    best, best_score = candidates[0], 0.0
    for plane in candidates:
        on = on_plane(points, plane, config)
        height = heights(cloud, plane)
        standing = over(cloud, plane, points[on][::7], -0.02) & (height > 0.0) & (height < config.highest)
        score = on.sum() * upward(plane) * (1.0 if standing.sum() > 0.5 * len(cloud) else 0.1)
        if score > best_score:
            best, best_score = plane, score
    return best


def horizontal(plane: Float[np.ndarray, "4"]) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors that span a plane."""
    first = np.cross(plane[:3], np.eye(3)[np.abs(plane[:3]).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(plane[:3], first)])


def over(
    points: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"], on: Float[np.ndarray, "m 3"], margin: float = 0.01
) -> Bool[np.ndarray, "n"]:
    """Which points are over (or under) the convex hull of points on a plane, grown by `margin` (m)."""
    axes = horizontal(plane)
    try:
        edges = ConvexHull(on @ axes.T).equations.astype(np.float32)
    except (QhullError, ValueError):  # too few points, or all in a line
        return np.zeros(len(points), bool)
    flat = (points @ axes.T).astype(np.float32)
    return (flat @ edges[:, :2].T + edges[:, 2]).max(axis=1) <= margin
