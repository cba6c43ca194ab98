"""Objects in a frame: their masks, the plane each stands on, and the status of every pixel for each of them.

With depth the plane is measured. Without, it is supposed (`PlaneGuess`) and colour finds the objects (`MaskConfig`).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import overload

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from perception.observation.camera_check import check_camera
from perception.observation.colour_masks import label_colour
from perception.observation.depth_scale import scale_doubt
from perception.observation.depth_shadows import by_colour
from perception.observation.settings import SegmentConfig
from perception.observation.standing import candidates, in_box, standing
from perception.observation.support_plane import heights, horizontal, noise_growth, support_of
from perception.observation.without_depth import slopes, supposed_plane
from perception.sources.frame import Frame
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN

_SQUARE = np.ones((3, 3), bool)
_MOST_OBJECTS = 255  # each has maps of the picture's size


@dataclass(frozen=True, eq=False)
class Segment:
    """One object of a frame. The maps share the frame's pixels."""

    id: int  # of the label map; without one 1..n by size
    mask: Bool[np.ndarray, "h w"]  # the object's pixels, with or without depth
    plane: Float[np.ndarray, "4"]  # (n, d): n.p + d = 0 in the camera frame, n unit and up, d the camera's height (m)
    status: Int[np.ndarray, "h w"]  # OBJECT, FREE or UNKNOWN (probnerf.pixel_status)
    occluder: Bool[np.ndarray, "h w"]  # UNKNOWN pixels that see something else: their ray is free up to its depth
    plane_sigma: tuple[float, float] | None = None  # m, rad; of the height and tilt of a supposed plane; None: measured


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Something that was found, and is not taken for an object that can be inferred."""

    id: int
    mask: Bool[np.ndarray, "h w"]
    reason: str


@dataclass(frozen=True, eq=False)
class Segments(Sequence[Segment]):
    """The objects of a frame; a sequence of `Segment`."""

    objects: tuple[Segment, ...]
    left_out: tuple[LeftOut, ...] = ()
    doubt: str = ""  # what is wrong with the frame's depth (`scale_doubt`)

    @overload
    def __getitem__(self, index: int) -> Segment: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Segment, ...]: ...
    def __getitem__(self, index: int | slice) -> Segment | tuple[Segment, ...]:
        return self.objects[index]

    def __len__(self) -> int:
        return len(self.objects)


def segment(frame: Frame, object_id: int | None = None, config: SegmentConfig | None = None) -> Segments:
    """The objects of a frame, or the one with `object_id`.

    With a box (`MaskConfig`) the thing in it is object 1. With a label map its ids are the objects. Without either,
    points above the supports (`standing`) are clustered and numbered from the largest; what is too large, too low or
    cut off by the picture's border is left out; pixels without depth beside it are its own if they look like it
    (`by_colour`). Statuses per object: OBJECT in its mask. FREE where the ray is known to
    miss it: the depth there is on or below the support plane, or beyond the object, or absent where the label map says
    background. UNKNOWN otherwise: nearer things, pixels without depth, the rim of the mask, mask pixels whose depth is
    the background's.

    Without depth, pixels outside the mask and its rim are FREE, except other masks that may belong to things in front
    of the object. Pixels in no mask count as behind it.

    Raises `ValueError` if there is no plane, no such id, no object, a mask of a few pixels, or intrinsics that
    cannot be those of the picture.
    """
    config = config or SegmentConfig()
    try:
        if config.whole:
            check_camera(frame.camera)
        if frame.depth is None:
            return Segments(tuple(_segment_colour(frame, object_id, config)))
        return _segment_depth(frame, object_id, config)
    except ValueError as error:
        raise ValueError(f"frame at {frame.stamp_ns} ns: {error}") from None


def _segment_depth(frame: Frame, object_id: int | None, config: SegmentConfig) -> Segments:
    """The objects of a frame with depth. Raises as `segment`, without the name of the frame."""
    assert frame.depth is not None
    if not np.isfinite(frame.depth).any():
        raise ValueError(f"no pixel of {frame.depth.size} has depth; check the depth sensor")
    points, label = backproject(frame), frame.label
    supports, left = _supports(points, frame, config), list[LeftOut]()
    if config.mask.box_px is not None:
        thing, label = in_box(points, config.mask.box_px, supports, config), None
        found = {1: (thing.mask, thing.plane)}
    elif label is not None:
        ids = [int(i) for i in np.unique(label) if i > 0]
        if not 0 < len(ids) <= _MOST_OBJECTS:
            raise ValueError(
                f"the label map names {len(ids) or 'no'} objects; give one with 1 to {_MOST_OBJECTS} ids above 0, or"
                " none"
            )
        plane = support_of(points, label, supports, config.plane)
        found = {i: (label == i, plane) for i in ids}
    else:
        stands = standing(points, frame.camera, supports, config)
        found = {i: (thing.mask, thing.plane) for i, thing in enumerate(stands.things, start=1)}
        left = [LeftOut(i, *it) for i, it in enumerate(stands.left_out, start=len(found) + 1)]
        if not found:
            raise ValueError(_nothing(left, frame.depth))
    if object_id is not None and object_id not in found:
        why = [f"object {it.id} is left out: {it.reason}" for it in left if it.id == object_id]
        raise ValueError(*why or [f"no object {object_id}; its objects: {', '.join(map(str, found))}"])
    seen = np.isfinite(points[..., 2])
    alike = dict.fromkeys(found, np.zeros_like(seen))
    if label is None:
        alike = dict(zip(found, by_colour(frame.rgb, [mask for mask, _ in found.values()], seen), strict=True))
    segments, distance = [], np.sqrt(np.einsum("...i,...i", points, points))  # for all objects, once
    for i, (mask, plane) in found.items():
        if object_id not in (None, i):
            continue
        pixels, measured = int(mask.sum()), int((mask & seen).sum())
        if measured >= config.min_pixels:
            own = _own_plane(points, plane, mask, config)
            whole = mask | alike[i]
            segments.append(Segment(i, whole, own, *_statuses(points, distance, own, whole, label, alike[i], config)))
            continue
        reason = f"{pixels} pixels, {measured} of them with depth; at least {config.min_pixels} are needed"
        if i == object_id or len(found) == 1:
            raise ValueError(f"object {i} has {reason}: move the camera nearer or give another object")
        left.append(LeftOut(i, mask, reason))
    if not segments:
        raise ValueError(f"no object has {config.min_pixels} pixels of depth; move the camera nearer")
    return Segments(tuple(segments), tuple(left), scale_doubt(frame, next(iter(found.values()))[1], config.guess))


def _supports(points: Float[np.ndarray, "h w 3"], frame: Frame, config: SegmentConfig) -> list[Float[np.ndarray, "4"]]:
    """The planes of a frame; without one the supposed plane of the camera's pose or height.

    With a label map those that are seen beside its objects, whose faces are planes, too.
    """
    beside = points if frame.label is None else np.where(frame.label[..., None] > 0, np.nan, points)
    try:
        return candidates(beside, config)
    except ValueError:
        with suppress(ValueError):
            return [supposed_plane(frame, config.guess)]
    return candidates(points, config)


def label_boxes(
    frame: Frame, boxes: Sequence[tuple[int, int, int, int]], config: SegmentConfig | None = None
) -> tuple[Int[np.ndarray, "h w"], list[str]]:
    """A label map of the things in boxes (x0 y0 x1 y1, px; ends exclusive), with the boxes' numbers from 1 as ids, and
    why some boxes have none.

    A pixel of several is the first one's. Raises `ValueError` where the frame has no plane.
    """
    config, label, why = config or SegmentConfig(), np.zeros(frame.rgb.shape[:2], np.int32), list[str]()
    points = None if frame.depth is None else backproject(frame)
    supports = [] if points is None else _supports(points, frame, config)
    for number, box in enumerate(boxes, start=1):
        try:
            if points is not None:
                mask = in_box(points, box, supports, config).mask
            else:
                mask = label_colour(frame, replace(config.mask, box_px=box, before=())) == 1
            label[mask & (label == 0)] = number
        except ValueError as error:
            why.append(str(error))
    return label, why


def _nothing(left: Sequence[LeftOut], depth: Float[np.ndarray, "h w"]) -> str:
    """The words for a frame in which nothing is an object."""
    median = float(np.nanmedian(depth))
    words = "nothing stands on the support plane; show more of the objects, or give masks, a box or the plane (--plane)"
    if left:
        words = f"nothing that stands there can be inferred: {'; '.join(it.reason for it in left[:3])}"
    if not 0.2 < median < 3.0:  # m; a camera at a table
        words += f". The depth's median is {median:.3g} m: if that is wrong, correct the depth's unit"
    return words


def _segment_colour(frame: Frame, object_id: int | None, config: SegmentConfig) -> list[Segment]:
    """The objects of a frame without depth. Raises as `segment`, without the name of the frame."""
    label = label_colour(frame, config.mask)
    ids = [int(i) for i in np.unique(label) if i > 0]
    if config.mask.box_px is not None:  # the other boxes are no objects to infer
        ids = [1]
    if not ids or object_id not in (None, *ids):
        names = ", ".join(map(str, ids)) or "none"
        raise ValueError(f"no object {object_id or 'to infer'}; its objects: {names}")
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
    grown, core = np.zeros_like(mask), np.zeros_like(mask)
    for place in ndimage.find_objects(mask.astype(np.uint8)):  # its box: the rest of the picture stays as it is
        box = tuple(slice(max(side.start - width - 1, 0), side.stop + width + 1) for side in place)
        grown[box] = ndimage.binary_dilation(mask[box], _SQUARE, iterations=width)
        core[box] = ndimage.binary_erosion(mask[box], _SQUARE, iterations=width, border_value=1)
    return grown, core


@lru_cache(maxsize=2)  # every object of a frame asks
def backproject(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """The point that each pixel sees, camera frame (m), NaN without depth. `ValueError` on a frame that has none."""
    if frame.depth is None:
        raise ValueError(f"frame at {frame.stamp_ns} ns has no depth")
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    rays = frame.camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    points = (rays / rays[:, 2:]).reshape(*u.shape, 3) * frame.depth[..., None]
    points.flags.writeable = False
    return points


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
    distance: Float[np.ndarray, "h w"],
    plane: Float[np.ndarray, "4"],
    mask: Bool[np.ndarray, "h w"],
    label: Int[np.ndarray, "h w"] | None,
    alike: Bool[np.ndarray, "h w"],
    config: SegmentConfig,
) -> tuple[Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """The status of each pixel for one object, and which of the UNKNOWN ones see something else.

    `alike`: the mask's pixels without depth that are the object's by their colour.
    """
    height = heights(points, plane) / noise_growth(points)
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
        status[mask & measured & ~elsewhere | alike] = OBJECT  # other filled holes are a guess
    else:
        status[mask & ~elsewhere] = OBJECT
        status[~measured & (label == 0)] = FREE
    grown, core = _around(mask, config.rim)
    status[grown & ~core] = UNKNOWN
    return status, (status == UNKNOWN) & ~grown & measured
