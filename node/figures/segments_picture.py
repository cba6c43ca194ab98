"""The picture of what was found in a frame. OpenCV draws it at once, where matplotlib takes a second to import."""

import colorsys

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.observation.segmentation import Segments
from perception.observation.support_plane import heights, noise_growth
from perception.sources.frame import Frame

_GREY = (150, 150, 150)
_GOLDEN = 0.61803  # of the circle of hues: neighbours in number differ in colour


def draw_segments(
    frame: Frame, found: Segments, points: Float[np.ndarray, "h w 3"] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The frame (RGB) with its objects in colour and numbered, what is left out in grey and numbered, and dots on the
    planes that objects stand on, where `points` (of `backproject`) are given.
    """
    scale = max(1, round(480 / frame.rgb.shape[0]))  # small pictures are drawn larger, for the numbers
    picture = np.repeat(np.repeat(frame.rgb, scale, axis=0), scale, axis=1).astype(np.float32) * 0.75
    if points is not None:
        for plane in {tuple(segment.plane): segment.plane for segment in found}.values():
            on = np.abs(heights(points, plane)) < 0.008 * noise_growth(points)
            v, u = np.nonzero(on[::8, ::8])
            for x, y in zip(8 * u * scale, 8 * v * scale, strict=True):
                cv2.circle(picture, (int(x), int(y)), 1, (90, 200, 255), -1)
    marks = [(it.id, it.mask, _GREY) for it in found.left_out]
    marks += [(it.id, it.mask, _colour(i)) for i, it in enumerate(found)]
    masks = [np.repeat(np.repeat(mask, scale, axis=0), scale, axis=1) for _, mask, _ in marks]
    for (_, _, colour), mask in zip(marks, masks, strict=True):
        picture[mask] = 0.5 * picture[mask] + 0.5 * np.array(colour, np.float32)
        outline = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, outline, -1, colour, 2)
    drawn = np.clip(picture, 0, 255).astype(np.uint8)
    for (number, _, _), mask in zip(marks, masks, strict=True):
        _write(drawn, str(number), _inside(mask))
    return drawn


def _colour(index: int) -> tuple[int, int, int]:
    r, g, b = colorsys.hsv_to_rgb((0.08 + index * _GOLDEN) % 1.0, 0.75, 1.0)
    return round(255 * r), round(255 * g), round(255 * b)


def _inside(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int]:
    """The pixel (x, y) farthest from the mask's outline."""
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return int(x) - 1, int(y) - 1


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str, at: tuple[int, int]) -> None:
    """`text` about `at`, white on black."""
    size = max(picture.shape[0] / 500, 0.7)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 2)
    where = (
        min(max(at[0] - width // 2, 2), picture.shape[1] - width - 2),
        min(max(at[1] + height // 2, height + 2), picture.shape[0] - 2),
    )
    for thickness, ink in ((7, (0, 0, 0)), (2, (255, 255, 255))):
        cv2.putText(picture, text, where, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thickness, cv2.LINE_AA)
