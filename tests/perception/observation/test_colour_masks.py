"""Masks from colour alone on exact pictures of cylinders, what their pixels say, and every wrong input."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

from perception.observation.colour_masks import changed, label_colour
from perception.observation.segmentation import Segment, segment
from perception.observation.settings import MaskConfig, PlaneGuess, SegmentConfig
from perception.sources.frame import Frame
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from tests.perception.cylinders import CAN, Cylinder, looking_down, picture

BOX = (125, 70, 195, 155)  # about CAN
FRONT = Cylinder(0.03, -0.14, 0.035, 0.06)


def blind(*things: Cylinder, degrees: float = 35.0, label: bool = True) -> Frame:
    """A frame without depth that knows its camera's pose, with a little noise in its colours."""
    T = looking_down(degrees)
    frame = picture(*things, T=T)
    noise = np.random.default_rng(1).normal(0.0, 2.0, frame.rgb.shape)
    rgb = np.clip(np.rint(frame.rgb + noise), 0, 255).astype(np.uint8)
    return replace(frame, depth=None, rgb=rgb, label=frame.label if label else None, T_world_camera=T)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def with_box(*box: int) -> SegmentConfig:
    return SegmentConfig(mask=MaskConfig(box_px=box))


def check_partition(s: Segment, truth: np.ndarray) -> None:
    """OBJECT and FREE are right, and a band about the outline says nothing."""
    assert (truth[s.status == OBJECT]).all() and not (truth[s.status == FREE]).any()
    outline = s.mask & ~ndimage.binary_erosion(s.mask)
    assert (s.status[outline] == UNKNOWN).all()
    far = ndimage.distance_transform_edt(~outline) > 8
    assert (s.status[far & truth] == OBJECT).all()


def test_a_box_finds_what_stands_in_it() -> None:
    frame = blind(CAN, label=False)
    truth = picture(CAN, T=looking_down(35.0)).label == 1
    (s,) = segment(frame, config=with_box(*BOX))
    assert s.id == 1 and iou(s.mask, truth) > 0.97
    check_partition(s, truth)
    again = segment(frame, config=with_box(*BOX))[0]
    np.testing.assert_array_equal(s.status, again.status)
    np.testing.assert_allclose(s.plane, [*looking_down(35.0)[2, :3], looking_down(35.0)[2, 3]])
    assert s.plane_sigma == pytest.approx((0.01, np.radians(1.0)))


def test_a_second_box_marks_what_may_stand_before() -> None:
    frame = blind(CAN, FRONT, degrees=25.0, label=False)
    truth = picture(CAN, FRONT, T=looking_down(25.0)).label
    v, u = np.nonzero(truth == 1)
    can = (int(u.min()) - 5, int(v.min()) - 5, int(u.max()) + 6, int(v.max()) + 6)
    v, u = np.nonzero(truth == 2)
    front = (int(u.min()) - 3, int(v.min()) - 3, int(u.max()) + 4, int(v.max()) + 4)
    config = SegmentConfig(mask=MaskConfig(box_px=can, before=(front,)))
    (s,) = segment(frame, config=config)
    assert s.occluder.any() and not (s.status[truth == 2] == FREE).any()
    assert (truth[s.status == OBJECT] == 1).mean() > 0.99


def test_a_background_finds_what_it_lacks(tmp_path: Path) -> None:
    other = Cylinder(0.17, 0.05, 0.03, 0.08)
    frame, empty = blind(CAN, other, label=False), blind(label=False)
    truth = picture(CAN, other, T=looking_down(35.0)).label
    darker = np.clip(0.8 * empty.rgb.astype(float), 0, 255).astype(np.uint8)  # another exposure
    for background in (empty.rgb, darker):
        label = changed(frame.rgb, background, MaskConfig())
        assert iou(label == 1, truth == 1) > 0.95 and iou(label == 2, truth == 2) > 0.93
    cv2.imwrite(str(tmp_path / "empty.png"), empty.rgb[..., ::-1])
    config = SegmentConfig(mask=MaskConfig(background=tmp_path / "empty.png"))
    assert [s.id for s in segment(frame, config=config)] == [1, 2]
    check_partition(segment(frame, 1, config)[0], truth == 1)


def test_a_given_label_map_is_the_mask() -> None:
    frame = blind(CAN)
    (s,) = segment(frame)
    np.testing.assert_array_equal(s.mask, frame.label == 1)
    check_partition(s, frame.label == 1)
    assert not s.occluder.any()


def test_things_before_the_object_are_unknown_and_things_behind_it_are_free() -> None:
    behind = Cylinder(-0.03, 0.2, 0.05, 0.16)
    frame = blind(CAN, FRONT, behind, degrees=25.0)
    can, near, far = segment(frame)
    inner = {i: ndimage.binary_erosion(frame.label == i, iterations=5) for i in (1, 2, 3)}
    assert (can.status[inner[2]] == UNKNOWN).all() and can.occluder[inner[2]].all()
    assert (can.status[inner[3]] == FREE).all()
    assert (near.status[inner[1] | inner[3]] == FREE).all() and not near.occluder.any()
    assert (far.status[inner[1] | inner[2]] == UNKNOWN).all()


@pytest.mark.parametrize(
    ("box", "says"),
    [
        ((100, 60, 400, 160), "box 100 60 400 160 is empty or leaves the picture of 320x240 px"),
        ((150, 60, 140, 160), "is empty"),
        ((150, 100, 158, 110), "fewer than 200 px"),
        ((0, 0, 320, 240), "too little of the picture"),
        ((10, 170, 80, 230), "shows no object|looks like what surrounds"),
        ((125, 70, 195, 120), "cuts the object off|shows no object"),
    ],
)
def test_a_box_that_is_no_good_is_named(box: tuple[int, int, int, int], says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        segment(blind(CAN, label=False), config=with_box(*box))
    assert "\n" not in str(caught.value) and "frame at 0 ns" in str(caught.value)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    frame, empty = blind(CAN, label=False), blind(label=False)
    with pytest.raises(ValueError, match="--box X0 Y0 X1 Y1"):
        segment(frame)
    with pytest.raises(ValueError, match="160x120 px but the frame is 320x240"):
        changed(frame.rgb, empty.rgb[::2, ::2], MaskConfig())
    with pytest.raises(ValueError, match="no region of"):
        changed(empty.rgb, empty.rgb, MaskConfig())
    with pytest.raises(FileNotFoundError, match="none"):
        label_colour(frame, MaskConfig(background=tmp_path / "none.png"))
    with pytest.raises(ValueError, match="no object 7"):
        segment(blind(CAN), 7)
    with pytest.raises(ValueError, match="camera_height"):
        segment(replace(frame, T_world_camera=None), config=with_box(*BOX))
    guess = PlaneGuess(camera_height=0.4, tilt=35.0)
    assert segment(replace(frame, T_world_camera=None), config=replace(with_box(*BOX), guess=guess))
