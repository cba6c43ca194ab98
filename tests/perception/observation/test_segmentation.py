"""Masks, planes and statuses on exact pictures of cylinders, and on the real frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from perception.observation.segmentation import Segment, backproject, segment
from perception.observation.settings import SegmentConfig
from perception.observation.support_plane import heights
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from tests.perception.cylinders import CAMERA, CAN, TABLE_RADIUS, Cylinder, looking_down, picture


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def plane_errors(plane: np.ndarray, T: np.ndarray, level: float = 0.0) -> tuple[float, float]:
    """Angle (degrees) and offset at the world's origin (m) of a plane that should be z = level."""
    angle = np.degrees(np.arccos(np.clip(plane[:3] @ T[2, :3], -1, 1)))
    return float(angle), float(abs(plane[:3] @ -(T[:3, :3].T @ T[:3, 3]) + plane[3] + level))


@pytest.mark.parametrize("degrees", [15.0, 35.0, 60.0, 85.0])
def test_a_can_on_a_table_is_found(degrees: float) -> None:
    T = looking_down(degrees)
    frame = picture(CAN, T=T)
    (found,) = segment(replace(frame, label=None))
    assert found.id == 1
    assert iou(found.mask, frame.label == 1) > 0.93
    angle, offset = plane_errors(found.plane, T)
    assert angle < 0.5 and offset < 0.002
    assert found.plane[3] > 0 and np.isclose(np.linalg.norm(found.plane[:3]), 1.0)


def test_points_are_where_the_pixels_look() -> None:
    frame = picture(CAN, noise=0.0)
    height = heights(backproject(frame), segment(frame)[0].plane)
    assert np.abs(height[(frame.label == 1)].max() - CAN.height) < 0.003
    table = (frame.label == 0) & (np.abs(height) < 0.02)
    assert np.abs(height[table]).max() < 0.001


def test_the_given_label_is_the_mask() -> None:
    frame = picture(CAN, Cylinder(0.14, 0.05, 0.03, 0.08))
    both = segment(frame)
    assert [s.id for s in both] == [1, 2]
    (second,) = segment(frame, 2)
    np.testing.assert_array_equal(second.mask, frame.label == 2)
    np.testing.assert_array_equal(second.status, both[1].status)


def test_objects_are_numbered_by_size_and_clutter_off_the_table_is_none() -> None:
    beyond = Cylinder(0.0, TABLE_RADIUS + 0.25, 0.08, 0.3, base=-0.1)  # a chair's back, level with the table
    frame = picture(Cylinder(0.15, 0.0, 0.03, 0.08), Cylinder(-0.12, 0.05, 0.05, 0.15), beyond)
    found = segment(replace(frame, label=None))
    assert [s.id for s in found] == [1, 2]
    assert iou(found[0].mask, frame.label == 2) > 0.9
    assert iou(found[1].mask, frame.label == 1) > 0.85


def test_things_two_centimetres_apart_come_apart() -> None:
    things = Cylinder(-0.055, 0.0, 0.045, 0.12), Cylinder(0.0, -0.09, 0.04, 0.06), Cylinder(0.06, 0.0, 0.05, 0.1)
    frame = picture(*things)
    found = segment(replace(frame, label=None))
    assert len(found) == 3
    for i in (1, 2, 3):
        assert max(iou(s.mask, frame.label == i) for s in found) > 0.9


def test_a_low_thing_before_a_tall_one_does_not_cut_it() -> None:
    frame = picture(Cylinder(-0.053, 0.0, 0.045, 0.12), Cylinder(0.0, -0.075, 0.04, 0.06))
    best = max(segment(replace(frame, label=None)), key=lambda s: (s.mask & (frame.label == 1)).sum())
    assert (best.mask & (frame.label == 1)).sum() > 0.9 * (frame.label == 1).sum()


@pytest.mark.parametrize("distance", [0.8, 1.5])
def test_what_belongs_to_a_foot_is_judged_by_the_noise_at_its_distance(distance: float) -> None:
    """A thin plate about a can is its foot where it is higher than the sensor can err there, and table where not."""
    focal = 450.0 * distance  # the picture is the same from everywhere
    camera = replace(CAMERA, K=np.array([[focal, 0.0, 159.5], [0.0, focal, 119.5], [0.0, 0.0, 1.0]]))
    config = SegmentConfig(voxel=0.02)
    least = config.base * max(1.0, distance**2)
    for height, belongs in ((0.7 * least, False), (1.3 * least, True)):
        can, plate = Cylinder(0.0, 0.0, 0.1, 0.2), Cylinder(0.0, 0.0, 0.13, height)
        frame = picture(can, plate, T=looking_down(50.0, distance), noise=0.0, camera=camera, table_radius=1.5)
        (found,) = segment(replace(frame, label=None), config=config)
        assert iou(found.mask, frame.label > 0 if belongs else frame.label == 1) > 0.8
        assert (found.mask & (frame.label == 2)).any() == belongs


def partition(s: Segment) -> None:
    assert set(np.unique(s.status)) <= {UNKNOWN, OBJECT, FREE}
    assert not (s.occluder & (s.status != UNKNOWN)).any()
    assert not ((s.status == OBJECT) & ~s.mask).any()
    assert not ((s.status == FREE) & s.mask).any()


@pytest.mark.parametrize("label", [True, False])
def test_what_pixels_say_of_a_can_alone(label: bool) -> None:
    frame = picture(CAN, label=True)
    (s,) = segment(frame if label else replace(frame, label=None))
    partition(s)
    truth = frame.label == 1
    far_from_outline = ~ndimage.binary_dilation(truth ^ ndimage.binary_erosion(truth), iterations=6)
    known = np.isfinite(frame.depth)
    assert (s.status[truth & far_from_outline & known] == OBJECT).mean() > 0.99
    assert (s.status[~truth & far_from_outline & known] == FREE).mean() > 0.97
    outline = s.mask ^ ndimage.binary_erosion(s.mask)
    assert (s.status[outline] == UNKNOWN).all() and not s.occluder[outline].any()
    # Where there is no depth, colour can tell what is its own, and only a label map what is not.
    blind = ~known & far_from_outline
    assert (s.status[blind & truth] == OBJECT).all()
    assert (s.status[blind & ~truth] == (FREE if label else UNKNOWN)).all()
    assert not s.occluder[~known].any()


def test_nearer_things_are_unknown_and_farther_things_free() -> None:
    front, back = Cylinder(0.02, -0.15, 0.04, 0.07), Cylinder(0.0, 0.25, 0.05, 0.15)
    frame = picture(CAN, front, back, T=looking_down(25.0, 0.8))
    can, near, far = segment(frame)
    for s in (can, near, far):
        partition(s)
    inside = {i: ndimage.binary_erosion(frame.label == i, iterations=4) & np.isfinite(frame.depth) for i in (1, 2, 3)}
    assert (can.occluder[inside[2]]).mean() > 0.9
    assert (can.status[inside[3]] == FREE).mean() > 0.9
    assert (near.status[inside[3]] == FREE).mean() > 0.9
    assert (far.occluder[inside[1]]).mean() > 0.9


def test_what_stands_on_a_box_has_its_own_plane() -> None:
    T = looking_down(35.0)
    frame = picture(Cylinder(0.0, 0.01, 0.05, 0.08, base=0.04), Cylinder(0.0, 0.0, 0.09, 0.04), T=T)
    for found in (segment(frame), segment(replace(frame, label=None))):
        upper = max(found, key=lambda s: iou(s.mask, frame.label == 1))
        lower = max(found, key=lambda s: iou(s.mask, frame.label == 2))
        assert iou(upper.mask, frame.label == 1) > 0.85 and iou(lower.mask, frame.label == 2) > 0.85
        assert plane_errors(upper.plane, T, level=0.04)[1] < 0.004
        assert plane_errors(lower.plane, T)[1] < 0.003
        box = ndimage.binary_erosion(lower.mask, iterations=4) & np.isfinite(frame.depth)
        assert (upper.status[box] == FREE).mean() > 0.9  # at or below its plane


def test_an_object_whose_foot_is_hidden_stands_on_the_table() -> None:
    T = looking_down(20.0)
    frame = picture(CAN, Cylinder(0.0, -0.16, 0.08, 0.07), T=T)
    can = segment(frame, 1)[0]
    height = heights(backproject(frame), can.plane)
    assert np.nanpercentile(height[can.mask], 2) > SegmentConfig().lifted  # the premise
    assert plane_errors(can.plane, T)[1] < 0.003


def blank(frame: Frame, where: np.ndarray) -> Frame:
    return replace(frame, depth=np.where(where, np.nan, frame.depth))


def test_what_cannot_be_segmented_is_named() -> None:
    frame = picture(CAN)
    everywhere = np.ones(frame.depth.shape, bool)
    few = replace(frame, label=np.where(np.cumsum(frame.label == 1).reshape(frame.label.shape) <= 20, frame.label, 0))
    noise = np.random.default_rng(0).uniform(0.3, 3.0, frame.depth.shape)
    cases = [
        (replace(frame, depth=None), None, "without depth the plane"),
        (blank(frame, everywhere), None, "no pixel of 76800 has depth"),
        (frame, 7, "no object 7; its objects: 1"),
        (replace(frame, label=None), 7, "no object 7; its objects: 1"),
        (few, 1, "object 1 has 20 pixels"),
        (blank(frame, frame.label == 1), 1, "0 of them with depth"),
        (replace(frame, depth=noise), None, "no support plane"),
        (replace(picture(), label=None), None, "nothing stands"),
        (picture(), 1, "the label map names no objects"),
        (replace(frame, label=np.arange(frame.depth.size).reshape(frame.depth.shape)), None, "names 76799 objects"),
    ]
    for broken, wanted, says in cases:
        with pytest.raises(ValueError, match=says) as caught:
            segment(broken, wanted)
        assert "\n" not in str(caught.value)


def test_a_small_mask_does_not_spoil_the_others() -> None:
    frame = picture(CAN)
    label = frame.label.copy()
    label[:2, :2] = 5
    assert [s.id for s in segment(replace(frame, label=label))] == [1]


def test_the_real_frame(shared_data: Path) -> None:
    frame = read_frame_folder(shared_data / "ycbv_000002")
    found = segment(replace(frame, label=None))
    given = segment(frame)
    for known in given:
        best = max(found, key=lambda s: iou(s.mask, known.mask))
        assert iou(best.mask, known.mask) > 0.84
        assert np.abs(best.plane - known.plane).max() < 0.003
    can, _, meat, pitcher = (s.plane[3] for s in given)
    assert can == pitcher and 0.03 < can - meat < 0.045  # the meat can stands on the sugar box


@pytest.mark.parametrize("change", [{"above": -1.0}, {"voxel": float("nan")}, {"min_pixels": -1}])
def test_a_length_that_is_none_is_named(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(change))} is .*; give 0 or more"):
        SegmentConfig(**change)


def test_intrinsics_of_another_resolution_are_named() -> None:
    frame = picture(CAN)
    wrong = replace(frame, camera=replace(frame.camera, K=frame.camera.K * [[3.0], [3.0], [1.0]]))
    with pytest.raises(ValueError, match=r"principal point .* is outside .* of another resolution"):
        segment(wrong)
