"""Boxes of another node's detector (vision_msgs/Detection2DArray) for the picture that they are of."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

DETECTIONS_IN = "vision_msgs/msg/Detection2DArray"
BoxPx = tuple[int, int, int, int]
_MARGIN, _LEAST_MARGIN = 0.08, 4.0  # of the box's side, and px: a detector's boxes are tight, and cut a rim off
_MOST = 64
_SAME = 0.3  # intersection over union with a box of the last picture from which it is the same thing's


def boxes_of(message: Any, frame_id: str, size: tuple[int, int], least_score: float) -> list[BoxPx]:
    """The boxes (x0 y0 x1 y1, px; ends exclusive) of detections, the surest first, in a picture of `size` (width,
    height).

    A turned box gives the upright one about it; each is a little wider than stated. Boxes outside of the picture, empty
    ones and those below `least_score` are left out. Raises ValueError for another frame_id or a box that is not finite.
    """
    if (theirs := message.header.frame_id.removeprefix("/")) not in ("", frame_id):
        raise ValueError(f"detections are of frame {theirs!r}, colour of {frame_id!r}; give those of this camera")
    scored = []
    for it in message.detections:
        score = max((float(result.hypothesis.score) for result in it.results), default=1.0)
        c, box = it.bbox.center, it.bbox
        values = np.array([c.position.x, c.position.y, c.theta, box.size_x, box.size_y, score])
        if not np.isfinite(values).all() or np.abs(values).max() > 1e6:
            raise ValueError(f"a detection's box is {values[:5].tolist()}; give finite pixels")
        if score >= least_score and min(box.size_x, box.size_y) > 0:
            scored.append((score, values))
    boxes = []
    for _, (x, y, turn, across, down, _) in sorted(scored, key=lambda item: -item[0])[:_MOST]:
        cos, sin = abs(np.cos(turn)), abs(np.sin(turn))
        sides = np.array([across * cos + down * sin, across * sin + down * cos])
        half = sides / 2 + np.maximum(_MARGIN * sides, _LEAST_MARGIN)
        middle = np.array([x, y])
        x0, y0 = np.floor(np.maximum(middle - half, 0)).astype(int).tolist()
        x1, y1 = np.ceil(np.minimum(middle + half, size)).astype(int).tolist()
        if x0 < x1 and y0 < y1:
            boxes.append((x0, y0, x1, y1))
    return boxes


def kept_ids(boxes: Sequence[BoxPx], last: Mapping[int, BoxPx]) -> list[int]:
    """An id for each box: that of the box of the last picture which it overlaps most, or a number that none has.

    Scores change from picture to picture, so their order does not name the things in the boxes.
    """
    pairs = sorted(((-_iou(box, old), k, name) for k, box in enumerate(boxes) for name, old in last.items()))
    ids: dict[int, int] = {}
    for apart, k, name in pairs:
        if -apart > _SAME and k not in ids and name not in ids.values():
            ids[k] = name
    free = (number for number in range(1, 2 * _MOST + 1) if number not in {*last, *ids.values()})
    return [ids[k] if k in ids else next(free) for k in range(len(boxes))]


def _iou(a: BoxPx, b: BoxPx) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0) * max(height, 0)
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    return both / (sum(areas) - both)
