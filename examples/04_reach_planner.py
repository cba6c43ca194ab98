"""A planner that uses Farside: reach a point beside an object of which the camera sees one side.

    python examples/04_reach_planner.py --goal -0.06 0.02 -0.03 --file out/one_frame/object_1.npz

or of a node that runs (farside live SOURCE, with bus: {listen: [tcp/127.0.0.1:7447]}):

    python examples/04_reach_planner.py --goal -0.06 0.02 -0.03 --connect tcp/127.0.0.1:7447

For each way in (see reaches.py) Farside says, jointly over its hypotheses, how likely the swept box is free of this one
object. The shortest way that is free enough is taken, or none. `farside bench reach` measures how often that collides
and what it costs beside other rules. Space outside the object's cube counts as free here: the robot's own map has to
keep clear of other objects and of whatever else stands there.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import tyro
from reaches import Reach, choose, reaches  # beside this file

import farside
from node.ros.bus import Bus
from node.ros.messages import QUERY_REGION, header, make, pose
from node.ros.services import SWEPT
from node.ros.settings import BusConfig


def asked_of_file(file: Path) -> Callable[[Reach], farside.QueryResult]:
    """Answers from a hypotheses file."""
    scene = farside.load(file)
    return lambda way: farside.query(scene, farside.Swept(way.T_object_box[None], way.size[None]), "object")


def asked_of_node(bus: Bus, node: str, object_id: int) -> Callable[[Reach], farside.QueryResult]:
    """Answers of a running node's `~/query_region`; ends the program where it refuses."""

    def ask(way: Reach) -> farside.QueryResult:
        edges = make("geometry_msgs/msg/Vector3", **dict(zip("xyz", way.size.tolist(), strict=True)))
        box = make("farside_msgs/msg/OrientedBox", pose=pose(way.T_object_box), size=edges)
        request = make(
            f"{QUERY_REGION}_Request", header=header(0, "object"), kind=SWEPT, boxes=[box], object_id=object_id
        )
        response = bus.call(f"{node}/query_region", QUERY_REGION, request, 20.0)
        if not response.success:
            raise SystemExit(response.message)
        return response

    return ask


def plan(
    goal: tuple[float, float, float], answer: Callable[[Reach], farside.QueryResult], least: float
) -> Reach | None:
    """The shortest way that is free enough, each answer printed."""

    def p_free(way: Reach) -> float:
        found = answer(way)
        print(
            f"from {np.rad2deg(way.azimuth):3.0f} degrees, {100 * way.length:3.0f} cm: free with {found.p_free:.2f},"
            f" {100 * found.outside_fraction:.0f}% of it outside the object's cube"
        )
        return found.p_free

    way = choose(reaches(np.asarray(goal)), p_free, least)
    print("no way is free enough" if way is None else f"taken: from {np.rad2deg(way.azimuth):.0f} degrees")
    return way


def main(
    goal: tuple[float, float, float],
    file: Path | None = None,
    connect: str = "tcp/127.0.0.1:7447",
    node: str = "/farside",
    object_id: int = 1,
    least: float = 0.95,
) -> None:
    """Find the shortest way to a point that is free enough.

    Args:
        goal: metres, in the object's frame (x towards the camera, z up)
        file: hypotheses to ask; without it the running node is asked
        connect: the node's endpoint on the bus
        node: the node's full name
        object_id: which of its objects
        least: probability of being free that a way must have
    """
    if file is not None:
        plan(goal, asked_of_file(file), least)
        return
    with Bus(BusConfig(name="reach", connect=(connect,))) as bus:
        plan(goal, asked_of_node(bus, node, object_id), least)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:  # a goal out of reach; a node that is not there (TimeoutError)
        raise SystemExit(f"reach: error: {error}") from None
