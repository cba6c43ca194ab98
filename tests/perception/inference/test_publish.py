"""Of which voxels of a cube shapes are asked, and what few populations lose."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.ndimage import generate_binary_structure, maximum_filter

from perception.inference.publish import _beside_smooth, _hedged, _with_surface, expected_loss
from perception.observation.rays import observe
from perception.observation.segmentation import segment
from perception.observation.visibility import answered_voxels, seen_voxels, surface_voxels
from probnerf.rendering.occupancy import voxel_centres
from tests.node.mugs import mug_hypotheses, table_frame
from tests.perception.cylinders import CAN, looking_down, picture


def test_all_is_asked_but_space_seen_free_well_before_the_surface() -> None:
    T = looking_down(35.0)
    frame = picture(CAN, T=T)
    (found,) = segment(frame)
    cube = observe(frame, found)[1]
    asked, seen = answered_voxels(frame, found, cube, 64), seen_voxels(frame, found, cube, 64)
    assert asked[~seen].all() and not asked.all()
    points = (cube.to_camera(voxel_centres(64).astype(np.float64)) @ T[:3, :3].T) + T[:3, 3]
    beside = np.hypot(points[..., 0] - CAN.x, points[..., 1] - CAN.y) - CAN.radius
    above = points[..., 2] - CAN.height
    voxel = 2 * cube.half_extent / 64
    body = (np.maximum(beside, above) <= 0.0) & (points[..., 2] > 0)
    assert (body & seen).any() and asked[body].all()  # also where its wall is seen
    over = (above > 4 * voxel) & seen  # the camera looks down on the top
    assert over.any() and not asked[over].all()
    assert (~asked).mean() > 0.15


def test_what_was_measured_of_an_object_is_in_every_shape() -> None:
    """Shapes that lack it get its voxels; a shape that has it, to a face of a voxel, stays as it was."""
    frame = table_frame()
    found = segment(frame)[0]
    mug = mug_hypotheses(frame, found, [0.5, 2.0, 3.0], [0.5, 0.3, 0.2])
    surface = surface_voxels(frame, found, mug.object_frame, mug.grid)
    assert surface.sum() > 100 and (surface & ~mug.seen).sum() < 0.1 * surface.sum()
    surface &= mug.seen
    half = replace(mug, opacity=np.where(np.arange(mug.grid) < mug.grid // 2, mug.opacity, 0).astype(np.uint8))
    whole = _with_surface(half, surface)
    for shape, was in zip(whole.solid, half.solid, strict=True):
        assert (was <= shape).all()
        face = generate_binary_structure(3, 1)
        assert (maximum_filter(shape, footprint=face) >= surface).all()
        assert not (maximum_filter(was, 3) >= surface).all()
    assert ((whole.opacity == half.opacity) | surface).all()
    np.testing.assert_array_equal(_with_surface(whole, surface).opacity, whole.opacity)


def test_pixels_between_two_surfaces_are_of_neither() -> None:
    frame = table_frame()
    assert frame.depth is not None
    found = segment(frame)[0]
    cube = observe(frame, found)[1]
    v, u = (int(np.median(a)) for a in np.nonzero(found.mask))
    flying = frame.depth.copy()
    flying[v, u] -= 0.03
    clean, bad = (surface_voxels(replace(frame, depth=d), found, cube, 64) for d in (frame.depth, flying))
    assert clean.any() and not (bad & ~clean).any()
    assert not surface_voxels(replace(frame, depth=None), found, cube, 64).any()


def _voxel(p: np.ndarray) -> SimpleNamespace:
    """One voxel, of which each population has its own probability: that weight on a full shape, the rest on none."""
    return SimpleNamespace(
        population=np.repeat(np.arange(len(p)), 2),
        weights=np.stack([p, 1.0 - p], axis=1).ravel() / len(p),
        solid=np.tile([True, False], len(p)).reshape(-1, 1, 1, 1),
        seen=np.zeros((1, 1, 1), bool),
    )


@pytest.mark.parametrize("populations", [4, 8, 32])
def test_the_expected_loss_is_what_the_log_score_loses_by_few_populations(populations: int) -> None:
    rng, everywhere = np.random.default_rng(0), np.ones((1, 1, 1), bool)
    told, lost = [], []
    for _ in range(2000):
        p = rng.beta(2.0, 3.0, populations)  # of mean 0.4, which is right
        told.append(expected_loss(cast(Any, _voxel(p)), everywhere))
        q = p.mean()
        lost.append(0.4 * np.log(0.4 / q) + 0.6 * np.log(0.6 / (1.0 - q)))
    assert np.mean(told) == pytest.approx(np.mean(lost), rel=0.12)


def test_populations_that_agree_lose_nothing_and_one_cannot_tell() -> None:
    everywhere = np.ones((1, 1, 1), bool)
    assert expected_loss(cast(Any, _voxel(np.full(3, 0.4))), everywhere) == pytest.approx(0.0, abs=1e-7)
    assert expected_loss(cast(Any, _voxel(np.array([0.0, 0.0]))), everywhere) == 0.0
    assert expected_loss(cast(Any, _voxel(np.array([0.0, 1.0]))), everywhere) == pytest.approx(0.5)
    assert np.isnan(expected_loss(cast(Any, _voxel(np.array([0.4]))), everywhere))


def test_draws_of_the_network_get_their_share_in_every_population() -> None:
    positions, population = np.zeros((6, 2)), np.repeat([3, 5], 3)
    weights, draws = np.array([0.1, 0.1, 0.1, 0.3, 0.2, 0.2]), np.arange(1.0, 17.0).reshape(8, 2)
    mixed, w, names = _hedged((cast(Any, positions), weights, population), cast(Any, draws), 2, 0.4)
    np.testing.assert_array_equal(np.asarray(mixed), np.concatenate([positions, draws[:2]]))
    assert w.sum() == pytest.approx(1.0)
    assert w[6:].sum() == pytest.approx(0.4)
    np.testing.assert_allclose(w[:6], 0.6 * weights)
    np.testing.assert_array_equal(names[6:], [3, 5])
    few = _hedged((cast(Any, positions), weights, population), cast(Any, draws), 100, 0.4)[1]
    assert len(few) == 6 + len(draws)


def test_smooth_shapes_get_their_share_and_end_where_no_learnt_shape_reaches() -> None:
    frame = table_frame()
    mug = mug_hypotheses(frame, segment(frame)[0], [0.5, 2.0, 3.0], [0.5, 0.3, 0.2])
    everything = SimpleNamespace(shapes=lambda cube, grid, count, seed: np.ones((count, grid, grid, grid), bool))
    mixed = _beside_smooth(mug, cast(Any, everything), 4, 0.3)
    learnt = mug.solid.any(axis=0)
    n = len(mug.weights)
    assert mixed.weights[n:].sum() == pytest.approx(0.3)
    np.testing.assert_allclose(mixed.weights[:n], 0.7 * mug.weights)
    assert set(mixed.population) == set(mug.population)
    assert (mixed.solid[n:] | learnt == learnt).all() and (mixed.solid[n:].mean() > 0.9 * learnt.mean())
