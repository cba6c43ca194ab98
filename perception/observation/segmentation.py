"""Objects in a frame: their masks, the plane each stands on, and the status of every pixel for each of them.

With depth the plane is measured. Without, it is supposed (`PlaneGuess`) and colour finds the objects (`MaskConfig`).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from perception.observation.colour_masks import label_colour
from perception.observation.settings import SegmentConfig
from perception.observation.support_plane import heights, horizontal, noise_growth, over, support_plane
from perception.observation.without_depth import slopes, supposed_plane
from perception.sources.frame import Frame
from probnerf.types import FREE, OBJECT, UNKNOWN

_SQUARE = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Segment:
    """One object of a frame. The maps share the frame's pixels."""

    id: int  # of the label map; without one 1..n by size
    mask: Bool[np.ndarray, "h w"]  # the object's pixels, with or without depth
    plane: Float[np.ndarray, "4"]  # (n, d): n.p + d = 0 in the camera frame, n unit and up, d the camera's height (m)
    status: Int[np.ndarray, "h w"]  # OBJECT, FREE or UNKNOWN (probnerf.types)
    occluder: Bool[np.ndarray, "h w"]  # UNKNOWN pixels that see something else: their ray is free up to its depth
    plane_sigma: tuple[float, float] | None = None  # m, rad; of the height and tilt of a supposed plane; None: measured


def segment(frame: Frame, object_id: int | None = None, config: SegmentConfig | None = None) -> list[Segment]:
    """The objects of a frame, or the one with `object_id`.

    With a label map its ids are the objects. Without one, points above the support plane are clustered and numbered
    from the largest. Statuses per object: OBJECT in its mask. FREE where the ray is known to miss it: the depth there
    is on or below the support plane, or beyond the object, or absent where the label map says background. UNKNOWN
    otherwise: nearer things, pixels without depth, the rim of the mask, mask pixels whose depth is the background's.

    Without depth, pixels outside the mask and its rim are FREE, except other masks that may belong to things in front
    of the object. Pixels in no mask count as behind it.

    Raises `ValueError` if there is no plane, no such id, or a mask of a few pixels. Without `object_id` masks that
    are too small are passed over, unless none is left.
    """
    config = config or SegmentConfig()
    where = f"frame at {frame.stamp_ns} ns"
    if frame.depth is None:
        try:
            return _segment_colour(frame, object_id, config)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    if not np.isfinite(frame.depth).any():
        raise ValueError(f"{where}: no pixel of {frame.depth.size} has depth; check the depth sensor")
    points = backproject(frame)
    try:
        table, on_table = support_plane(points, frame.label, config.plane)
        if frame.label is None:
            masks = dict(enumerate(_standing(points, table, on_table, config), start=1))
        else:
            masks = {int(i): frame.label == i for i in np.unique(frame.label) if i > 0}
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    if object_id is not None and object_id not in masks:
        raise ValueError(f"{where} has no object {object_id}; its objects: {', '.join(map(str, masks)) or 'none'}")
    segments = []
    for i, mask in masks.items():
        pixels, measured = int(mask.sum()), int((mask & np.isfinite(points[..., 2])).sum())
        if object_id not in (None, i):
            continue
        if measured >= config.min_pixels:
            plane = _own_plane(points, table, mask, config)
            segments.append(Segment(i, mask, plane, *_statuses(points, plane, mask, frame.label, config)))
        elif i == object_id or len(masks) == 1:
            raise ValueError(
                f"{where}: object {i} has {pixels} pixels, {measured} of them with depth; at least {config.min_pixels}"
                " are needed: move the camera nearer or give another object"
            )
    if not segments:
        raise ValueError(f"{where} has no object with {config.min_pixels} pixels of depth; move the camera nearer")
    return segments


def _segment_colour(frame: Frame, object_id: int | None, config: SegmentConfig) -> list[Segment]:
    """The objects of a frame without depth. Raises as `segment`, without the name of the frame."""
    label = label_colour(frame, config.mask)
    ids = [int(i) for i in np.unique(label) if i > 0]
    if config.mask.box_px is not None:  # the other boxes are no objects to infer
        ids = [1]
    if not ids or object_id not in (None, *ids):
        raise ValueError(f"no object {object_id or 'to infer'}; its objects: {', '.join(map(str, ids)) or 'none'}")
    ids = [i for i in ids if object_id in (None, i)]
    plane = supposed_plane(frame, config.guess)
    v, u = np.mgrid[: label.shape[0], : label.shape[1]]
    slope = slopes(frame.camera.rays(np.column_stack([u.ravel(), v.ravel()])), plane).reshape(label.shape)
    band = config.rim if config.mask.box_px is None and config.mask.background is None else config.mask.band
    sigma = (config.guess.height_sigma, float(np.radians(config.guess.tilt_sigma)))
    segments = []
    for i in ids:
        mask = label == i
        grown, core = _around(mask, band)
        front = _may_stand_before(label, i, slope, frame.camera.K[0, 0])
        front = ndimage.binary_dilation(front, _SQUARE, iterations=band) & ~grown if front.any() else front
        status = np.where(core, OBJECT, np.where(grown | front, UNKNOWN, FREE)).astype(np.int32)
        if core.sum() >= config.min_pixels:
            segments.append(Segment(i, mask, plane, status, front, sigma))
        elif len(ids) == 1:
            raise ValueError(
                f"object {i} has {core.sum()} pixels inside its outline; at least {config.min_pixels} are needed: move"
                " the camera nearer or give another object"
            )
    if not segments:
        raise ValueError(f"no object has {config.min_pixels} pixels inside its outline; move the camera nearer")
    return segments


def _may_stand_before(
    label: Int[np.ndarray, "h w"], object_id: int, slope: Float[np.ndarray, "h w"], focal: float
) -> Bool[np.ndarray, "h w"]:
    """Pixels of other things that may hide an object: their lowest visible point is nearer on the plane than its back.

    Its back is as far behind its foot as it is wide: sin(alpha) = R / D for half its width (`monocular`). The foot of a
    thing is nearer than the part that shows above it, so this also holds for hidden feet.
    """
    own = label == object_id
    lowest = float(np.nanpercentile(slope[own], 99.5))
    half_width = 0.5 * np.ptp(np.flatnonzero(own.any(axis=0))) / focal * np.hypot(1.0, lowest)
    sine = np.sin(min(half_width, 1.5))
    back = lowest * (1.0 - sine) / (1.0 + sine)
    others = [i for i in np.unique(label) if i > 0 and i != object_id]
    return np.isin(label, [i for i in others if np.nanpercentile(slope[label == i], 99.5) > back])


def _around(mask: Bool[np.ndarray, "h w"], width: int) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """A mask grown, and shrunk, by `width` px; the picture's border is no outline."""
    grown = ndimage.binary_dilation(mask, _SQUARE, iterations=width)
    return grown, ndimage.binary_erosion(mask, _SQUARE, iterations=width, border_value=1)


def backproject(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """The point that each pixel sees, camera frame (m), NaN without depth. `ValueError` on a frame that has none."""
    if frame.depth is None:
        raise ValueError(f"frame at {frame.stamp_ns} ns has no depth")
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    rays = frame.camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    return (rays / rays[:, 2:]).reshape(*u.shape, 3) * frame.depth[..., None]


def _standing(
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    on_plane: Bool[np.ndarray, "h w"],
    config: SegmentConfig,
) -> list[Bool[np.ndarray, "h w"]]:
    """Masks of the objects on the plane, the largest first. Raises `ValueError` if none is found."""
    # The table is the largest patch of the plane; elsewhere the plane may cut a chair or a shelf.
    patch = _groups(points[on_plane] @ horizontal(plane).T, 0.02)
    table = points[on_plane][patch == np.bincount(patch).argmax()][::7]
    height, z = heights(points, plane), points[..., 2]
    growth = noise_growth(points)
    high = (height > config.above * growth) & (height < config.max_height)
    # Where one thing ends before another their outlines are left out, so that things that touch come apart. A level
    # face seen at a grazing angle spans much depth, but no height.
    steps = (
        ndimage.maximum_filter(np.where(high, extent, -np.inf), 3)
        - ndimage.minimum_filter(np.where(high, extent, np.inf), 3)
        for extent in (z, height)
    )
    solid = high & ~((next(steps) > config.depth_step) & (next(steps) > 0.2 * config.depth_step))
    where, group = np.argwhere(solid), _groups(points[solid], config.voxel)
    masks = []
    for i in np.flatnonzero(np.bincount(group) >= config.min_cluster_pixels):
        pixels = where[group == i]
        cloud = points[pixels[:, 0], pixels[:, 1]]
        if over(cloud[::7], plane, table).mean() < 0.5:
            continue
        for piece in _unstack(cloud, heights(cloud, plane), plane, config):
            mask = np.zeros(solid.shape, bool)
            mask[pixels[piece, 0], pixels[piece, 1]] = True
            if len(piece) >= config.min_cluster_pixels and height[mask].max() > config.min_height:
                masks.append(mask)
    if not masks:
        raise ValueError("nothing stands on the support plane; show more of the objects, or give a label map")
    masks.sort(key=lambda mask: -int(mask.sum()))
    # Outlines and bases (thinner than `above`) go to what they are next to in space.
    owner = np.zeros(solid.shape, np.intp)
    for number, mask in enumerate(masks, start=1):
        owner[mask] = number
    loose = (owner == 0) & (height > config.base * growth) & (height < config.max_height)
    reach = np.where(high[loose], 2.0 * config.voxel, config.voxel)
    gap, at = cKDTree(points[owner > 0]).query(points[loose], distance_upper_bound=2.0 * config.voxel)
    owner[loose] = np.where(gap < reach, np.append(owner[owner > 0], 0)[at], 0)
    return [_filled(owner == number, height / growth, config) for number in range(1, len(masks) + 1)]


def _groups(points: Float[np.ndarray, "n d"], voxel: float) -> Int[np.ndarray, "n"]:
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


def _unstack(
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
            group = _groups(cloud[above], config.voxel)
            return [below, *(above[group == g] for g in range(group.max() + 1))]
    return [np.arange(len(cloud))]


def _filled(
    mask: Bool[np.ndarray, "h w"], height: Float[np.ndarray, "h w"], config: SegmentConfig
) -> Bool[np.ndarray, "h w"]:
    """A mask with its small gaps in depth, and with what it encloses above the table: the floor of a bowl."""
    gap = np.isnan(height)
    mask = mask | (gap & ndimage.binary_closing(mask, iterations=5))
    inside = ndimage.binary_fill_holes(mask) & ~mask
    holes, _ = ndimage.label(inside)
    small = np.bincount(holes.ravel()) < 0.02 * mask.sum()
    floor = (height > config.base) & (height <= config.above)
    return mask | (inside & ((gap & small[holes]) | floor))


def _own_plane(
    points: Float[np.ndarray, "h w 3"],
    table: Float[np.ndarray, "4"],
    mask: Bool[np.ndarray, "h w"],
    config: SegmentConfig,
) -> Float[np.ndarray, "4"]:
    """The plane that an object stands on: the table, or parallel to it the top of the thing below.

    An object is taken to stand on another where its lowest points (2nd percentile) are higher than `lifted` and the
    pixels around them see a surface at their height, within 3 cm. If only its foot is hidden, it stands on the
    table. (A thing that touches the back of a box of about its hidden height is mistaken for one on top of it.)
    """
    height = heights(points, table)
    own = height[mask & (height > config.base)]
    lowest = float(np.percentile(own, 2)) if len(own) else 0.0
    if lowest < config.lifted:
        return table
    foot = points[mask & (height < lowest + 0.01)]
    inner, outer = (ndimage.binary_dilation(mask, _SQUARE, iterations=i) for i in (2, 10))
    around = outer & ~inner & (np.abs(height - lowest) < 0.015)
    near = cKDTree(foot).query(points[around], distance_upper_bound=0.03)[0] < 0.03
    if near.sum() < config.min_pixels:
        return table
    return table - [0.0, 0.0, 0.0, float(np.median(height[around][near]))]


def _statuses(
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    mask: Bool[np.ndarray, "h w"],
    label: Int[np.ndarray, "h w"] | None,
    config: SegmentConfig,
) -> tuple[Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The status of each pixel for one object, and which of the UNKNOWN ones see something else."""
    distance, height = np.linalg.norm(points, axis=-1), heights(points, plane) / noise_growth(points)
    measured = np.isfinite(distance)
    body = points[mask & measured & (height > config.base)]
    if not len(body):
        body = points[mask & measured]
    # No part of the object is farther than its visible middle plus its largest visible side.
    side = np.ptp(np.percentile(body @ np.vstack([plane[:3], horizontal(plane)]).T, [2, 98], axis=0), axis=0).max()
    far = float(np.median(np.linalg.norm(body, axis=1))) + side
    elsewhere = measured & ((height < config.base) | (distance > far))
    status = np.full(mask.shape, UNKNOWN, np.int32)
    status[~mask & measured & ((height <= config.above) | (distance > far))] = FREE
    if label is None:
        status[mask & measured & ~elsewhere] = OBJECT  # filled holes are a guess
    else:
        status[mask & ~elsewhere] = OBJECT
        status[~measured & (label == 0)] = FREE
    grown, core = _around(mask, config.rim)
    status[grown & ~core] = UNKNOWN
    return status, (status == UNKNOWN) & ~grown & measured
