"""Rays in the cube agree with the cylinder that the picture was made of; what was not seen says nothing."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.observation.object_frame import ObjectFrame, object_frame
from perception.observation.rays import calibration_widths, observe
from perception.observation.segmentation import Segment, segment
from perception.observation.settings import ObserveConfig
from perception.observation.visibility import inside_view, seen_voxels
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.prior.checkpoint import load_prior
from probnerf.types import BASE_Z, BODY_EXTENT, Observation
from tests.perception.cylinders import CAN, Cylinder, looking_down, picture, to_camera, to_world
from tests.priors import TABLETOP

CONFIG = ObserveConfig(colour_rays=192, free_rays=160, occluder_rays=32)
WIDE = Cylinder(0.03, -0.02, 0.08, 0.07)


def seen(
    thing: Cylinder = CAN, *others: Cylinder, degrees: float = 35.0, noise: float = 1.0, distance: float = 0.7
) -> tuple[Frame, Segment, Observation, ObjectFrame, np.ndarray]:
    """Frame, segment, observation and cube of the first cylinder, and T_world_camera."""
    T = looking_down(degrees, distance)
    frame = picture(thing, *others, T=T, noise=noise)
    (found,) = segment(frame, 1)
    return frame, found, *observe(frame, found, CONFIG), T


def to_surface(points: np.ndarray, thing: Cylinder) -> np.ndarray:
    """Distance of world points to a cylinder's surface (m), positive outside."""
    r = np.linalg.norm(points[:, :2] - [thing.x, thing.y], axis=1) - thing.radius
    z = np.abs(points[:, 2] - thing.base - thing.height / 2) - thing.height / 2
    outside = np.hypot(np.maximum(r, 0), np.maximum(z, 0))
    return outside + np.minimum(np.maximum(r, z), 0)


def ends(observation: Observation, length: np.ndarray) -> np.ndarray:
    return np.asarray(observation.rays.origin) + np.asarray(length)[:, None] * np.asarray(observation.rays.direction)


@pytest.mark.parametrize("thing", [CAN, WIDE])
@pytest.mark.parametrize("degrees", [20.0, 35.0, 60.0])
def test_object_rays_end_on_the_object(thing: Cylinder, degrees: float) -> None:
    _, _, observation, cube, T = seen(thing, degrees=degrees)
    valid = np.asarray(observation.range_valid)
    assert valid.sum() > 150
    hits = to_world(cube.to_camera(ends(observation, observation.range)[valid]), T)
    errors = to_surface(hits, thing) / cube.half_extent / np.asarray(observation.range_sigma)[valid]
    assert np.abs(errors).max() < 5.0 and np.sqrt((errors**2).mean()) < 1.3


@pytest.mark.parametrize("thing", [CAN, WIDE, Cylinder(0.0, 0.0, 0.03, 0.2)])
@pytest.mark.parametrize("degrees", [2.0, 15.0, 35.0, 60.0])
def test_the_cube_fits_the_object(thing: Cylinder, degrees: float) -> None:
    frame, found, _, cube, T = seen(thing, degrees=degrees)
    foot = cube.to_cube(to_camera(np.array([thing.x, thing.y, thing.base]), T))
    assert abs(foot[2] - BASE_Z) < 0.02
    assert np.abs(foot[:2]).max() < 2.0 * cube.xy_sigma
    true_half_extent = max(2 * thing.radius, thing.height) / BODY_EXTENT
    assert abs(np.log(true_half_extent / cube.half_extent)) < 2.0 * cube.log_scale_sigma
    # Axes: orthonormal and right-handed, z the plane's normal, x level and towards the camera.
    R = cube.T_camera_object[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(R[:, 2], found.plane[:3], atol=1e-12)
    camera = cube.to_cube(np.zeros(3))
    assert camera[0] > 0 and abs(camera[1]) < 1e-9
    np.testing.assert_allclose(cube.to_camera(camera), 0.0, atol=1e-12)
    assert frame.depth is not None


def test_a_handle_moves_the_guess_little() -> None:
    T = looking_down(35.0)
    frame = picture(CAN, Cylinder(0.065, 0.0, 0.012, 0.09), T=T)  # a post at the can's side, labelled as one with it
    frame = replace(frame, label=(frame.label > 0).astype(np.int32))
    _, cube = observe(frame, segment(frame, 1)[0], CONFIG)
    foot = cube.to_cube(to_camera(np.zeros(3), T))
    assert np.abs(foot[:2]).max() < 0.06
    assert abs(np.log(CAN.height / BODY_EXTENT / cube.half_extent)) < 0.05


def test_a_half_hidden_object_has_wider_widths_and_a_fair_guess() -> None:
    _, _, _, alone, _ = seen(CAN)
    _, found, observation, cube, T = seen(CAN, Cylinder(0.05, -0.2, 0.06, 0.2), degrees=20.0)
    assert found.occluder.any()
    foot = cube.to_cube(to_camera(np.zeros(3), T))
    assert cube.xy_sigma > alone.xy_sigma + 0.05 and cube.log_scale_sigma > alone.log_scale_sigma + 0.05
    assert np.abs(foot[:2]).max() < 2.0 * cube.xy_sigma
    np.testing.assert_allclose(
        observation.pose_sigma,
        [cube.xy_sigma, cube.xy_sigma, cube.log_scale_sigma, 0.005 / cube.half_extent, 0.005 / cube.half_extent],
        rtol=1e-6,
    )


def test_free_rays_miss_the_object_and_meet_the_cube() -> None:
    _, _, observation, cube, T = seen(CAN)
    free = np.asarray(observation.status) == FREE
    assert free.sum() == CONFIG.free_rays and not free[: CONFIG.colour_rays].any()
    t = np.linspace(0.0, 1.0, 400)[:, None, None] * 1.5 * np.linalg.norm(np.asarray(observation.rays.origin)[0])
    points = np.asarray(observation.rays.origin)[free] + t * np.asarray(observation.rays.direction)[free]
    assert (np.abs(points).max(axis=-1) < CONFIG.cube + 0.02).any(axis=0).all()
    world = to_world(cube.to_camera(points), T)
    assert to_surface(world.reshape(-1, 3), CAN).min() > 0.0
    # The limit is where the table, or the floor beyond it, was measured.
    stop = to_world(cube.to_camera(ends(observation, observation.limit)[free]), T)
    limit = np.asarray(observation.limit)[free]
    table = np.linalg.norm(stop[:, :2], axis=1) < 0.4
    assert table.sum() > 50 and np.abs(stop[table, 2]).max() < 0.01
    assert (limit > 0).all()
    # Half of them pass near the outline.
    assert (to_surface(world.reshape(-1, 3), CAN).reshape(world.shape[:2]).min(axis=0) < 0.03).mean() > 0.4


def test_occluder_rays_are_empty_up_to_the_occluder() -> None:
    front = Cylinder(0.02, -0.16, 0.05, 0.08)
    _, _, observation, cube, T = seen(CAN, front, degrees=20.0)
    known = np.asarray((observation.status == UNKNOWN) & (observation.limit > 0))
    assert known[-CONFIG.occluder_rays :].sum() > 20 and not known[: -CONFIG.occluder_rays].any()
    stop = to_world(cube.to_camera(ends(observation, observation.limit)[known]), T)
    gap = to_surface(stop, front)
    assert (gap > -0.003).all() and np.median(gap) < 0.006
    assert (to_surface(stop, CAN) > 0).all()


def test_padding_says_nothing() -> None:
    few = Cylinder(0.0, 0.0, 0.02, 0.05)
    frame, found, observation, _, _ = seen(few, distance=1.6)
    pixels = int((found.status == OBJECT).sum())
    assert pixels < CONFIG.colour_rays  # the premise
    for array in (
        observation.status,
        observation.rgb_valid,
        observation.range_valid,
        observation.limit,
        observation.range,
    ):
        assert not np.asarray(array)[pixels : CONFIG.colour_rays].any()
    total = CONFIG.colour_rays + CONFIG.free_rays + CONFIG.occluder_rays
    assert observation.status.shape == (total,) and observation.colour_count == CONFIG.colour_rays
    np.testing.assert_allclose(np.linalg.norm(observation.rays.direction, axis=1), 1.0, atol=1e-6)
    for leaf in (
        observation.rays.direction,
        observation.range,
        observation.range_sigma,
        observation.limit,
        observation.rgb,
    ):
        assert np.isfinite(leaf).all() and leaf.dtype == np.float32
    assert (np.asarray(observation.range_sigma) > 0).all()
    assert frame.depth is not None


def test_rays_repeat_with_the_seed_and_cover_the_object() -> None:
    frame, found, observation, _, _ = seen(CAN)
    again, other = observe(frame, found, CONFIG)[0], observe(frame, found, CONFIG, seed=1)[0]
    np.testing.assert_array_equal(observation.rays.direction, again.rays.direction)
    assert not np.array_equal(observation.rays.direction, other.rays.direction)
    # Evenly spread: each of 4 x 4 cells of equal pixel counts holds about a sixteenth of the rays.
    pixels = np.argwhere(found.status == OBJECT)
    row_edges = np.quantile(pixels[:, 0], [0.25, 0.5, 0.75])
    column_edges = np.quantile(pixels[:, 1], [0.25, 0.5, 0.75])
    rays = np.asarray(observation.rays.direction)[: CONFIG.colour_rays]
    cube = observe(frame, found, CONFIG)[1]
    px = frame.camera.project(rays @ cube.T_camera_object[:3, :3].T)

    def cells(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return np.bincount(4 * np.digitize(rows, row_edges) + np.digitize(columns, column_edges), minlength=16)

    share = cells(pixels[:, 0], pixels[:, 1]) / len(pixels)
    np.testing.assert_allclose(cells(px[:, 1], px[:, 0]) / CONFIG.colour_rays, share, atol=0.03)


def test_colour_is_of_the_pixel() -> None:
    _, _, observation, _, _ = seen(CAN)
    n = CONFIG.colour_rays
    np.testing.assert_array_equal(np.asarray(observation.rgb_valid), np.arange(len(observation.status)) < n)
    np.testing.assert_allclose(observation.rgb[:n], np.tile(np.array([220, 40, 30]) / 255, (n, 1)), atol=1e-6)


def test_pixels_without_depth_carry_the_mask_alone() -> None:
    frame, _, _, _, _ = seen(CAN)
    holes = frame.depth.copy()
    holes[::2] = np.nan
    frame = replace(frame, depth=holes)
    observation, _ = observe(frame, segment(frame, 1)[0], CONFIG)
    objects = np.asarray(observation.status) == OBJECT
    valid = np.asarray(observation.range_valid)
    assert objects.sum() == CONFIG.colour_rays and 60 < valid.sum() < 130
    assert (np.asarray(observation.range)[objects & ~valid] == 0).all()
    blind = (np.asarray(observation.status) == FREE) & (np.asarray(observation.limit) == 1e3)
    assert blind.sum() > 30  # background by the label map


@pytest.mark.parametrize(
    ("thing", "says"),
    [(Cylinder(0.0, 0.0, 0.06, 0.012), "1.. cm in height"), (Cylinder(0.0, 0.0, 0.22, 0.1), "4... cm across")],
)
def test_a_size_out_of_range_is_named(thing: Cylinder, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        seen(thing, distance=0.9)
    assert "\n" not in str(caught.value) and "object 1" in str(caught.value)


def test_too_little_depth_is_named() -> None:
    frame = picture(CAN)
    (found,) = segment(frame, 1)
    blank = replace(frame, depth=np.where(found.mask, np.nan, frame.depth))
    with pytest.raises(ValueError, match="object 1 has depth in 0 pixels"):
        observe(blank, found, CONFIG)


def test_a_thing_that_lies_below_its_plane_is_named() -> None:
    """As of a flat thing whose plane is measured too high (`sensor_draws.mistaken_plane`)."""
    frame = picture(CAN)
    (found,) = segment(frame, 1)
    sunk = replace(found, plane=found.plane - [0.0, 0.0, 0.0, CAN.height + 0.05])
    with pytest.raises(ValueError, match="object 1 has 0 measured points above the plane"):
        object_frame(frame, sunk, CONFIG)


def centres(cube: ObjectFrame, T: np.ndarray, grid: int = 64) -> np.ndarray:
    ticks = -1 + (np.arange(grid) + 0.5) * 2 / grid
    return to_world(cube.to_camera(np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1)), T)


def test_seen_is_before_the_surface_and_not_behind() -> None:
    frame, found, _, cube, T = seen(CAN, noise=0.0)
    voxels = seen_voxels(frame, found, cube)
    assert voxels.shape == (64, 64, 64) and voxels.dtype == bool
    assert inside_view(frame.camera, cube).all()
    world = centres(cube, T)
    side = 2 * cube.half_extent / 64
    inside = to_surface(world.reshape(-1, 3), CAN).reshape(voxels.shape)
    assert not voxels[inside < -2 * side].any()  # the interior
    # Whether the segment from the camera to a voxel meets the can's axis-aligned interior, by marching.
    t = np.linspace(0.0, 1.0, 300)[:, None]
    rng = np.random.default_rng(0)
    for i, j, k in rng.integers(0, 64, (400, 3)):
        if world[i, j, k, 2] < side or abs(inside[i, j, k]) < 2 * side:
            continue  # too near a surface to tell
        nearest = to_surface(T[:3, 3] + t * (world[i, j, k] - T[:3, 3]), CAN).min()
        if abs(nearest) > 2 * side:
            assert voxels[i, j, k] == (nearest > 0), (i, j, k)
    # x is towards the camera, z up: index order [x, y, z].
    assert voxels[-1, 32, -1] and not voxels[4, 32, 12]


def test_nothing_is_seen_without_depth_or_outside_the_picture() -> None:
    frame, found, _, cube, _ = seen(CAN)
    assert not seen_voxels(replace(frame, depth=np.full_like(frame.depth, np.nan)), found, cube).any()
    aside = replace(cube, T_camera_object=cube.T_camera_object + np.outer([5.0, 0, 0, 0], [0, 0, 0, 1]))
    assert not inside_view(frame.camera, aside).any() and not seen_voxels(frame, found, aside).any()


def test_the_real_frame(shared_data: Path) -> None:
    frame = read_frame_folder(shared_data / "ycbv_000002")
    (can,) = segment(frame, 1)
    observation, cube = observe(frame, can, CONFIG)
    assert 0.085 < cube.half_extent < 0.105  # a 14 cm can
    assert int((np.asarray(observation.status) == OBJECT).sum()) == CONFIG.colour_rays
    hits = ends(observation, observation.range)[np.asarray(observation.range_valid)]
    radius = np.linalg.norm(hits[:, :2], axis=1) * cube.half_extent
    assert np.percentile(radius, 95) < 0.060  # 5.1 cm, and the guess of its axis
    assert 0.1 < seen_voxels(frame, can, cube).mean() < 0.9


def uncertain(frame: Frame, share: float) -> Frame:
    """The same frame, the focal length and principal point uncertain by a share of the focal length."""
    f = share * frame.camera.K[0, 0]
    return replace(frame, camera=replace(frame.camera, K_std=np.array([[f, 0, f], [0, f, f], [0, 0, 0]])))


def test_a_worse_calibration_widens_the_pose_prior() -> None:
    frame, found, exact, cube, _ = seen(CAN)
    widths = [np.asarray(observe(uncertain(frame, s), found, CONFIG)[0].pose_sigma) for s in (0.0, 0.01, 0.1)]
    np.testing.assert_array_equal(widths[0], exact.pose_sigma)
    for narrow, wide in pairwise(widths):
        assert (wide[:4] > narrow[:4]).all() and wide[4] == narrow[4]
    # Of a camera whose size errs by a tenth at 0.7 m, the size and the ranges do.
    assert widths[2][2] == pytest.approx(np.hypot(exact.pose_sigma[2], 0.1), rel=1e-6)
    metres = 0.1 * np.linalg.norm(cube.T_camera_object[:3, 3])
    assert widths[2][3] * cube.half_extent == pytest.approx(np.hypot(0.005, metres), rel=1e-6)


def test_a_wrong_focal_length_errs_as_the_widths_say() -> None:
    frame, _, _, cube, _ = seen(WIDE, noise=0.0)
    share = 0.02
    widths = calibration_widths(uncertain(frame, share).camera, cube)
    wrong = replace(
        frame, camera=replace(frame.camera, K=frame.camera.K * [[1 + share, 1, 1], [1, 1 + share, 1], [1, 1, 1]])
    )
    (again,) = segment(wrong, 1)
    other = object_frame(wrong, again, CONFIG)
    # The size is measured across and along the view; only what is across errs by the whole width.
    assert 0.3 * widths[2] < np.log(cube.half_extent / other.half_extent) < 1.05 * widths[2]
    # A principal point that errs by as much moves it sideways (y of the cube) and nothing else.
    moved = replace(frame.camera, K=frame.camera.K + share * 310.0 * np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]]))
    (again,) = segment(replace(frame, camera=moved), 1)
    other = object_frame(replace(frame, camera=moved), again, CONFIG)
    aside = np.abs(cube.to_cube(other.T_camera_object[:3, 3]))
    assert aside[1] == pytest.approx(widths[1], rel=0.2) and other.half_extent == pytest.approx(
        cube.half_extent, rel=0.01
    )


@pytest.mark.nightly
@pytest.mark.timeout(1200)
def test_a_worse_calibration_gives_a_less_certain_posterior() -> None:
    """Eight answers of four whole runs each: one answer's spread of the size moves by a factor of two with chance."""
    frame, found, _, _, _ = seen(CAN)
    prior, config = load_prior(TABLETOP), ControllerConfig(runs=4)  # fails of the shipped one
    spread, doubt = [], []
    for share in (0.0, 0.1):
        told = uncertain(frame, share)
        answers = [estimate(told, found, prior, config, seed=seed).hypotheses for seed in range(8)]
        log_scale = np.concatenate([h.pose[:, 3] for h in answers])
        weights = np.concatenate([h.weights for h in answers]) / len(answers)
        spread.append(np.sqrt(weights @ (log_scale - weights @ log_scale) ** 2))
        p = [np.tensordot(h.weights, h.solid, axes=1) for h in answers]
        doubt.append(np.mean([(one * (1.0 - one)).mean() for one in p]))
    assert spread[1] > 1.15 * spread[0]  # of the size
    assert doubt[1] > 1.3 * doubt[0]  # of what is occupied
