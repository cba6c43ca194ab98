"""Pixels without depth that look like the thing beside them: what a depth camera's shadows hide of its outline."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy import ndimage

from perception.observation.colour_masks import grab_cut

_SQUARE = np.ones((3, 3), bool)
_AROUND = 0.35  # of a mask's longer side: how far around it colours are looked at
_EDGE = 3  # px on either side of a mask that may be of either: depth's edges lie beside colour's
_SIDE = 200  # px; a longer side of the part is made smaller
_MOST = 0.5  # of a mask's pixels with depth: how many may be added
_ITERATIONS = 3  # of GrabCut


def by_colour(
    rgb: UInt8[np.ndarray, "h w 3"],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    measured: Bool[np.ndarray, "h w"],
) -> list[Bool[np.ndarray, "h w"]]:
    """Which pixels without depth, in each of the masks or joined to it, are of its thing by their colour.

    GrabCut (`grab_cut`) with what depth says as its certain pixels. The first mask that asks for a pixel gets
    it.
    """
    taken = np.any([np.zeros_like(measured), *masks], axis=0)
    found = []
    for mask in masks:
        alike = _alike(rgb, mask, taken & ~mask, measured)
        taken |= alike
        found.append(alike)
    return found


def _alike(
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    others: Bool[np.ndarray, "h w"],
    measured: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """`by_colour` of one mask; `others`: pixels that are other things'."""
    alike = np.zeros_like(mask)
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    pad = max(8, round(_AROUND * max(np.ptp(rows), np.ptp(columns))))
    part = tuple(slice(max(i[0] - pad, 0), i[-1] + 1 + pad) for i in (rows, columns))
    own, other, seen = mask[part], others[part], measured[part]
    candidates = _joined(~seen & ~other, own)
    core = ndimage.binary_erosion(own & seen, _SQUARE, iterations=_EDGE)
    if not candidates.any() or not core.any():
        return alike
    marks = np.full(own.shape, cv2.GC_BGD, np.uint8)
    marks[ndimage.binary_dilation(own, _SQUARE, iterations=_EDGE) & ~other | candidates] = cv2.GC_PR_BGD
    marks[own] = cv2.GC_PR_FGD
    marks[core] = cv2.GC_FGD
    if (marks != cv2.GC_BGD).all():  # nothing to tell it from
        return alike
    taken = _cut(np.ascontiguousarray(rgb[part][..., ::-1]), marks) & candidates
    taken = _joined(ndimage.binary_opening(taken | own, _SQUARE), own) & candidates
    edge = np.pad(np.zeros(np.subtract(own.shape, 2), bool), 1, constant_values=True)
    if taken.sum() <= _MOST * (own & seen).sum() and not (taken & edge).any():  # else a far background is of its colour
        alike[part] = taken
    return alike


def _joined(region: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The parts of a region that touch a mask."""
    parts, _ = ndimage.label(region, _SQUARE)
    touched = np.unique(parts[ndimage.binary_dilation(mask, _SQUARE)])
    return np.isin(parts, touched[touched > 0])


def _cut(bgr: UInt8[np.ndarray, "h w 3"], marks: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """GrabCut's foreground, from its marks, at no more than `_SIDE` px."""
    height, width = marks.shape
    scale = min(1.0, _SIDE / max(height, width))
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    small = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    smaller_marks = cv2.resize(marks, size, interpolation=cv2.INTER_NEAREST)
    try:
        foreground = grab_cut(small, smaller_marks, _ITERATIONS)
    except cv2.error:  # no certain pixel is left at this size
        return np.zeros(marks.shape, bool)
    return cv2.resize(foreground.astype(np.uint8) * 255, (width, height), interpolation=cv2.INTER_LINEAR) > 127
