"""OMPL plans past an object of which the camera sees one side, by three rules about what nobody saw.

    pip install ompl
    python examples/05_ompl_planner.py --start 0.0 -0.3 0.0 --goal -0.07 0.07 0.0 --file out/one_frame/object_1.npz

or of a node that runs (farside live SOURCE, with bus: {listen: [tcp/127.0.0.1:7447]}), of its latched ~/hypotheses:

    python examples/05_ompl_planner.py --start 0.0 -0.3 0.0 --goal -0.07 0.07 0.0 --connect tcp/127.0.0.1:7447

A ball is moved. OMPL keeps it clear of all voxels that a rule calls occupied. That is said of each voxel alone, so
Farside is asked about the whole path then: how likely is all that the ball sweeps free, jointly over the hypotheses?
Space outside the object's cube counts as free here, as in `04_reach_planner.py`.
"""

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float

import farside
from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, hypotheses_from
from node.ros.settings import BusConfig
from probnerf.types import BASE_Z

AROUND = 0.4  # m; the ball stays so near to the object's middle


def occupied(h: farside.Hypotheses, risk: float) -> dict[str, Bool[np.ndarray, "V"]]:
    """Which voxels each rule keeps clear of."""
    risky, seen, unseen = h.p_occupied.ravel() > risk, h.seen.ravel(), h.unseen.ravel()
    return {"unknown is free": risky & seen, "unknown is occupied": risky | unseen, "Farside": risky}


def path(
    h: farside.Hypotheses,
    blocked: Bool[np.ndarray, "V"],
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    radius: float,
    seconds: float,
) -> Float[np.ndarray, "n 3"] | None:
    """Corners of a ball's way clear of the blocked voxels (m, object frame), or None. Raises SystemExit if OMPL is not
    installed.
    """
    try:
        from ompl import base, geometric, util
    except ImportError:
        raise SystemExit("OMPL is not installed; this example needs it: pip install ompl") from None
    steps = np.arange(-radius, radius + h.voxel_m, h.voxel_m)
    ball = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    ball = ball[np.linalg.norm(ball, axis=1) <= radius]

    def clear(state: Any) -> bool:
        voxels = h.voxels("object", *(ball + np.array([state[0], state[1], state[2]])).T)
        return not blocked[voxels[voxels >= 0]].any()

    util.noOutputHandler()
    util.RNG.setSeed(1)
    space, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    bounds.setLow(-AROUND)
    bounds.setHigh(AROUND)
    bounds.setLow(2, BASE_Z * h.object_frame.half_extent + radius)  # above the table
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(clear)
    setup.getSpaceInformation().setStateValidityCheckingResolution(0.5 * h.voxel_m / space.getMaximumExtent())
    ends = []
    for place in (start, goal):
        state = space.allocState()
        for axis in range(3):
            state[axis] = place[axis]
        ends.append(state)
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(geometric.RRTConnect(setup.getSpaceInformation()))
    setup.solve(seconds)
    if not setup.haveExactSolutionPath():
        return None
    setup.simplifySolution()
    found = setup.getSolutionPath()
    return np.array([[found.getState(i)[axis] for axis in range(3)] for i in range(found.getStateCount())])


def swept(corners: Float[np.ndarray, "n 3"], radius: float) -> farside.Swept:
    """Boxes that hold all that the ball sweeps."""
    places, sizes = [], []
    for begin, end in pairwise(corners):
        along = end - begin
        T = np.eye(4)
        T[:3, :3], _ = np.linalg.qr(np.column_stack([along, np.eye(3)]))
        T[:3, 3] = 0.5 * (begin + end)
        places.append(T)
        sizes.append([np.linalg.norm(along) + 2 * radius, 2 * radius, 2 * radius])
    return farside.Swept(np.stack(places), np.array(sizes))


def of_node(connect: str, node: str, object_id: int) -> farside.Hypotheses:
    """An object's newest hypotheses, as the node published them. Raises TimeoutError."""
    came: dict[int, farside.Hypotheses] = {}
    arrived = threading.Event()

    def take(message: Any) -> None:
        came[message.object_id] = hypotheses_from(message)
        if object_id in came:
            arrived.set()

    with Bus(BusConfig(name="ompl_planner", connect=(connect,))) as bus:
        bus.subscribe(f"{node}/hypotheses", HYPOTHESES, take, latched=True, depth=8)
        if not arrived.wait(20.0):
            raise TimeoutError(f"{node} published no object {object_id} in 20 s; it has {sorted(came) or 'none'}")
        return came[object_id]


def main(
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    file: Path | None = None,
    connect: str = "tcp/127.0.0.1:7447",
    node: str = "/farside",
    object_id: int = 1,
    radius: float = 0.02,
    risk: float = 0.05,
    seconds: float = 5.0,
) -> dict[str, farside.QueryResult | None]:
    """Plan by each rule, and say how likely the way is free.

    Args:
        start: metres, in the object's frame (x towards the camera, z up)
        goal: the same
        file: hypotheses to plan by; without it those of the running node
        connect: the node's endpoint on the bus
        node: the node's full name
        object_id: which of its objects
        radius: of the ball, metres
        risk: probability of being occupied above which a voxel is kept clear of
        seconds: time for each plan
    """
    h = farside.load(file)[0] if file is not None else of_node(connect, node, object_id)
    answers: dict[str, farside.QueryResult | None] = {}
    for rule, blocked in occupied(h, risk).items():
        corners = path(h, blocked, start, goal, radius, seconds)
        answers[rule] = None
        if corners is None:
            print(f"{rule}: no way found")
            continue
        answers[rule] = answer = farside.query(h, swept(corners, radius), "object")
        length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        print(f"{rule}: {100 * length:.0f} cm, free with {answer.p_free:.2f}")
    return answers


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:  # a file or a node that is not there
        raise SystemExit(f"ompl planner: error: {error}") from None
