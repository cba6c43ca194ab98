"""What colour tells of pixels without depth beside an object: exact pictures with a strip of depth taken away."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Bool

from perception.observation.depth_shadows import by_colour
from perception.observation.segmentation import Segment, segment
from perception.sources.frame import Frame
from probnerf.pixel_status import OBJECT, UNKNOWN
from tests.perception.cylinders import CAN, Cylinder, picture

OTHER = Cylinder(0.14, 0.05, 0.03, 0.08)


def in_shadow(alike: bool = False) -> tuple[Frame, Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """A can, noisy in colour, without depth in the right quarter of it and as much beside it; its mask; the strip."""
    frame = picture(CAN, OTHER)
    can = frame.label == 1
    columns, rows = np.flatnonzero(can.any(axis=0)), np.flatnonzero(can.any(axis=1))
    quarter = np.ptp(columns) // 4
    strip = np.zeros_like(can)
    strip[rows[0] - 5 : rows[-1] + 5, columns[-1] - quarter : columns[-1] + quarter] = True
    rgb = np.full_like(frame.rgb, 180) if alike else frame.rgb
    rgb = np.clip(rgb + 8.0 * np.random.default_rng(0).normal(size=rgb.shape), 0, 255).astype(np.uint8)
    depth = np.where(strip, np.float32(np.nan), frame.depth)
    return replace(frame, rgb=rgb, depth=depth, label=None), can, strip


def the_can(frame: Frame, can: Bool[np.ndarray, "h w"]) -> Segment:
    return max(segment(frame), key=lambda found: int((found.mask & can).sum()))


def test_a_depth_shadow_is_divided_by_colour() -> None:
    frame, can, strip = in_shadow()
    found = the_can(frame, can)
    assert (found.mask & can & strip).sum() > 0.95 * (can & strip).sum()
    assert not (found.mask & strip & ~can).any()
    assert (found.status[strip & can] == OBJECT).mean() > 0.6  # but for the outline's rim
    assert (found.status[strip & ~can] == UNKNOWN).all()  # the table's part stays unknown: it may be anything


def test_where_colours_are_the_same_the_shadow_stays_unknown() -> None:
    frame, can, strip = in_shadow(alike=True)
    found = the_can(frame, can)
    assert (found.status[strip & ~can] == UNKNOWN).all()
    assert (found.mask & strip).sum() < 0.1 * (can & strip).sum()


@pytest.mark.parametrize("reach", [40, 400])
def test_a_background_of_its_colour_and_without_depth_is_not_its_own(reach: int) -> None:
    frame, can, _ = in_shadow()
    rgb, measured = frame.rgb.copy(), np.ones_like(can)
    columns = np.flatnonzero(can.any(axis=0))
    beside = np.zeros_like(can)
    beside[:, columns[-1] + 1 : columns[-1] + reach] = True
    beside &= ~can
    rgb[beside], measured[beside] = rgb[can].mean(axis=0), False
    (alike,) = by_colour(rgb, [can], measured)
    assert not (alike & beside).any()


def test_a_pixel_has_one_owner() -> None:
    frame, can, strip = in_shadow()
    first, second = by_colour(frame.rgb, [can & ~strip, can & ~strip], ~strip)
    assert (first & strip & can).any() and not (first & second).any()


def test_without_masks_there_is_nothing_to_tell() -> None:
    frame, can, _ = in_shadow()
    assert by_colour(frame.rgb, [], np.ones_like(can)) == []
