"""A planner that uses Farside: reach a point beside an object of which the camera sees one side.

    farside live SOURCE                                   # in one terminal, with bus: {listen: [tcp/127.0.0.1:7447]}
    python examples/reach.py --goal -0.06 0.02 -0.03      # in another

The gripper is a level box that comes in straight, from one of 24 directions, after it went around the object at a
distance. Of each direction the node says, jointly over its hypotheses, how likely the swept box is free of this one
object (`~/query_region`); the shortest way that is free enough is taken, or none. How often that collides, and what it
costs beside other rules, is measured by `farside bench reach`. What is outside the object's cube counts as free here:
other objects, and whatever else stands there, are for the robot's own map to keep clear of.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import tyro
from jaxtyping import Float

from node.ros.bus import Bus
from node.ros.messages import QUERY_REGION, header, make, pose
from node.ros.services import SWEPT
from node.ros.settings import BusConfig

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


def main(
    goal: tuple[float, float, float],
    object_id: int = 1,
    least: float = 0.95,
    connect: str = "tcp/127.0.0.1:7447",
    node: str = "/farside",
) -> None:
    """Ask a running node for the shortest way to a point that is free enough.

    Args:
        goal: metres, in the object's frame
        least: probability of being free that a way must have
        connect: the node's endpoint on the bus
    """
    with Bus(BusConfig(name="reach", connect=(connect,))) as bus:

        def p_free(way: Reach) -> float:
            """The node's probability that the way is free of the object; ends the program where it has none."""
            edges = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", way.size.tolist(), strict=True)))
            box = make("farside_msgs/msg/OrientedBox", pose=pose(way.T_object_box), size=edges)
            request = make(
                f"{QUERY_REGION}_Request", header=header(0, "object"), kind=SWEPT, boxes=[box], object_id=object_id
            )
            said = bus.call(f"{node}/query_region", QUERY_REGION, request, 20.0)
            if not said.success:
                raise SystemExit(said.message)
            print(
                f"from {np.rad2deg(way.azimuth):3.0f} degrees, {100 * way.length:3.0f} cm: free with {said.p_free:.2f},"
                f" {100 * said.outside_fraction:.0f}% of it outside the object's cube"
            )
            return said.p_free

        way = choose(reaches(np.asarray(goal)), p_free, least)
    print("no way is free enough" if way is None else f"taken: from {np.rad2deg(way.azimuth):.0f} degrees")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:  # a goal out of reach; a node that is not there (TimeoutError)
        raise SystemExit(f"reach: error: {error}") from None
