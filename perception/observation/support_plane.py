"""The support plane, found in a frame's points."""

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


def support_plane(
    points: Float[np.ndarray, "h w 3"], label: Int[np.ndarray, "h w"] | None, config: PlaneConfig
) -> tuple[Float[np.ndarray, "4"], Bool[np.ndarray, "h w"]]:
    """The support plane (n, d) and its pixels.

    RANSAC over triplets of points up to a quarter of the picture apart, four planes one after the other, each refitted
    to its inliers by total least squares. The plane with most pixels wins. A plane not perpendicular to the picture's
    upward direction (a wall) counts a quarter, and one with nothing on it (the floor, a box's top) a tenth. Objects on
    it are the labelled pixels, or without a label map any points a little higher.
    Raises `ValueError` if no plane holds a twentieth of the points.
    """
    rng = np.random.default_rng(config.seed)
    size = np.array(points.shape[:2])
    pixels = np.argwhere(np.isfinite(points[..., 2]))
    pixels = pixels[rng.permutation(len(pixels))[:20_000]]
    cloud = points[pixels[:, 0], pixels[:, 1]]
    growth = noise_growth(cloud)
    slab = config.tolerance * growth
    things = np.ones(len(cloud), bool) if label is None else label[pixels[:, 0], pixels[:, 1]] > 0
    free = np.ones(len(cloud), bool)  # not yet on a plane
    best, best_score = None, 0.0
    for _ in range(4):
        if free.sum() < max(3, 0.05 * len(cloud)):
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
        plane *= np.sign(plane[3]) or 1.0  # the camera is on the upper side
        share = on.mean()
        free &= ~on
        if share < 0.05:
            continue
        height = heights(cloud, plane)
        higher = (height > (0.0 if label is not None else config.lowest * growth)) & (height < config.highest)
        standing = (higher & over(cloud, plane, cloud[on], -0.02))[things].sum() > things.sum() * (
            0.001 if label is None else 0.5
        )
        score = share * (1.0 if -plane[1] > 0.1 else 0.25) * (1.0 if standing else 0.1)
        if score > best_score:
            best, best_score = plane, score
    if best is None:
        raise ValueError("no support plane was found; show more of the table, or check the depth and its unit")
    return best, np.abs(heights(points, best)) < config.tolerance * noise_growth(points)


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
