"""Objects over time: a view of the handle settles it, the same picture again settles nothing, a move is said."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import perception.inference.tracker
from perception.answers.hypotheses import Hypotheses
from perception.inference.controller import Estimate
from perception.inference.limits import Limits
from perception.inference.publish import ConditionedView
from perception.inference.settings import ControllerConfig, TrackConfig
from perception.inference.tracker import Tracker
from perception.observation.rays import observe
from perception.observation.segmentation import segment
from perception.simulation.sensor_faults import simulate
from perception.simulation.simulated_camera import PlacedObject, TableScene, place_camera
from perception.sources.frame import Frame
from probnerf.fields.cylinder import CylinderModel
from probnerf.inference import InferConfig
from probnerf.objects.tabletop import part_distances
from probnerf.pixel_status import UNKNOWN
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.settings import quick_smc
from probnerf.types import Diagnostics, Posterior
from tests.node.mugs import CAMERA, MUG
from tests.perception.answers.test_query import BODY, _fill, _object
from tests.perception.cylinders import CAN, Cylinder, looking_down, picture
from tests.priors import TABLETOP

QUICK = ControllerConfig(hypotheses=32, runs=1)


def frame_from(azimuth: float, mug: PlacedObject = MUG, stamp_ns: int = 0, seed: int = 0) -> Frame:
    """The mug seen from an azimuth about its own place (0: the side that hides its handle)."""
    a = np.radians(azimuth)
    position = (mug.x + 0.42 * float(np.cos(a)), mug.y + 0.42 * float(np.sin(a)), 0.3)
    T = place_camera(position, (mug.x, mug.y, 0.03))
    frame = simulate(TableScene((mug,)), CAMERA, T, seed=seed)
    return replace(frame, stamp_ns=stamp_ns, T_world_camera=T)


def uncertainty(h: Hypotheses) -> float:
    """Mean entropy of the marginals over the cube, nats."""
    return float(h.disagreement.mean())


def on_handle(h: Hypotheses) -> float:
    """Mean p_occupied over the true handle."""
    points = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 65)] * 3), axis=-1).reshape(-1, 3)
    body, handle = (np.asarray(a) for a in part_distances(MUG.shape, jnp.asarray(points, jnp.float32)))
    inside = points[(handle < 0) & (body > 0.04)] * MUG.half_extent
    world = inside @ MUG.T_world_object[:3, :3].T + MUG.T_world_object[:3, 3]
    index = h.voxels("world", *world.T)
    assert len(index) > 100 and (index >= 0).all()
    return float(np.tensordot(h.weights, h.solid.reshape(len(h.weights), -1)[:, index], 1).mean())


def test_a_cube_seen_from_another_camera_is_the_same_cube() -> None:
    first, second = frame_from(0.0), frame_from(70.0)
    _, cube = observe(first, segment(first)[0])
    T = np.linalg.inv(second.T_world_camera) @ first.T_world_camera
    there = cube.seen_from(T)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    at_first = cube.to_camera(points) @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(there.to_camera(points), at_first, atol=1e-12)
    np.testing.assert_allclose(there.to_cube(at_first), points, atol=1e-12)
    height = cube.to_camera(points) @ cube.plane[:3] + cube.plane[3]
    np.testing.assert_allclose(at_first @ there.plane[:3] + there.plane[3], height, atol=1e-12)
    # and it is where the second frame itself finds the object
    _, own = observe(second, segment(second)[0])
    assert np.linalg.norm(own.T_camera_object[:3, 3] - there.T_camera_object[:3, 3]) < 0.02


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[ConditionedView]:
    """The views that inference was asked of. In its place any shape is the answer, at once; it explains any frame."""
    views: list[ConditionedView] = []

    def infer_view(view: ConditionedView, prior: Prior, config: ControllerConfig, **asked: Any) -> Estimate:
        views.append(view)
        h = _object([_fill(BODY)], [1.0], object_id=view.segment.id)
        h = replace(h, object_frame=view.object_frame, T_world_camera=view.frame.T_world_camera, seen=view.seen)
        one = np.zeros(1, np.float32)
        told = Diagnostics(one[0], one[0], one[0], one[0], one[0], one[0], one[0], one, one)
        posterior = Posterior(
            np.zeros((1, 9), np.float32), one, one, one, np.zeros(1, np.int32), one[0], one[0], told, "converged"
        )
        return Estimate(h, posterior, None, view.observation, view.object_frame, 0.0)

    monkeypatch.setattr(perception.inference.tracker, "infer_view", infer_view)
    return views


def tracker_of(**settings: float) -> Tracker:
    """One that takes every frame of a still object for a further view of it."""
    config = ControllerConfig(infer=InferConfig(lattice=8), grid=32)
    return Tracker(
        Prior(CylinderModel(), {}, "cylinder"), config, TrackConfig(**{"moved_below": 0.0, "adds": 0.0, **settings})
    )


def around(azimuth: float, *cans: Cylinder, label: bool = True, stamp_ns: int = 0) -> Frame:
    """Cylinders from an azimuth (degrees) about the world's vertical, where the camera knows its place."""
    a = np.radians(azimuth)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    T = turn @ looking_down()
    return replace(picture(*cans, T=T, label=label), T_world_camera=T, stamp_ns=stamp_ns)


def test_things_keep_their_names_and_places_wherever_the_camera_goes(given: list[ConditionedView]) -> None:
    """What stands still in the world is the same thing from everywhere, though nothing but its place tells."""
    tracker, two = tracker_of(), (CAN, Cylinder(0.2, 0.1, 0.035, 0.1))
    places: dict[int, list[np.ndarray]] = {}
    seen: dict[int, np.ndarray] = {}
    for i, azimuth in enumerate((0.0, 40.0, 110.0, 200.0)):
        frame = around(azimuth, *two, label=False, stamp_ns=i)
        for found in segment(frame):
            update = tracker.update(frame, found)
            h = update.hypotheses
            assert update.change == ("new" if i == 0 else "view")
            places.setdefault(h.object_id, []).append(np.linalg.inv(h.T_object_from("world")))
            before = seen.setdefault(h.object_id, h.seen)
            assert (h.seen | ~before).all()  # what was seen once is seen
            seen[h.object_id] = h.seen
    assert [len(poses) for poses in places.values()] == [4, 4]
    for poses in places.values():
        np.testing.assert_allclose(poses, np.broadcast_to(poses[0], (4, 4, 4)), atol=1e-9)
    apart = np.subtract(*(poses[0][:2, 3] for poses in places.values()))
    assert np.linalg.norm(apart) == pytest.approx(np.hypot(0.2, 0.1), abs=0.02)


def test_near_views_replace_each_other_and_far_ones_add_up_to_the_limit(given: list[ConditionedView]) -> None:
    tracker = tracker_of(views=3, apart=15.0)
    azimuths, count = (0.0, 5.0, 60.0, 120.0, 180.0, 178.0), (1, 1, 2, 3, 3, 3)
    for i, azimuth in enumerate(azimuths):
        frame = around(azimuth, CAN, stamp_ns=i)
        tracker.update(frame, segment(frame)[0])
    each = len(given[0].observation.status)
    assert [len(view.observation.status) / each for view in given] == list(count)
    # A view's rays start at its camera: about the cube, where the first one's azimuth is 0.
    rays = given[-1].observation.rays
    x, y, _ = np.asarray(rays.origin)[np.any(np.asarray(rays.direction) != 0, axis=1)].T
    towards = np.degrees(np.arctan2(y, x))
    assert {int(np.round(a)) % 360 for a in towards} == {5, 60, 178}


@pytest.mark.parametrize(("part", "change"), [(0.5, "view"), (2.0, "moved")])
def test_a_plane_that_moved_says_that_the_camera_did(given: list[ConditionedView], part: float, change: str) -> None:
    """Where the camera does not know its place."""
    config = TrackConfig()
    raised, tilted = looking_down(), looking_down(35.0 + part * config.plane_degrees)
    raised[2, 3] += part * config.plane_m
    tilted[:3, 3] = looking_down()[:3, 3]  # as high as before
    for T in (raised, tilted):
        tracker = tracker_of()
        first, second = (picture(CAN, T=each, noise=0.0) for each in (looking_down(), T))
        assert tracker.update(first, segment(first)[0]).change == "new"
        assert tracker.update(second, segment(second)[0]).change == change


def test_a_second_view_is_inferred_together_with_the_first() -> None:
    """Nothing replaced but the prior, which is small and untrained: so no frame is held against what it explains."""
    few = quick_smc(2, 4)
    settings = InferConfig(lattice=8, smc=few, smc_from_prior=few, encoder_starts=False)
    config = replace(QUICK, hypotheses=4, grid=16, infer=settings)
    prior = Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {}, "x")
    tracker = Tracker(prior, config, TrackConfig(moved_below=0.0))
    looks, updates = [], []
    for stamp_ns, azimuth in enumerate((0.0, 180.0)):
        frame = frame_from(azimuth, stamp_ns=stamp_ns)
        looks.append(tracker.look(frame, segment(frame)[0]))
        updates.append(tracker.infer(looks[-1], Limits(stages=1)))
    first, second = updates
    assert (first.change, second.change) == ("new", "view") and first.stages == second.stages == 1
    assert looks[1].object_id == looks[0].object_id and looks[1].hypotheses.stamp_ns == 1
    # both views' pixels are asked, in one cube: the first frame's, seen by the second camera
    counts = [int((np.asarray(look._view.observation.status) != UNKNOWN).sum()) for look in looks]
    assert counts[1] > 1.5 * counts[0]
    at = [h.T_world_camera @ h.object_frame.T_camera_object for h in (first.hypotheses, second.hypotheses)]
    np.testing.assert_allclose(at[0], at[1], atol=1e-9)
    # what the first camera saw stays seen, and the second one saw more
    assert not (first.hypotheses.seen & ~second.hypotheses.seen).any()
    assert second.hypotheses.seen.mean() > first.hypotheses.seen.mean() + 0.05
    assert not np.array_equal(first.hypotheses.opacity, second.hypotheses.opacity)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_frames_of_a_mug_add_up_as_they_should() -> None:
    tracker = Tracker(load_prior(TABLETOP), QUICK)  # the shipped prior holds handles too badly
    answers: list[Hypotheses] = []
    first = frame_from(0.0)
    begun = tracker.update(first, segment(first)[0], stages=40, on_answer=answers.append)
    assert begun.change == "new" and begun.hypotheses.result == "converged"
    # first answers came before the last, and say so
    assert answers[-1] is begun.hypotheses and len(answers) >= 2
    assert answers[0].result == "underway" and answers[0].stage < begun.hypotheses.stage
    assert answers[0].diagnostics.beta < 1 <= begun.hypotheses.diagnostics.beta

    # ten pictures from one tripod: no certainty is gained, and no stage is spent
    for i in range(1, 11):
        again = frame_from(0.0, stamp_ns=i, seed=i)
        same = tracker.update(again, segment(again)[0], stages=40)
        assert same.change == "same" and same.stages == 0 and same.hypotheses.stamp_ns == i
    assert uncertainty(same.hypotheses) == uncertainty(begun.hypotheses)

    # a view from behind shows the handle (from 100 degrees a dozen pixels of this small picture do, too few)
    side = frame_from(180.0, stamp_ns=20)
    seen = tracker.update(side, segment(side)[0], stages=40)
    assert seen.change == "view" and seen.hypotheses.stamp_ns == 20
    assert on_handle(seen.hypotheses) > max(0.5, on_handle(begun.hypotheses) + 0.2)
    assert uncertainty(seen.hypotheses) < uncertainty(begun.hypotheses)  # by a sixth: the first was sure of no handle

    # the mug is carried off by 6 cm
    moved = frame_from(0.0, replace(MUG, y=MUG.y + 0.06), stamp_ns=30)
    afresh = tracker.update(moved, segment(moved)[0], stages=2)
    assert afresh.change == "moved"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_view_from_the_side_takes_some_doubt_away() -> None:
    """A dozen pixels of the handle show from there: four seeds, as one's chance is as large as what it takes."""
    ratios = []
    for seed in range(4):
        tracker = Tracker(load_prior(), QUICK, seed=seed)
        first, side = frame_from(0.0), frame_from(100.0, stamp_ns=20)
        begun = tracker.update(first, segment(first)[0], stages=40).hypotheses
        ratios.append(uncertainty(tracker.update(side, segment(side)[0], stages=40).hypotheses) / uncertainty(begun))
    assert np.mean(ratios) < 0.92


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_tracker_repeats_itself_given_the_same_stages() -> None:
    def run() -> list[Hypotheses]:
        tracker = Tracker(load_prior(), QUICK, seed=5)
        frames = [frame_from(0.0), frame_from(80.0, stamp_ns=1)]
        return [tracker.update(f, segment(f)[0], stages=2).hypotheses for f in frames]

    for a, b in zip(run(), run(), strict=True):
        assert np.array_equal(a.opacity, b.opacity) and np.array_equal(a.weights, b.weights)
