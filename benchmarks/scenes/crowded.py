"""Ten things of the family on a simulated table, half hidden behind each other, and the truth of unseen space."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from benchmarks.scenes.vessels import ViewConfig, simulated_camera, stand
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import PlacedObject, TableScene, render, truth
from perception.sources.frame import Frame
from probnerf.objects.tabletop import TEST_SEEDS, signed_distance
from probnerf.types import BASE_Z, BODY_EXTENT

AREA = (0.28, 0.42)  # m, half sides of the part of the table that they stand on
GAP = 0.01  # m between the circles that bodies stand in
VIEW = ViewConfig(elevation=(30.0, 50.0), distance=(1.0, 1.2), aim=0.0)  # of the middle of the things
LEAST = 500  # px of a thing in sight, without which it is not asked for
MARGIN, BEHIND, DRAWN, SCORED = 0.03, 0.005, 20_000, 2000  # m about its box, m behind what is seen; points

_distance = jax.jit(signed_distance)


@dataclass(frozen=True, eq=False)
class Crowd:
    """A scene, its frame with the true label map, and the true depth."""

    scene: TableScene
    T_world_camera: Float[np.ndarray, "4 4"]
    frame: Frame
    depth: Float[np.ndarray, "h w"]  # m along z; inf where there is nothing


def crowd(seed: int, count: int = 10) -> Crowd:
    """`count` test objects at random places, as a camera on one side of the table sees them. Its labels are those with
    500 pixels in sight.
    """
    rng = np.random.default_rng([seed, 71])
    placed = list[PlacedObject]()
    for number in TEST_SEEDS[100 * seed :]:
        if len(placed) == count:
            break
        for _ in range(20):
            x, y = rng.uniform(-AREA[0], AREA[0]), rng.uniform(-AREA[1], AREA[1])
            thing = PlacedObject(number, x, y, rng.uniform(-np.pi, np.pi))
            if all(np.hypot(x - o.x, y - o.y) > _radius(thing) + _radius(o) + GAP for o in placed):
                placed.append(thing)
                break
    scene = TableScene(tuple(placed))
    T_world_camera = stand(np.array([0.0, 0.0, 0.05]), 0.0, rng, VIEW)
    camera = simulated_camera(VIEW)
    picture = render(scene, camera, T_world_camera)
    frame = sense(picture, camera, T_world_camera, seed)
    assert frame.label is not None
    small = [i for i in range(1, count + 1) if (frame.label == i).sum() < LEAST]
    frame = replace(frame, label=np.where(np.isin(frame.label, small), 0, frame.label))
    return Crowd(scene, T_world_camera, frame, picture.depth)


def _radius(thing: PlacedObject) -> float:
    return 0.5 * BODY_EXTENT * thing.half_extent


def hidden_points(made: Crowd, object_id: int) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Unseen points about one of its things (camera frame, m), and which of them lie in it.

    Uniform in its box enlarged by 3 cm, above the table, in the picture, and 5 mm or more behind the true depth there.
    """
    placed = made.scene.objects[object_id - 1]
    T, half_extent = truth(made.scene, made.T_world_camera)[object_id - 1], placed.half_extent
    rng = np.random.default_rng([placed.seed, 73])
    low, high = _box(placed)
    margin = MARGIN / half_extent
    cube = rng.uniform([*(low[:2] - margin), BASE_Z], high + margin, (DRAWN, 3))
    points = half_extent * cube @ T[:3, :3].T + T[:3, 3]
    camera = made.frame.camera
    px = np.round(camera.project(points))
    inside = np.all((px >= 0) & (px < [camera.width, camera.height]), axis=1)
    u, v = np.where(inside[:, None], px, 0).astype(int).T
    keep = np.flatnonzero(inside & (points[:, 2] >= made.depth[v, u] + BEHIND))[:SCORED]
    return points[keep], np.asarray(_distance(placed.shape, jnp.asarray(cube[keep]))) <= 0.0


def _box(placed: PlacedObject) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Corners of the box about a thing, cube units, to a twentieth."""
    ticks = np.linspace(-1.0, 1.0, 41)
    points = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    solid = points[np.asarray(_distance(placed.shape, jnp.asarray(points))) <= 0.025]
    return solid.min(axis=0), solid.max(axis=0)
