"""What is gone, and what is merely not seen."""

from dataclasses import replace

import numpy as np
import pytest

from perception.observation.seen_surface import is_gone
from perception.sources.frame import Frame
from tests.perception.cylinders import CAN, picture


@pytest.fixture(scope="module")
def frame() -> Frame:
    return picture(CAN)


def with_depth(frame: Frame, depth: np.ndarray | None) -> Frame:
    return replace(frame, depth=depth)


def test_a_thing_is_gone_where_the_table_is_seen_behind_it(frame: Frame) -> None:
    mask = frame.label == 1
    assert mask.sum() > 100
    assert is_gone(frame, mask, picture())
    assert not is_gone(frame, mask, frame)


def test_a_picture_that_shows_nothing_there_says_nothing(frame: Frame) -> None:
    empty = picture().depth
    assert empty is not None and frame.depth is not None
    strip = np.where(np.arange(len(empty))[:, None] < 30, empty, np.nan)
    covered = np.full_like(empty, 0.06)
    shiny = np.where(frame.label == 1, np.nan, frame.depth)
    for depth in (None, np.full_like(empty, np.nan), strip, covered, shiny):
        assert not is_gone(frame, frame.label == 1, with_depth(frame, depth))


def test_a_camera_that_turned_away_says_nothing(frame: Frame) -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    before = replace(frame, T_world_camera=np.eye(4))
    empty, mask = picture(), frame.label == 1
    assert is_gone(before, mask, replace(empty, T_world_camera=np.eye(4)))
    assert not is_gone(before, mask, replace(empty, T_world_camera=T))


def test_of_a_thing_without_depth_nothing_is_known(frame: Frame) -> None:
    mask = frame.label == 1
    assert frame.depth is not None
    for depth in (None, np.where(mask, np.nan, frame.depth)):
        assert not is_gone(with_depth(frame, depth), mask, picture())
