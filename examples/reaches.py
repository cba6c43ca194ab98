"""Ways for a gripper to reach a point beside an object, and the choice among them.

The gripper is a level box. It goes around the object at a distance and then comes in straight, from one of 24
directions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float

Way = TypeVar("Way")


@dataclass(frozen=True)
class Gripper:
    """A level box and where it comes from, metres and radians, object frame (x towards the camera, z up)."""

    width: float = 0.05
    height: float = 0.03
    around: float = 0.30  # distance from the object's axis at which it goes around
    directions: int = 24
    start: float = 0.0  # azimuth at which it waits: the camera's side


@dataclass(frozen=True, eq=False)
class Reach:
    """One straight way in: the box that the gripper sweeps, and the length of the whole way."""

    azimuth: float  # where it comes from, radians
    T_object_box: Float[np.ndarray, "4 4"]
    size: Float[np.ndarray, "3"]  # m
    length: float  # m


def reaches(goal: Float[np.ndarray, "3"], gripper: Gripper | None = None) -> list[Reach]:
    """All ways to a goal (m, object frame), shortest first. Raises ValueError for one that is not within `around`."""
    gripper = gripper or Gripper()
    if not np.hypot(*goal[:2]) < gripper.around:
        raise ValueError(f"the goal {goal.tolist()} is not within {gripper.around:g} m of the object's axis")
    found = []
    for azimuth in np.arange(gripper.directions) * 2 * np.pi / gripper.directions:
        u = np.array([np.cos(azimuth), np.sin(azimuth)])
        along = goal[:2] @ u
        # where goal + distance u is `around` from the axis
        distance = -along + np.sqrt(along**2 + gripper.around**2 - goal[:2] @ goal[:2])
        T = np.eye(4)
        T[:2, 0], T[:2, 1] = u, [-u[1], u[0]]
        T[:3, 3] = [*(goal[:2] + 0.5 * distance * u), goal[2]]
        begin = goal[:2] + distance * u
        turn = abs((np.arctan2(begin[1], begin[0]) - gripper.start + np.pi) % (2 * np.pi) - np.pi)
        size = np.array([distance, gripper.width, gripper.height])
        found.append(Reach(float(azimuth), T, size, float(distance + gripper.around * turn)))
    return sorted(found, key=lambda reach: reach.length)


def choose(ways: Sequence[Way], p_free: Callable[[Way], float], least: float) -> Way | None:
    """The shortest way that is free with probability `least` or more; None where there is none."""
    return next((way for way in ways if p_free(way) >= least), None)
