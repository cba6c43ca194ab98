"""Answers are probabilities that fall as the region grows; no order or repetition of the hypotheses changes them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception.answers.hypotheses import Hypotheses
from perception.answers.next_view import NextViewConfig, rank_views
from perception.answers.query import QueryResult, marginal, query
from perception.answers.regions import Box, Points, Region, Swept
from tests.properties.drawn import hypotheses, law, poses, scenes, seeds, slower_law

ROUNDING = 1e-9
NOW = 2**61  # ns


def some_points(seed: int, reach: float = 0.2) -> np.ndarray:
    """1 to 40 points within `reach` of the frame's origin, m."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-reach, reach, (rng.integers(1, 41), 3))


def some_boxes(seed: int, thickness: float) -> Swept:
    """1 to 3 turned boxes about the frame's origin, with edges of `thickness` (m) and more."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (rng.integers(1, 4), 1, 1))
    T[:, :3, :3] = np.linalg.qr(rng.normal(size=(len(T), 3, 3)))[0]
    T[:, :3, 3] = rng.uniform(-0.2, 0.2, (len(T), 3))
    return Swept(T, rng.uniform(thickness, thickness + 0.1, (len(T), 3)))


def free_of(r: QueryResult) -> tuple[float, float]:
    """p_free and p_free_few; of a region that nobody looked at, as what is not inferred counts in a larger one: 1."""
    assert np.isnan(r.p_free) == np.isnan(r.p_free_few) == np.isnan(r.p_free_se) == (r.outside_fraction == 1.0)
    return (1.0, 1.0) if np.isnan(r.p_free) else (r.p_free, r.p_free_few)


def falls(scene: Sequence[Hypotheses], small: Region, large: Region) -> None:
    """No probability of being free is larger for the larger region, and no occupied volume is smaller."""
    a, b = (query(scene, region, "camera" if len(scene) > 1 else "object", NOW) for region in (small, large))
    assert np.all(np.array(free_of(b)) <= np.array(free_of(a)) + ROUNDING)
    for name, rows in a.blocked_by.items():
        assert set(rows) <= set(b.blocked_by[name])
    if len(scene) == 1:  # the volume of several is drawn
        assert all(b.volume_m3[q] >= a.volume_m3[q] - ROUNDING for q in a.volume_m3)


@law
@given(scenes(), seeds, seeds)
def test_more_points_are_less_likely_free(scene: list[Hypotheses], first: int, more: int) -> None:
    points = some_points(first)
    falls(scene, Points(points), Points(np.concatenate([points, some_points(more)])))


@law
@given(scenes(), seeds, seeds, st.floats(0.0, 0.1), st.floats(0.0, 0.1))
def test_larger_boxes_and_further_ones_are_less_likely_free(
    scene: list[Hypotheses], first: int, more: int, low: float, high: float
) -> None:
    """Boxes at least a voxel thick; a thinner one stands for a voxel about its middle."""
    thickness = max(h.voxel_m for h in scene)
    boxes, further = some_boxes(first, thickness), some_boxes(more, thickness)
    T = boxes.T_frame_box.copy()
    T[:, :3, 3] += T[:, :3, 0] * (high - low) / 2  # each grows along its x axis by `low` and `high`
    size = boxes.size + np.array([low + high, 0.0, 0.0])
    larger = Swept(np.concatenate([T, further.T_frame_box]), np.concatenate([size, further.size]))
    falls(scene, boxes, larger)


halves = st.lists(st.integers(-20, 20), min_size=3, max_size=3).map(np.array)


@law
@given(hypotheses(), halves, halves, halves, halves)
def test_a_larger_box_along_the_axes_is_less_likely_free(
    h: Hypotheses, a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray
) -> None:
    """Boxes whose corners lie on half voxels of the cube, where its lattice is exact."""
    corners = 0.5 * h.voxel_m * np.stack([a, b, c, d])
    low, high = np.minimum(corners[0], corners[1]), np.maximum(corners[0], corners[1]) + 0.5 * h.voxel_m
    small, large = (
        Box(tuple(low), tuple(high)),
        Box(*map(tuple, (np.min([low, *corners[2:]], 0), np.max([high, *corners[2:]], 0)))),
    )
    falls([h], small, large)


def regions(scene: Sequence[Hypotheses], seed: int) -> list[Region]:
    low, high = np.sort(np.random.default_rng(seed).uniform(-0.2, 0.2, (2, 3)), axis=0)
    return [Points(some_points(seed)), Box(tuple(low), tuple(high)), some_boxes(seed, 0.001)]


@law
@given(scenes(), seeds)
def test_answers_are_probabilities_shares_and_ordered_volumes(scene: list[Hypotheses], seed: int) -> None:
    for region in regions(scene, seed):
        r = query(scene, region, "camera", NOW)
        p_free, p_free_few = free_of(r)
        assert (0.0 <= p_free <= 1.0 + ROUNDING and 0.0 < p_free_few < 1.0) or not r.blocked_by
        assert not r.p_free_se < 0.0 and 1.0 - ROUNDING <= r.effective_hypotheses <= max(len(h.weights) for h in scene)
        assert 0.0 <= r.volume_m3["q05"] <= r.volume_m3["q50"] <= r.volume_m3["q95"]
        assert 0.0 <= r.unseen_fraction and r.unseen_fraction + r.outside_fraction <= 1.0 + ROUNDING
        assert 0.0 <= r.entropy_nats <= np.log(2.0) + ROUNDING
        if isinstance(region, Points):  # all of it is free no more often than its most doubtful point's voxel
            free = np.ones(len(region.points))
            for h in scene:
                index = h.voxels("camera", *region.points.T)
                free *= np.where(index >= 0, 1.0 - marginal(h)[index], 1.0)
            assert p_free <= free.min() + ROUNDING
            assert r.p_occupied is not None and 0.0 <= min(r.p_occupied) and max(r.p_occupied) <= 1.0


@law
@given(scenes(), seeds)
def test_objects_are_independent(scene: list[Hypotheses], seed: int) -> None:
    for region in regions(scene, seed):
        together, alone = query(scene, region, "camera", NOW), [query([h], region, "camera", NOW) for h in scene]
        if not np.isnan([r.p_free for r in alone]).any():  # one's table may be another's space
            assert together.p_free == pytest.approx(np.prod([r.p_free for r in alone]))
        assert together.blocked_by == {name: rows for r in alone for name, rows in r.blocked_by.items()}
        if together.p_occupied is not None:
            free = np.prod([1.0 - np.array(r.p_occupied) for r in alone], axis=0)
            np.testing.assert_allclose(1.0 - np.array(together.p_occupied), free, atol=ROUNDING)


def same_answers(
    scene: list[Hypotheses], told: list[Hypotheses], region: Region, leave: tuple[str, ...] = ("blocked_by",)
) -> tuple[QueryResult, QueryResult]:
    a, b = query(scene, region, "camera", NOW), query(told, region, "camera", NOW)
    for name, value in a.as_dict().items():
        if name not in leave:
            assert b.as_dict()[name] == (value if value is None else pytest.approx(value, rel=1e-6, abs=1e-9)), name
    return a, b


def rows_changed(h: Hypotheses, rows: np.ndarray, weights: np.ndarray) -> Hypotheses:
    """The hypotheses `rows`, with these weights."""
    return replace(h, opacity=h.opacity[rows], pose=h.pose[rows], population=h.population[rows], weights=weights)


def reordered(h: Hypotheses, rng: np.random.Generator) -> tuple[Hypotheses, np.ndarray]:
    rows = rng.permutation(len(h.weights))
    return rows_changed(h, rows, h.weights[rows]), rows


def split(h: Hypotheses, rng: np.random.Generator) -> tuple[Hypotheses, np.ndarray]:
    """One hypothesis told as two twins of half its weight."""
    row = int(rng.integers(len(h.weights)))
    rows = np.append(np.arange(len(h.weights)), row)
    weights = h.weights[rows]
    weights[row] *= 0.5
    weights[-1] *= 0.5
    return rows_changed(h, rows, weights), rows


Retold = Callable[[Hypotheses, np.random.Generator], tuple[Hypotheses, np.ndarray]]
retold = pytest.mark.parametrize("change", [reordered, split])


@retold
@law
@given(scene=scenes(), seed=seeds)
def test_an_answer_is_the_same_however_hypotheses_are_told(change: Retold, scene: list[Hypotheses], seed: int) -> None:
    rng = np.random.default_rng(seed)
    told, rows = zip(*(change(h, rng) for h in scene), strict=True)
    for region in regions(scene, seed):
        a, b = same_answers(scene, list(told), region)
        assert a.blocked_by == {
            name: sorted({int(rows[name - 1][row]) for row in blocking}) for name, blocking in b.blocked_by.items()
        }
        assert a.blocked_by.keys() == b.blocked_by.keys()


@retold
@slower_law
@given(scene=scenes(), seed=seeds)
def test_views_are_worth_the_same_however_hypotheses_are_told(
    change: Retold, scene: list[Hypotheses], seed: int
) -> None:
    rng, few = np.random.default_rng(seed), NextViewConfig(azimuths=4, elevations=(30.0,))
    told = [change(h, rng)[0] for h in scene]
    a, b = (rank_views(objects, None, 4, few) for objects in (scene, told))
    assert b.gain_nats == pytest.approx(a.gain_nats, abs=1e-6)
    assert b.entropy_nats == pytest.approx(a.entropy_nats, abs=ROUNDING)
    assert (a.gain_nats >= 0.0).all() and (a.gain_nats <= a.entropy_nats + ROUNDING).all()
    assert (np.diff(a.gain_nats) <= 0.0).all()


@law
@given(hypotheses(T_world_camera=poses()), seeds)
def test_an_answer_is_the_same_in_every_frame(h: Hypotheses, seed: int) -> None:
    points = some_points(seed, h.object_frame.half_extent)
    own = query([h], Points(points), "object", NOW)
    for frame in ("camera", "world"):
        T = np.linalg.inv(h.T_object_from(frame))
        there = query([h], Points(points @ T[:3, :3].T + T[:3, 3]), frame, NOW)
        a, b = there.as_dict(), own.as_dict()
        for name in ("p_occupied", "p_occupied_few"):  # between voxels' centres
            assert a.pop(name) == pytest.approx(b.pop(name), abs=1e-6)
        assert a == b
