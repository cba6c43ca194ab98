"""Simulated views: scenes and truths are what they claim to be."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from benchmarks.scenes.vessels import GRID, ViewConfig, pose_as_stated
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.observation.settings import PlaneGuess
from probnerf.objects.tabletop import part_distances
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import voxel_centres
from probnerf.settings import InferConfig, quick_smc
from probnerf.types import BASE_Z
from tests.benchmarks import vessels


@pytest.fixture(scope="module")
def vessel():
    return vessels.view()


@pytest.fixture(scope="module")
def rate():
    return vessels.rate()


def _on_handle(view) -> int:
    """Pixels whose depth lies on the handle rather than on the body, traced anew from the picture alone."""
    v, u = np.nonzero(view.picture.label == 1)
    rays = view.camera.rays(np.column_stack([u, v]))
    points = rays / rays[:, 2:] * view.picture.depth[v, u][:, None]
    T = np.linalg.inv(view.T_camera_object)
    points = (points @ T[:3, :3].T + T[:3, 3]) / view.placed.half_extent
    body, handle = (np.asarray(a) for a in jax.jit(part_distances)(view.placed.shape, points.astype(np.float32)))
    return int(((handle < 0.003) & (body > 0.004)).sum())


def test_a_handle_is_hidden_or_shows_clearly():
    assert _on_handle(vessels.picture("hidden")) == 0
    shown, total = _on_handle(vessels.picture("informative")), (vessels.picture("informative").picture.label == 1).sum()
    assert shown >= 0.95 * max(ViewConfig().shown, ViewConfig().shown_share * total)


def test_the_truth_stands_in_each_view_s_own_cube():
    """Without depth the cube is another one, and the same solid fills the same cubic metres of it."""
    views = [vessels.view("informative", depth) for depth in (True, False)]
    assert views[0].frame.depth is not None and views[1].frame.depth is None
    assert views[0].cube.half_extent != views[1].cube.half_extent
    volumes = [view.solid.sum() * (view.cube.half_extent / 16) ** 3 for view in views]
    np.testing.assert_allclose(volumes[1], volumes[0], rtol=0.15)
    # the handle's place is seen: the body and the handle both lie in the open
    assert (views[0].seen & views[0].solid & views[0].near_handle).sum() > 5


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


@pytest.mark.slow
def test_where_the_pose_is_known_the_cube_is_the_object_s_own_and_only_its_shape_is_inferred():
    view = vessels.view("informative", pose_known=True)
    np.testing.assert_allclose(view.T_canonical_view, np.eye(4), atol=1e-9)
    handle = voxel_centres(32)[view.solid & view.near_handle]
    assert handle[:, 0].min() > 0.0 and np.abs(handle[:, 1]).max() < 0.3  # the handle is at +x
    rate = vessels.rate(pose_known=True)
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
    view = vessels.view(depth=False)
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
    exact = vessels.picture().T_world_camera
    supposed = vessels.view(depth=False).frame.T_world_camera
    np.testing.assert_array_equal(supposed, pose_as_stated(exact, vessels.VESSEL))
    np.testing.assert_array_equal(vessels.view().frame.T_world_camera, exact)


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


def test_space_in_the_table_is_not_unseen(vessel):
    in_it = voxel_centres(GRID)[0, 0, :, 2] < BASE_Z
    assert vessel.seen[..., in_it].all() and not vessel.solid[..., in_it].any()
    assert not vessel.seen[..., ~in_it][..., 0].all()
