"""Object pixels from colour alone: in the user's box, or as the difference from a picture of the empty scene."""

import cv2
import numpy as np
from jaxtyping import Bool, Int32, UInt8
from scipy import ndimage

from perception.observation.settings import MaskConfig
from perception.sources.frame import Frame
from perception.sources.image_files import read_picture

_SQUARE = np.ones((3, 3), bool)


def label_colour(frame: Frame, config: MaskConfig) -> Int32[np.ndarray, "h w"]:
    """Object ids per pixel, 0 for none: 1 in a drawn box, 1..n by size against a background, or the frame's own.

    With a box, ids from 2 are the boxes of possible occluders.

    Raises `ValueError` or `FileNotFoundError` if none of the three is given, or nothing is found.
    """
    if config.box_px is not None:
        label = _in_box(frame.rgb, config.box_px, config).astype(np.int32)
        for number, (x0, y0, x1, y1) in enumerate(config.before, start=2):
            part = label[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)]
            part[part == 0] = number
        return label
    if config.background is not None:
        picture = read_picture(config.background)
        try:
            return changed(frame.rgb, picture, config)
        except ValueError as error:
            raise ValueError(f"{config.background}: {error}") from None
    if frame.label is not None:
        return frame.label
    raise ValueError(
        "without depth the object's pixels are unknown: give a box about it (--box X0 Y0 X1 Y1), a picture of the"
        " empty scene (segment.mask.background in the configuration), or a label map"
    )


def changed(
    rgb: UInt8[np.ndarray, "h w 3"], background: UInt8[np.ndarray, "h w 3"], config: MaskConfig
) -> Int32[np.ndarray, "h w"]:
    """Ids, from 1 by size, of the connected regions whose colour differs from the background's.

    A change of exposure or white balance (each channel's median ratio) is taken out first.
    """
    if background.shape != rgb.shape:
        have, want = ("x".join(map(str, a.shape[1::-1])) for a in (background, rgb))
        raise ValueError(f"the background is {have} px but the frame is {want} px; take it with the same camera")
    new, old = (cv2.medianBlur(np.ascontiguousarray(a), 3).astype(np.float32) / 255.0 for a in (rgb, background))
    gain = np.median((new + 0.02) / (old + 0.02), axis=(0, 1))
    lab = [cv2.cvtColor(a, cv2.COLOR_RGB2Lab) for a in (new, np.clip(old * gain, 0.0, 1.0).astype(np.float32))]
    distance = np.linalg.norm((lab[0] - lab[1]) * [0.5, 1.0, 1.0], axis=-1)
    mask = ndimage.binary_closing(ndimage.binary_opening(distance > config.difference, _SQUARE), _SQUARE, iterations=3)
    regions, count = ndimage.label(mask)
    size = np.bincount(regions.ravel(), minlength=count + 1)
    label = np.zeros(mask.shape, np.int32)
    number = 0
    for i in np.argsort(-size[1:], kind="stable") + 1:
        if size[i] < config.least:
            break
        region = ndimage.binary_dilation(regions == i, _SQUARE, iterations=2)
        found = _object_in(rgb, region, config)  # without the shadow about its foot
        if found.sum() >= config.least:
            number += 1
            label[found & (label == 0)] = number
    if not number:
        raise ValueError(
            f"no region of {config.least} px differs from the background; give a picture without the object"
        )
    return label


def _in_box(
    rgb: UInt8[np.ndarray, "h w 3"], box_px: tuple[int, int, int, int], config: MaskConfig
) -> Bool[np.ndarray, "h w"]:
    """The object in a box. Raises `ValueError` if the box is unusable."""
    height, width = rgb.shape[:2]
    x0, y0, x1, y1 = box_px
    name = f"the box {x0} {y0} {x1} {y1}"
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(f"{name} is empty or leaves the picture of {width}x{height} px; give X0 Y0 X1 Y1 inside it")
    if (x1 - x0) * (y1 - y0) < config.least:
        raise ValueError(f"{name} holds fewer than {config.least} px; move the camera nearer")
    if (x1 - x0) * (y1 - y0) > 0.9 * width * height:
        raise ValueError(f"{name} leaves too little of the picture around it; draw it closer to the object")
    inside = np.zeros((height, width), bool)
    inside[y0:y1, x0:x1] = True
    mask = _object_in(rgb, inside, config)
    if mask.sum() < config.least:
        raise ValueError(f"{name} shows no object of {config.least} px unlike its surroundings; draw it again")
    outline = mask & ~ndimage.binary_erosion(mask, _SQUARE, border_value=1)
    edge = inside & ~ndimage.binary_erosion(inside, _SQUARE, border_value=1)
    if (outline & edge).sum() > 0.1 * outline.sum():
        raise ValueError(f"{name} cuts the object off, or the object looks like its surroundings; draw it larger")
    return mask


def _object_in(
    rgb: UInt8[np.ndarray, "h w 3"], region: Bool[np.ndarray, "h w"], config: MaskConfig
) -> Bool[np.ndarray, "h w"]:
    """The largest thing in a region that looks unlike what surrounds the region (GrabCut), or nothing."""
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    window = tuple(
        slice(max(i[0] - pad, 0), i[-1] + 1 + pad)
        for i, pad in ((i, max(8, round(config.margin * len(i)))) for i in (rows, columns))
    )
    part = np.ascontiguousarray(rgb[window][..., ::-1])
    marks = np.where(region[window], cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    regions, count = ndimage.label(ndimage.binary_opening(grab_cut(part, marks, config.iterations), _SQUARE))
    mask = np.zeros(region.shape, bool)
    if count:
        mask[window] = _whole(regions == np.bincount(regions.ravel())[1:].argmax() + 1)
    return mask


def grab_cut(
    bgr: UInt8[np.ndarray, "h w 3"], marks: UInt8[np.ndarray, "h w"], iterations: int
) -> Bool[np.ndarray, "h w"]:
    """The foreground (GrabCut, Rother et al. 2004) that begins at marks of OpenCV's kinds; the same in every run."""
    cv2.setRNGSeed(0)  # its clusters start at random
    models = np.zeros((2, 1, 65))
    marks = marks.copy()
    cv2.grabCut(bgr, marks, (0, 0, 1, 1), models[0], models[1], iterations, cv2.GC_INIT_WITH_MASK)
    return np.isin(marks, (cv2.GC_FGD, cv2.GC_PR_FGD))


def _whole(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A mask with its small holes filled; the opening of a handle stays."""
    holes, _ = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    small = np.bincount(holes.ravel()) < 0.01 * mask.sum()
    small[0] = False
    return mask | small[holes]
