"""What the measurements measure with: scenes, truths and scores are what they claim to be."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.measures.rebuilt import VIEWS, see
from benchmarks.measures.scores import Answer, random_boxes, shapes_at
from benchmarks.rivals.quick import METHODS, POSTERIOR
from benchmarks.scenes.vessels import GRID, base_rate, hidden_vessel, pose_as_stated, vessel_picture, vessel_view
from benchmarks.studies.frame import (
    DATA,
    OBJECTS,
    TrueObject,
    free_points,
    is_hidden,
    outward_normals,
    read_truth,
    weighted_median,
)
from benchmarks.studies.hidden import judge
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import segment
from perception.observation.settings import PlaneGuess
from perception.observation.support_plane import heights
from perception.observation.visibility import answered_voxels
from perception.sources.frame_folder import read_frame_folder
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import coarsen, voxel_centres
from probnerf.settings import InferConfig, quick_smc
from probnerf.types import BASE_Z


@pytest.fixture(scope="module")
def rate():
    return base_rate(24)


@pytest.fixture(scope="module")
def vessel():
    found = hidden_vessel(2_000_001)
    assert found is not None
    return found


def test_the_base_rate_has_the_table_s_symmetries(rate):
    np.testing.assert_allclose(rate, np.rot90(rate), atol=1e-12)
    np.testing.assert_allclose(rate, rate[::-1], atol=1e-12)
    assert rate[..., voxel_centres(32)[0, 0, :, 2] < BASE_Z - 0.05].max() == 0.0
    assert rate[15:17, 15:17, 4].min() > 0.9  # almost everything has a bottom in the middle
    assert rate[0, 0].max() == 0.0


def test_a_hidden_handle_is_there_and_unseen(vessel):
    """Some of the solid lies in the handle's stratum, and all of that behind what the camera sees."""
    handle = vessel.solid & vessel.near_handle
    assert handle.sum() > 20
    assert (handle & ~vessel.seen).sum() > 0.9 * handle.sum()
    assert vessel.near_handle.sum() > 3 * handle.sum()  # a ring, of which the handle is a part


def test_where_the_pose_is_known_the_cube_is_the_object_s_own_and_only_its_shape_is_inferred():
    picture = vessel_picture(2_000_001, "informative")
    assert picture is not None
    view = vessel_view(picture, pose_known=True)
    np.testing.assert_allclose(view.T_canonical_view, np.eye(4), atol=1e-9)
    handle = voxel_centres(32)[view.solid & view.near_handle]
    assert handle[:, 0].min() > 0.0 and np.abs(handle[:, 1]).max() < 0.3  # the handle is at +x
    rate = base_rate(24, pose_known=True)
    assert rate[26:, 12:20].mean() > 1.3 * rate[:6, 12:20].mean()  # where handles end, and cartons do not
    prior = load_prior()
    smc = replace(quick_smc(2, 2), start_particles=2)
    infer = InferConfig(lattice=8, smc=smc, smc_from_prior=smc, encoder_starts=False)
    config = ControllerConfig(infer=infer, hypotheses=4, grid=16)
    found = estimate(view.frame, view.segment, prior, config, known=view.cube, stages=1)
    assert found.posterior.positions.shape[-1] == prior.model.latent
    assert not found.hypotheses.pose.any() and found.object_frame is view.cube


def test_without_depth_what_counts_as_seen_tells_nothing_of_where_the_surface_is():
    """Every voxel above the table on a ray to the object counts as unseen, before the surface as behind it."""
    picture = vessel_picture(2_000_001, "hidden")
    assert picture is not None
    view = vessel_view(picture, depth=False)
    assert not (view.solid & view.seen).sum() > 0.03 * view.solid.sum()
    centres = voxel_centres(32).reshape(-1, 3)
    u, v = np.round(view.frame.camera.project(view.cube.to_camera(centres))).astype(int).T
    on_object = view.segment.mask[v.clip(0, view.segment.mask.shape[0] - 1), u.clip(0, view.segment.mask.shape[1] - 1)]
    on_object &= centres[:, 2] >= BASE_Z
    assert not view.seen.ravel()[on_object].any() and on_object.sum() > 2 * view.solid.sum()


def test_without_depth_the_camera_s_pose_errs_as_much_as_is_stated():
    exact = np.eye(4)
    stated_poses = np.stack([pose_as_stated(exact, seed) for seed in range(500)])
    tilt = np.degrees(np.arctan2(stated_poses[:, 2, 1], stated_poses[:, 2, 2]))
    stated = PlaneGuess()
    assert np.std(stated_poses[:, 2, 3]) == pytest.approx(stated.height_sigma, rel=0.1)
    assert np.std(tilt) == pytest.approx(stated.tilt_sigma, rel=0.1)
    assert np.abs([stated_poses[:, 2, 3].mean() / stated.height_sigma, tilt.mean() / stated.tilt_sigma]).max() < 0.15
    picture = vessel_picture(2_000_001, "hidden")
    assert picture is not None
    supposed = vessel_view(picture, depth=False).frame.T_world_camera
    np.testing.assert_array_equal(supposed, pose_as_stated(picture.T_world_camera, 2_000_001))
    np.testing.assert_array_equal(vessel_view(picture).frame.T_world_camera, picture.T_world_camera)


def test_what_the_camera_saw_as_free_is_not_solid(vessel):
    """Of the solid only the visible skin is seen, and every hit lies close to the true solid."""
    assert (vessel.seen & vessel.solid).sum() < 0.5 * vessel.solid.sum()
    v, u = np.nonzero(vessel.segment.status == 1)
    rays = vessel.frame.camera.rays(np.column_stack([u, v]))
    points = vessel.cube.to_cube(rays / rays[:, 2:] * vessel.frame.depth[v, u][:, None])
    points = points[np.isfinite(points).all(axis=1)]
    index = np.floor((points + 1.0) * 16).astype(int)
    near = np.pad(vessel.solid, 1)
    near = np.any([np.roll(near, s, a) for a in range(3) for s in (-1, 0, 1)], axis=0)[1:-1, 1:-1, 1:-1]
    inside = ((index >= 0) & (index < 32)).all(axis=1)
    assert near[tuple(index[inside].T)].mean() > 0.99


def test_the_truth_scores_best_and_is_never_falsely_free(vessel, rate):
    rng = np.random.default_rng(0)
    even = np.full(4, 0.25)
    guesses = rng.random((4, 32, 32, 32)) < rate
    given = {m: Answer(guesses, even, 1.0) for m in METHODS}
    given[POSTERIOR] = Answer(vessel.solid[None], np.ones(1), 1.0, "converged")
    found = judge(vessel, given, rate, 0, warm=True)
    best = found.values[POSTERIOR]
    for method in METHODS[1:]:
        assert best["hidden_nll"] < found.values[method]["hidden_nll"]
        assert best["hidden_nll_handle"] < found.values[method]["hidden_nll_handle"]
    assert best["hidden_nll"] < 0.02 and best["hidden_ece"] < 0.03
    assert not (found.occupied & (found.p_free[POSTERIOR] > 0.95)).any()
    assert not (found.scored & vessel.seen).any()


def test_boxes_lie_about_scored_voxels():
    scored = np.zeros((32, 32, 32), bool)
    scored[3, 30, 16] = True
    boxes = random_boxes(scored, 50, np.random.default_rng(1))
    assert (boxes[:, 0] >= 0).all() and (boxes[:, 1] <= 32).all()
    assert ((boxes[:, 0] <= [3, 30, 16]) & (boxes[:, 1] > [3, 30, 16])).all()


def test_given_and_held_out_views_alternate_around_the_object():
    seen = see(2_000_003, 16, 8)
    position = seen.T_object_camera[:, :3, 3]
    azimuth = np.rad2deg(np.arctan2(position[:, 1], position[:, 0]))
    np.testing.assert_allclose(np.diff(np.sort(azimuth)), 45.0, atol=1e-6)
    np.testing.assert_allclose((azimuth[VIEWS:] - azimuth[:VIEWS]) % 360, 45.0, atol=1e-6)
    elevation = np.rad2deg(np.arcsin(position[:, 2] / np.linalg.norm(position, axis=1)))
    assert elevation.min() >= 15.0 and elevation.max() <= 60.0
    assert ((seen.range > 0).sum(axis=(1, 2)) > 10).all()


def test_normals_of_a_sphere_point_outwards():
    rng = np.random.default_rng(2)
    points = rng.standard_normal((2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals = outward_normals(0.05 * points + [0.1, 0.2, 0.7])
    assert (np.einsum("ni,ni->n", normals, points) > 0.97).mean() > 0.99


def test_a_weighted_median_splits_the_weight():
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.2, 0.6])) == 2.0
    assert weighted_median(np.array([3.0, 1.0, 2.0]), np.array([0.7, 0.1, 0.2])) == 3.0


def test_a_box_turns_with_its_object():
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [1.0, 0.0, 0.0]
    model = TrueObject(np.array([[0.0, 0, 0], [0.3, 0.1, 0.1]]), T)
    inside = model.box_holds(np.array([[0.95, 0.25, 0.05], [1.25, 0.05, 0.05]]), 0.01)
    assert inside.tolist() == [True, False]


def test_free_points_of_the_real_frame_are_free_and_unseen(shared_data):
    frame, truth = read_frame_folder(DATA), read_truth(DATA)
    plane = segment(frame, 1)[0].plane
    points = free_points(frame, plane, truth, 1)
    assert len(points) > 500 and set(truth) == set(OBJECTS)
    assert (heights(points, plane) > 0).all() and is_hidden(frame, points).all()
    for other in truth.values():
        assert not other.box_holds(points, 0.0).any()
        assert np.linalg.norm(points[::50, None] - other.in_camera[None], axis=-1).min() >= 0.015


def test_shapes_are_those_that_are_published(vessel):
    prior, config = load_prior(None), ControllerConfig(infer=InferConfig(smc=quick_smc(2, 4)), hypotheses=8, runs=1)
    found = estimate(vessel.frame, vessel.segment, prior, config, stages=2)
    h, posterior = found.hypotheses, found.posterior
    assert len(posterior.positions) == len(h.weights)  # all of them, in their order
    asked = jnp.asarray(answered_voxels(vessel.frame, vessel.segment, found.object_frame, config.grid))
    shapes = shapes_at(prior.model, found.likelihood, posterior.positions, found.observation.pose_sigma, asked)
    np.testing.assert_array_equal(shapes, coarsen(h.solid, GRID))


def test_space_in_the_table_is_not_unseen(vessel):
    in_it = voxel_centres(GRID)[0, 0, :, 2] < BASE_Z
    assert vessel.seen[..., in_it].all() and not vessel.solid[..., in_it].any()
    assert not vessel.seen[..., ~in_it][..., 0].all()
