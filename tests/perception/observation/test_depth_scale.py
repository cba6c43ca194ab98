"""Depth of a wrong scale is named where the camera's height is known, and a stated error widens place and size."""

from dataclasses import replace

import numpy as np
import pytest

from perception.observation.object_frame import object_frame
from perception.observation.segmentation import segment
from perception.observation.settings import ObjectFrameConfig, ObserveConfig, PlaneGuess, SegmentConfig
from perception.sources.frame import Frame
from tests.perception.cylinders import CAN, looking_down, picture


def _frame(factor: float, posed: bool = True) -> Frame:
    frame = picture(CAN, T=looking_down(35.0))
    assert frame.depth is not None
    return replace(frame, depth=factor * frame.depth, T_world_camera=looking_down(35.0) if posed else None)


@pytest.mark.parametrize(("factor", "said"), [(1.06, "6% too long"), (0.94, "6% too short"), (1.0, ""), (1.01, "")])
def test_depth_of_a_wrong_scale_is_named_by_the_cameras_pose(factor: float, said: str) -> None:
    doubt = segment(_frame(factor)).doubt
    assert said in doubt and bool(doubt) == bool(said)


def test_a_height_that_was_given_comes_first_and_nothing_is_said_without_one() -> None:
    height = float(looking_down(35.0)[2, 3])
    given = SegmentConfig(guess=PlaneGuess(camera_height=height, tilt=35.0))
    assert "6% too long" in segment(_frame(1.06, posed=False), None, given).doubt
    assert not segment(_frame(1.06, posed=False)).doubt


def test_a_pose_in_another_world_says_nothing() -> None:
    """A robot's base at half the height of its table, and a world that is tilted."""
    frame = _frame(1.0)
    lifted, tilted = looking_down(35.0), looking_down(35.0)
    lifted[2, 3] += 0.4
    turn = np.radians(20.0)
    tilted[:3] = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]) @ tilted[:3]
    for T in (lifted, tilted):
        assert not segment(replace(frame, T_world_camera=T)).doubt
    off = looking_down(35.0)
    off[2, 3] += 0.05  # a table 5 cm over the world's ground, which the configuration can say
    assert segment(replace(frame, T_world_camera=off)).doubt
    assert not segment(replace(frame, T_world_camera=off), None, SegmentConfig(guess=PlaneGuess(table=0.05))).doubt


def test_a_stated_error_is_the_cubes() -> None:
    frame = _frame(1.0)
    (found,) = segment(frame)
    assert object_frame(frame, found, ObserveConfig()).sight_sigma == 0.0
    assert object_frame(frame, found, ObserveConfig(depth_scale_sigma=0.05)).sight_sigma == 0.05
    with pytest.raises(ValueError, match="depth_scale_sigma is 5; give a relative error"):
        ObjectFrameConfig(depth_scale_sigma=5)
