"""Clusters of points: what touches, and what stands on a level face of another thing."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from perception.observation.settings import SegmentConfig
from perception.observation.support_plane import horizontal, over


def groups(points: Float[np.ndarray, "n d"], voxel: float) -> Int[np.ndarray, "n"]:
    """Euclidean clusters: the group (0..) of each point, where points in touching voxels are of one group."""
    if not len(points):
        return np.zeros(0, np.intp)
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64) + 1
    shape = cells.max(axis=0) + 1
    keys, of_cell = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)), return_inverse=True)
    cells = np.stack(np.unravel_index(keys, tuple(shape)), axis=-1)
    pairs = cKDTree(cells).query_pairs(1.0, p=np.inf, output_type="ndarray")
    touching = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    return connected_components(touching, directed=False)[1][of_cell]


def unstacked(
    cloud: Float[np.ndarray, "n 3"],
    height: Float[np.ndarray, "n"],
    plane: Float[np.ndarray, "4"],
    config: SegmentConfig,
) -> list[Int[np.ndarray, "m"]]:
    """Indices of the parts of one cluster, cut where something stands on a level face (a can on a box).

    A level face is a layer of height with far more points than the others; sides fill all layers equally.
    A part less than half as wide as all below it is a neck, spout or knob, and is not cut off.
    """

    flat = cloud @ horizontal(plane).T

    def width(part: Bool[np.ndarray, "n"]) -> float:
        return float(np.ptp(np.percentile(flat[part], [2, 98], axis=0), axis=0).max())

    bins = np.arange(0.0, height.max() + 0.006, 0.006)
    count = np.histogram(height, bins)[0]
    layers = count[1:] + count[:-1]  # 12 mm thick, in steps of 6
    for i in np.flatnonzero(layers > max(0.15 * len(cloud), 6.0 * float(np.median(count)))):
        level = bins[i + 1]
        upper = height > level + 0.006 + config.base
        if level < config.lifted or upper.sum() < config.min_cluster_pixels:
            continue
        # It must stand over the face, not beside it: its outline does not continue below.
        carried = over(cloud[upper], plane, cloud[np.abs(height - level) < 0.006]).mean() > 0.5
        beneath = cKDTree(flat[height < level - 0.006]).query(flat[upper & (height < level + 0.03)])[0] < config.voxel
        tall = height.max() > level + config.min_height
        if carried and tall and beneath.mean() < 0.3 and width(upper) > 0.5 * width(~upper):
            above, below = np.flatnonzero(upper), np.flatnonzero(~upper)
            group = groups(cloud[above], config.voxel)
            return [below, *(above[group == g] for g in range(group.max() + 1))]
    return [np.arange(len(cloud))]
