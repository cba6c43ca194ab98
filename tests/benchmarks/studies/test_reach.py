"""The reaching planner: geometry of its ways, what each belief says of one, and where joint and marginal part."""

import itertools

import numpy as np
import pytest

from benchmarks.studies.reach import BELIEFS, FARSIDE, FREE, GRID, INDEPENDENT, OCCUPIED, Belief, tasks_of
from examples.reaches import Gripper, choose, reaches
from probnerf.rendering.occupancy import voxel_centres

CENTRES = voxel_centres(GRID)


def inside(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    return np.all((CENTRES > low) & (CENTRES < high), axis=-1)


BODY = inside((-0.3, -0.3, -0.75), (0.3, 0.3, 0.3))


def belief(shapes: list[np.ndarray], **changes) -> Belief:
    """A body whose far half nobody saw."""
    fields = {
        "truth": BODY,
        "measured": BODY & (CENTRES[..., 0] > 0.2),
        "unseen": CENTRES[..., 0] < 0.0,
        "shapes": np.stack(shapes),
        "weights": np.full(len(shapes), 1.0 / len(shapes)),
        "caution": 0.0,
        "half_extent": 0.15,
    }
    return Belief(**{**fields, **changes})


def test_ways_end_at_the_goal_and_the_shortest_comes_first() -> None:
    goal = np.array([-0.05, 0.03, 0.01])
    ways = reaches(goal)
    assert len(ways) == Gripper().directions and np.all(np.diff([w.length for w in ways]) >= 0)
    for way in ways:
        tip = way.T_object_box @ [-0.5 * way.size[0], 0.0, 0.0, 1.0]
        begin = way.T_object_box @ [0.5 * way.size[0], 0.0, 0.0, 1.0]
        np.testing.assert_allclose(tip[:3], goal, atol=1e-12)
        assert np.hypot(*begin[:2]) == pytest.approx(Gripper().around)
        assert np.arctan2(*(begin - tip)[1::-1]) % (2 * np.pi) == pytest.approx(way.azimuth % (2 * np.pi), abs=1e-9)
    with pytest.raises(ValueError, match=r"not within 0\.3 m"):
        reaches(np.array([0.4, 0.0, 0.0]))


def test_the_first_way_that_is_free_enough_is_taken() -> None:
    assert choose(["a", "b", "c"], {"a": 0.9, "b": 0.96, "c": 1.0}.__getitem__, 0.95) == "b"
    assert choose(["a"], lambda _: 0.9, 0.95) is None


def test_a_part_that_is_somewhere_blocks_jointly_though_no_voxel_is_likely() -> None:
    """Twenty shapes, each with a knob in another place: every voxel is free with 0.95, the whole box never."""
    z = np.linspace(-0.7, 0.25, 21)
    knobs = [inside((-0.6, -0.1, a), (-0.3, 0.1, b)) for a, b in itertools.pairwise(z)]
    knobs = [k for k in knobs if k.any()]
    region = np.any(knobs, axis=0)
    said = belief([BODY | k for k in knobs]).p_free(region)
    marginal = 1.0 - np.mean([(BODY | k)[region] for k in knobs], axis=0)
    assert marginal.min() > 0.9  # each voxel is "probably free" ...
    assert said[FARSIDE] == pytest.approx(0.0, abs=1e-12)  # ... and the box is surely blocked somewhere
    one_place = belief([BODY | region] + [BODY] * 19).p_free(region)
    assert one_place[FARSIDE] == pytest.approx(0.95)
    assert one_place[INDEPENDENT] < 0.05  # independent voxels count one doubt again and again


def test_the_depth_image_s_two_beliefs_are_the_extremes() -> None:
    b = belief([BODY, BODY])
    seen, hidden, wall = inside((0.4, -0.2, -0.2), (0.8, 0.2, 0.2)), inside((-0.8, -0.2, -0.2), (-0.4, 0.2, 0.2)), BODY
    assert b.p_free(seen) == dict.fromkeys(BELIEFS, 1.0)
    assert (b.p_free(hidden)[FREE], b.p_free(hidden)[OCCUPIED], b.p_free(hidden)[FARSIDE]) == (1.0, 0.0, 1.0)
    assert b.p_free(wall)[FREE] == b.p_free(wall)[OCCUPIED] == 0.0
    assert belief([BODY, BODY], caution=0.5).p_free(hidden)[FARSIDE] == pytest.approx(0.5)


def test_scenes_can_be_reached_and_a_belief_that_is_right_neither_collides_nor_goes_round() -> None:
    tasks = tasks_of(belief([BODY]), 20, np.random.default_rng(0))
    assert len(tasks) > 15
    for task in tasks:
        assert task.free.any() and np.all(np.diff(task.lengths) >= 0)
        assert task.outcome(FARSIDE, 0.95) == (0.0, 0.0, 0.0)
        assert np.all(task.p_free[OCCUPIED] <= task.p_free[FREE])
    assert any(task.outcome(OCCUPIED, 0.95) != (0.0, 0.0, 0.0) for task in tasks)
