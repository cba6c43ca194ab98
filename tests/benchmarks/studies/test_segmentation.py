"""The study of segmentation: what counts as found, as another thing, and as wrong."""

import numpy as np
import pytest

from benchmarks.scenes.real_frames import RealFrame
from benchmarks.studies.segmentation import judge
from perception.observation.segmentation import LeftOut, Segment, Segments
from perception.sources.frame import Frame

K = np.array([[100.0, 0.0, 20.0], [0.0, 100.0, 20.0], [0.0, 0.0, 1.0]])


def block(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    mask = np.zeros((40, 40), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def a_segment(number: int, mask: np.ndarray) -> Segment:
    return Segment(number, mask, np.array([0.0, -1.0, 0.0, 0.5]), np.zeros((40, 40), np.int32), np.zeros_like(mask))


def test_found_missed_other_and_wrong_are_told_apart() -> None:
    label = (
        np.where(block(0, 0, 10, 10), 3, 0)
        + np.where(block(20, 0, 30, 10), 4, 0)
        + np.where(block(0, 20, 10, 30), 5, 0)
    )
    frame = Frame(np.zeros((40, 40, 3), np.uint8), None, K, label=label)
    real = RealFrame("", {3: "mug", 4: "tin", 5: "plate"}, {"shelf": (28, 20, 40, 40)})
    segments = [block(0, 0, 10, 8), block(22, 20, 40, 40), block(20, 22, 22, 24)]
    found = Segments(
        tuple(a_segment(i, mask) for i, mask in enumerate(segments, start=1)),
        (LeftOut(4, block(0, 20, 10, 30), "lower than 2 cm"),),
    )
    judged = judge("a", real, frame, found)
    assert judged.iou == {"3 mug": pytest.approx(0.8)}
    assert judged.missed == {"4 tin": "best IoU 0.00", "5 plate": "lower than 2 cm"}
    assert (judged.others, judged.wrong, judged.left_out) == (1, 1, 1)


def test_without_a_label_map_the_listed_things_must_be_found() -> None:
    frame = Frame(np.zeros((40, 40, 3), np.uint8), None, K)
    real = RealFrame("", {}, {"mug": (0, 0, 12, 12), "bowl": (20, 20, 40, 40)})
    judged = judge("a", real, frame, Segments((a_segment(1, block(0, 0, 10, 10)),)))
    assert list(judged.iou) == ["mug"] and judged.missed == {"bowl": "no segment in its box"}
    assert (judged.others, judged.wrong) == (0, 0)
