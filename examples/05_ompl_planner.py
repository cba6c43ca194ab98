"""OMPL plans past an object of which the camera sees one side, against each thing that Farside gives to planners.

    pip install ompl
    python examples/05_ompl_planner.py --start 0.0 -0.3 0.0 --goal -0.07 0.07 0.0 --file out/one_frame/object_1.npz

or of a node that runs (farside live SOURCE, with bus: {listen: [tcp/127.0.0.1:7447]}), of its latched ~/hypotheses:

    python examples/05_ompl_planner.py --start 0.0 -0.3 0.0 --goal -0.07 0.07 0.0 --connect tcp/127.0.0.1:7447

A ball is moved. OMPL keeps it clear of what is occupied: by two rules about what nobody saw, by Farside's voxels, and
by the messages that a node gives, read back from their bytes: MoveIt's mesh, the octomap, nvblox's distances. All of
them speak of each voxel alone, so Farside is asked about the whole path then: how likely is all that the ball sweeps
free, jointly over the hypotheses? Space outside the object's cube counts as free here, as in `04_reach_planner.py`.
Nobody knows of a way that lies there as a whole (nan).
"""

import struct
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float

import farside
from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, decode, encode, hypotheses_from, make
from node.ros.octree import LEVELS
from node.ros.planner_messages import ESDF, collision_object, octomap_message
from node.ros.services import Answers
from node.ros.settings import BusConfig, PlannerConfig
from probnerf.types import BASE_Z

AROUND = 0.4  # m; the ball stays so near to the object's middle
EDGE = 0.004  # m; between the points of a mesh to which distances are taken

Clear = Callable[[Float[np.ndarray, "3"]], bool]  # whether the ball may be there (m, object frame)


def rules(h: farside.Hypotheses, risk: float, radius: float) -> dict[str, Clear]:
    """When the ball is clear, by each rule and message."""
    axis = (np.arange(h.grid) + 0.5) * h.voxel_m - h.object_frame.half_extent
    centres = farside.Points(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3))
    p = farside.query(h, centres, "object").p_occupied  # cautious where the object is out of model
    risky, seen, unseen = np.array(p) > risk, h.seen.ravel(), h.unseen.ravel()
    of_seen, planner = in_voxels(h, risky & seen, radius), PlannerConfig(risk=risk)
    answers = Answers(planner=planner)
    answers.update([h])
    solid = read_back(collision_object(h, answers.node, planner))
    octomap = in_octomap(read_back(octomap_message([h], answers.node, planner.octomap_m)), radius)
    field = read_back(answers.distances(make(f"{ESDF}_Request", frame_id="object")))
    return {
        "unknown is free": of_seen,
        "unknown is occupied": in_voxels(h, risky | unseen, radius),
        "Farside": in_voxels(h, risky, radius),
        "MoveIt's mesh": in_mesh(solid, radius),
        "octomap": lambda place: of_seen(place) and octomap(place),  # which is of unseen space alone
        "nvblox's distances": in_distances(field, planner.unknown_m, radius),
    }


def read_back(message: Any) -> Any:
    """What a planner has of it."""
    return decode(bytes(encode(message)), message.__msgtype__)


def in_voxels(h: farside.Hypotheses, blocked: Bool[np.ndarray, "V"], radius: float) -> Clear:
    steps = h.voxel_m * np.arange(-np.ceil(radius / h.voxel_m), np.ceil(radius / h.voxel_m) + 1)
    ball = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    ball = ball[np.linalg.norm(ball, axis=1) <= radius]

    def clear(place: Float[np.ndarray, "3"]) -> bool:
        voxels = h.voxels("object", *(ball + place).T)
        return not blocked[voxels[voxels >= 0]].any()

    return clear


def in_mesh(solid: Any, radius: float) -> Clear:
    """By a moveit_msgs/CollisionObject, whose meshes lie in the object's frame: hollow surfaces, as to FCL."""
    if not solid.meshes:
        return lambda place: True
    (mesh,) = solid.meshes
    corners = np.array([(v.x, v.y, v.z) for v in mesh.vertices])
    triangles = corners[[triangle.vertex_indices for triangle in mesh.triangles]]
    parts = int(np.ceil(np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max() / EDGE))
    share = np.array([(i, j, parts - i - j) for i in range(parts + 1) for j in range(parts + 1 - i)]) / parts
    points = np.unique(np.round(share @ triangles, 5).reshape(-1, 3), axis=0)
    return lambda place: bool((np.linalg.norm(points - place, axis=1) > radius + 0.5 * EDGE).all())


def in_octomap(octomap: Any, radius: float) -> Clear:
    """By the leaves whose P(occupied) is above a half: those that MoveIt takes for obstacles."""
    data, low, edges = octomap.data.tobytes(), list[Any](), list[int]()

    def read(at: int, corner: tuple[int, ...], edge: int) -> int:
        """The node that begins at a byte, depth first; returns the byte behind it."""
        log_odds, children = struct.unpack_from("<fB", data, at)
        if not children and log_odds > 0:
            low.append(corner)
            edges.append(edge)
        at += 5
        for child in range(8):
            if children >> child & 1:
                at = read(at, tuple(c + (edge // 2) * (child >> axis & 1) for axis, c in enumerate(corner)), edge // 2)
        return at

    if data:
        read(0, (-(1 << LEVELS - 1),) * 3, 1 << LEVELS)
    first = np.reshape(low, (-1, 3)) * octomap.resolution
    last = first + np.array(edges)[:, None] * octomap.resolution

    def clear(place: Float[np.ndarray, "3"]) -> bool:
        apart = np.maximum(0.0, np.maximum(first - place, place - last))
        return not (np.linalg.norm(apart, axis=1) <= radius).any()

    return clear


def in_distances(field: Any, unknown: float, radius: float) -> Clear:
    """By a response of nvblox_msgs/EsdfAndGradients in the object's frame."""
    sizes = [dim.size for dim in field.esdf_and_gradients.layout.dim]
    distance = np.reshape(field.esdf_and_gradients.data, sizes)
    origin = np.array([field.origin_m.x, field.origin_m.y, field.origin_m.z])

    def clear(place: Float[np.ndarray, "3"]) -> bool:
        cell = np.floor((place - origin) / field.voxel_size_m).astype(int)
        if (cell < 0).any() or (cell >= sizes).any():
            return True
        return bool(distance[tuple(cell)] == unknown or distance[tuple(cell)] > radius)

    return clear


def path(
    h: farside.Hypotheses,
    clear: Clear,
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    radius: float,
    seconds: float,
) -> Float[np.ndarray, "n 3"] | None:
    """Corners of a ball's way that is clear (m, object frame), or None. Raises SystemExit if OMPL is not installed."""
    try:
        from ompl import base, geometric, util
    except ImportError:
        raise SystemExit("OMPL is not installed; this example needs it: pip install ompl") from None
    util.noOutputHandler()
    util.RNG.setSeed(1)
    space, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    bounds.setLow(-AROUND)
    bounds.setHigh(AROUND)
    bounds.setLow(2, BASE_Z * h.object_frame.half_extent + radius)  # above the table
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: clear(np.array([state[0], state[1], state[2]])))
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
    """Plan by each rule and message, and say how likely the way is free.

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
    print(f"{'by':20}{'way, cm':>8}{'P(free)':>9}")
    for rule, clear in rules(h, risk, radius).items():
        corners = path(h, clear, start, goal, radius, seconds)
        answers[rule] = None
        if corners is None:
            print(f"{rule:20}{'none':>8}")
            continue
        answers[rule] = answer = farside.query(h, swept(corners, radius), "object")
        length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        print(f"{rule:20}{100 * length:8.0f}{answer.p_free:9.2f}")
    return answers


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except (ValueError, OSError) as error:  # a file or a node that is not there
        raise SystemExit(f"ompl planner: error: {error}") from None
