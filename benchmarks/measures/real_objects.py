"""Measures of hypotheses about a real object whose model and pose are known."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from benchmarks.measures.metrics import symmetric_chamfer
from benchmarks.scenes.real_frames import TrueObject
from perception.answers.hypotheses import Hypotheses, surface_points
from perception.observation.support_plane import heights
from perception.sources.frame import Frame

BEHIND = 0.010  # m behind the measured depth counts as hidden
IN_SIGHT = 0.005  # m from the measured depth counts as seen
SAMPLES = 40_000  # uniform points that free ones are taken from
NEAR = (0.005, 0.015)  # m outside the true surface


def depth_at(frame: Frame, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """The measured depth (m) where points (camera frame, m) are seen; NaN without a measurement."""
    px = np.round(frame.camera.project(points))
    size = np.array([frame.camera.width, frame.camera.height])
    inside = np.asarray(((px >= 0) & (px < size)).all(axis=1))
    u, v = np.where(inside[:, None], px, 0).astype(int).T
    assert frame.depth is not None
    return np.where(inside, frame.depth[v, u], np.nan)


def is_hidden(frame: Frame, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame, m) lie at least 10 mm behind the measured depth; false without a measurement."""
    with np.errstate(invalid="ignore"):
        return np.asarray(points[:, 2] >= depth_at(frame, points) + BEHIND)


def outward_normals(points: Float[np.ndarray, "n 3"], neighbours: int = 12) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a surface's points from their neighbours' plane, turned away from the points' middle."""
    near = points[cKDTree(points).query(points, neighbours)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return normals * np.where(np.einsum("ni,ni->n", normals, points - middle) < 0, -1.0, 1.0)[:, None]


def free_points(
    frame: Frame, plane: Float[np.ndarray, "4"], truth: Mapping[int, TrueObject], object_id: int, seed: int = 0
) -> Float[np.ndarray, "n 3"]:
    """Unseen free points of an object's surroundings (camera frame, m).

    Uniform in the model's box enlarged by 6 cm, above the plane, at least 10 mm behind the measured depth, outside of
    every model's box by 5 mm, and 15 mm from any true surface.
    """
    own = truth[object_id]
    rng = np.random.default_rng([seed, object_id, 37])
    low, high = own.points.min(axis=0) - 0.06, own.points.max(axis=0) + 0.06
    points = rng.uniform(low, high, (SAMPLES, 3)) @ own.T_camera_object[:3, :3].T + own.T_camera_object[:3, 3]
    keep = (heights(points, plane) > 0) & is_hidden(frame, points)
    for other in truth.values():
        keep &= ~other.box_holds(points, 0.005)
    keep &= cKDTree(np.concatenate([other.in_camera for other in truth.values()])).query(points)[0] >= 0.015
    return points[keep]


def near_points(
    frame: Frame, plane: Float[np.ndarray, "4"], truth: Mapping[int, TrueObject], object_id: int, seed: int = 0
) -> Float[np.ndarray, "n 3"]:
    """Hidden points (camera frame, m) 5 to 15 mm outside of an object's surface, above the plane and outside of all."""
    surface = truth[object_id].in_camera
    distance = np.random.default_rng([seed, object_id, 41]).uniform(*NEAR, len(surface))
    points = surface + distance[:, None] * outward_normals(surface)
    clear = cKDTree(np.concatenate([t.in_camera for t in truth.values()])).query(points)[0] >= 0.8 * distance
    return points[clear & (heights(points, plane) > 0) & is_hidden(frame, points)]


def hidden_surface(
    frame: Frame, plane: Float[np.ndarray, "4"], own: TrueObject
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """Points (camera frame, m) of an object's surface at least 10 mm behind the measured depth: those above the plane,
    and those in the table. Nothing is in the table; there the true pose and the measured depth contradict each other.
    """
    surface = own.in_camera
    hidden = surface[is_hidden(frame, surface)]
    above = heights(hidden, plane) > 0
    return hidden[above], hidden[~above]


def chamfer_mm(h: Hypotheses, own: TrueObject) -> float:
    """Symmetric Chamfer distance between a hypothesis' surface and the true model, mm: the weighted median."""
    surface = h.object_frame.to_cube(own.in_camera) * h.object_frame.half_extent  # metres in the object frame
    distance = np.array([symmetric_chamfer(surface_points(h, i), surface) for i in range(len(h.weights))])
    return 1000.0 * float(np.quantile(distance, 0.5, weights=h.weights, method="inverted_cdf"))


def in_sight(h: Hypotheses, frame: Frame, own: TrueObject) -> float:
    """Of the true surface within 5 mm of the measured depth, the share with p_occupied >= 0.9 within one voxel."""
    surface = own.in_camera
    with np.errstate(invalid="ignore"):
        seen = surface[np.abs(surface[:, 2] - depth_at(frame, surface)) <= IN_SIGHT]
    index = h.voxels("camera", *seen.T)
    about = np.where(index >= 0, maximum_filter(h.p_occupied, 3).ravel()[index], 0.0)
    return float(np.mean(about >= 0.9)) if len(about) else float("nan")
