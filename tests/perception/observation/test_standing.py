"""What stands where, without a label map: supports of any kind, open vessels, and what is no object."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calibration.camera import Camera
from perception.observation.segmentation import Segment, segment
from perception.observation.settings import MaskConfig, PlaneConfig, PlaneGuess, SegmentConfig
from perception.sources.frame import Frame
from probnerf.pixel_status import FREE
from tests.perception.cylinders import CAMERA, CAN, Cylinder, looking_down, picture
from tests.perception.observation.test_segmentation import iou, plane_errors

FINE = Camera(640, 480, CAMERA.K * [[2.0], [2.0], [1.0]], np.zeros(5))
MUG = Cylinder(0.0, 0.0, 0.045, 0.1, is_open=True)


def overlap(truth: np.ndarray, found: Segment) -> float:
    return iou(found.mask, truth)


def unlabelled(frame: Frame) -> Frame:
    return replace(frame, label=None)


@pytest.mark.parametrize("degrees", [20.0, 35.0, 55.0, 75.0])
@pytest.mark.parametrize("vessel", [MUG, Cylinder(0.0, 0.0, 0.08, 0.06, is_open=True)], ids=["mug", "bowl"])
def test_both_walls_of_an_open_vessel_are_one_thing(vessel: Cylinder, degrees: float) -> None:
    frame = picture(vessel, Cylinder(0.16, 0.1, 0.03, 0.1), T=looking_down(degrees), camera=FINE)
    found = segment(unlabelled(frame))
    assert len(found) == 2
    assert max(iou(s.mask, frame.label == 1) for s in found) > 0.93


def test_a_can_behind_a_can_is_not_its_inside() -> None:
    """What shows over a thing with a face on its top stands behind it."""
    frame = picture(CAN, Cylinder(0.01, 0.11, 0.045, 0.16))
    found = segment(unlabelled(frame))
    assert len(found) == 2
    assert all(max(iou(s.mask, frame.label == i) for s in found) > 0.85 for i in (1, 2))


def test_a_small_table_high_over_a_floor_is_the_support() -> None:
    T = looking_down(40.0)
    frame = picture(CAN, T=T, table_radius=0.16)
    (found,) = segment(unlabelled(frame))
    angle, offset = plane_errors(found.plane, T)
    assert iou(found.mask, frame.label == 1) > 0.9 and angle < 1.0 and offset < 0.003


def test_two_supports_of_different_height_carry_their_own() -> None:
    low = Cylinder(-0.2, 0.0, 0.04, 0.1, base=-0.15)
    shelf = Cylinder(-0.2, 0.0, 0.12, 0.01, base=-0.16)
    frame = picture(Cylinder(0.1, 0.0, 0.045, 0.12), low, shelf, T=looking_down(50.0), table_radius=0.16)
    frame = replace(frame, label=np.where(frame.label == 3, 0, frame.label))
    found = segment(unlabelled(frame))
    masks = [sorted(found, key=partial(overlap, frame.label == i))[-1] for i in (1, 2)]
    assert [iou(s.mask, frame.label == i) > 0.85 for i, s in enumerate(masks, start=1)] == [True, True]
    assert masks[1].plane[3] - masks[0].plane[3] == pytest.approx(0.15, abs=0.01)


def test_what_is_cut_off_too_wide_low_or_floating_is_left_out_with_the_reason() -> None:
    floating = Cylinder(0.0, 0.1, 0.04, 0.08, base=0.18)
    wide = Cylinder(0.0, 0.75, 0.28, 0.3)
    flat = Cylinder(0.12, -0.12, 0.05, 0.012)
    cut = Cylinder(-0.28, -0.1, 0.06, 0.12)
    T = looking_down(40.0, 0.75)
    frame = picture(Cylinder(0.12, 0.05, 0.04, 0.1), floating, wide, flat, cut, T=T, table_radius=1.5)
    found = segment(unlabelled(frame))
    assert len(found) == 1 and iou(found[0].mask, frame.label == 1) > 0.85
    why = {i: it.reason for it in found.left_out for i in range(2, 6) if iou(it.mask, frame.label == i) > 0.5}
    assert why.keys() == {2, 3, 4, 5}
    assert "nothing that carries it" in why[2] and "cm wide, more than 40" in why[3]
    assert "lower than 2 cm" in why[4] and "cut off" in why[5]
    assert [it.id for it in found.left_out] == list(range(2, 2 + len(found.left_out)))


def test_a_left_out_object_that_is_asked_for_gets_the_reason() -> None:
    frame = picture(CAN, Cylinder(0.12, -0.12, 0.05, 0.012))
    with pytest.raises(ValueError, match="object 2 is left out: lower than 2 cm"):
        segment(unlabelled(frame), 2)


def test_a_box_finds_the_thing_in_it() -> None:
    frame = picture(Cylinder(-0.06, 0.0, 0.045, 0.12), Cylinder(0.06, 0.0, 0.05, 0.1))
    v, u = np.nonzero(frame.label == 2)
    box = (int(u.min()) - 12, int(v.min()) - 6, int(u.max()) + 7, int(v.max()) + 7)
    (found,) = segment(unlabelled(frame), config=SegmentConfig(mask=MaskConfig(box_px=box)))
    assert found.id == 1 and iou(found.mask, frame.label == 2) > 0.9


@pytest.mark.parametrize(
    ("box", "says"),
    [((0, 0, 12, 12), "nothing that stands on a plane is whole in the box"), ((5, 5, 5, 9), "is empty or leaves")],
)
def test_a_box_without_a_thing_says_so(box: tuple[int, int, int, int], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        segment(unlabelled(picture(CAN)), config=SegmentConfig(mask=MaskConfig(box_px=box)))


def test_a_given_plane_serves_where_none_is_seen() -> None:
    """Only the can has depth: the plane comes from the caller, or from the camera's pose."""
    T = looking_down(35.0)
    whole = picture(CAN, T=T)
    frame = replace(whole, depth=np.where(whole.label == 1, whole.depth, np.nan).astype(np.float32))
    normal = T[:3, :3].T @ [0.0, 0.0, 1.0]
    given = (*(2.0 * normal).tolist(), 2.0 * float(T[2, 3]))
    (by_plane,) = segment(frame, config=SegmentConfig(plane=PlaneConfig(given=given)))
    (by_pose,) = segment(replace(frame, T_world_camera=T))
    guess = PlaneGuess(camera_height=float(T[2, 3]), tilt=35.0)
    (by_height,) = segment(frame, config=SegmentConfig(guess=guess))
    for found in (by_plane, by_pose, by_height):
        angle, offset = plane_errors(found.plane, T)
        assert angle < 0.1 and offset < 0.001


@pytest.mark.parametrize(("factor", "says"), [(0.1, r"median is 0\.0"), (10.0, r"median is \d+\.?\d* m")])
def test_a_wrong_unit_of_the_depth_is_named(factor: float, says: str) -> None:
    frame = unlabelled(picture(CAN))
    with pytest.raises(ValueError, match=f"{says}.* correct the depth's unit"):
        segment(replace(frame, depth=(frame.depth * factor).astype(np.float32)))


def test_missing_depth_inside_an_outline_is_not_free() -> None:
    frame = picture(CAN)
    v, u = (round(float(np.median(at))) for at in np.nonzero(frame.label == 1))
    assert frame.depth is not None
    holed = frame.depth.copy()
    holed[v - 5 : v + 5, u - 5 : u + 5] = np.nan
    (found,) = segment(unlabelled(replace(frame, depth=holed)))
    assert found.mask[v, u]
    assert not (found.status[v - 5 : v + 5, u - 5 : u + 5] == FREE).any()
