"""A silhouette on a supposed plane: exact for cylinders, and its errors have the stated widths."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.camera import Camera
from perception.observation.object_frame import object_frame
from perception.observation.segmentation import segment
from perception.observation.settings import ObserveConfig, PlaneGuess, SegmentConfig
from perception.observation.without_depth import StandingBody, plane_depth, standing_body, supposed_plane
from perception.simulation.simulated_camera import PlacedObject, TableScene, place_camera, render
from perception.sources.frame import Frame
from probnerf.objects.tabletop import VALIDATION_SEEDS
from probnerf.pixel_status import FREE, OBJECT
from tests.perception.cylinders import CAMERA, CAN, Cylinder, looking_down, picture, to_camera

NOTHING = np.zeros((240, 320), bool)


def body(thing: Cylinder, plane: np.ndarray, T: np.ndarray, hidden: np.ndarray = NOTHING) -> StandingBody:
    return standing_body(CAMERA, picture(thing, T=T).label == 1, hidden, plane, (0.01, np.radians(1.0)))


def true_plane(T: np.ndarray) -> np.ndarray:
    return np.append(T[2, :3], T[2, 3])


def turned(plane: np.ndarray, radians: float) -> np.ndarray:
    """The plane as a camera sees it whose tilt is larger by so much."""
    return np.append(cv2.Rodrigues(np.array([radians, 0.0, 0.0]))[0] @ plane[:3], plane[3])


@pytest.mark.parametrize("thing", [CAN, Cylinder(0.03, -0.02, 0.08, 0.07), Cylinder(-0.1, 0.0, 0.03, 0.2)])
@pytest.mark.parametrize("degrees", [15.0, 35.0, 55.0])
def test_a_cylinder_is_where_it_stands(thing: Cylinder, degrees: float) -> None:
    T = looking_down(degrees)
    found = body(thing, true_plane(T), T)
    foot = to_camera(np.array([thing.x, thing.y, 0.0]), T)
    distance = np.linalg.norm(foot)
    assert np.linalg.norm(found.foot - foot) < 0.02 * distance
    assert found.across == pytest.approx(2 * thing.radius, rel=0.05)
    assert found.height == pytest.approx(thing.height, rel=0.05, abs=0.006)
    assert found.along_sigma < 0.1 or thing.radius < 0.04  # the foot is an arc, where pixels are fine enough to tell


def outline(sides: tuple[float, float, float], yaw: float, T: np.ndarray) -> np.ndarray:
    """The mask of a box on the table that is turned by `yaw` (degrees)."""
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)]) * sides
    corners[:, :2] = corners[:, :2] @ np.array([[c, s], [-s, c]])
    px = CAMERA.project((corners - T[:3, 3]) @ T[:3, :3])
    mask = np.zeros((240, 320), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(px).astype(np.int32)), 1)
    return mask.astype(bool)


@pytest.mark.parametrize("sides", [(0.18, 0.03, 0.015), (0.2, 0.07, 0.02), (0.25, 0.05, 0.03)])
@pytest.mark.parametrize("yaw", [25.0, 65.0, 130.0])
@pytest.mark.parametrize("degrees", [30.0, 55.0])
def test_what_lies_is_where_its_outline_meets_the_table(sides, yaw: float, degrees: float) -> None:
    """A spoon, a bar and a stick: taken for bodies that stand, they would be a fraction as large."""
    T = looking_down(degrees)
    found = standing_body(CAMERA, outline(sides, yaw, T), NOTHING, true_plane(T), (0.01, np.radians(1.0)))
    assert found.across == pytest.approx(max(sides), rel=0.25)
    assert np.linalg.norm(found.foot - to_camera(np.zeros(3), T)) < 0.15 * max(sides)
    assert 0.0 < found.height < 0.06 and found.along_sigma > 0.1


def test_a_handle_does_not_lay_a_mug_down() -> None:
    T = looking_down(35.0)
    mug = picture(CAN, T=T).label == 1
    handle = (picture(Cylinder(0.06, 0.0, 0.022, 0.08, base=0.02), T=T).label == 1) & ~mug
    both = standing_body(CAMERA, mug | handle, NOTHING, true_plane(T), (0.01, np.radians(1.0)))
    assert handle.sum() > 0.08 * mug.sum()
    assert both.height == pytest.approx(CAN.height, rel=0.1) and both.across == pytest.approx(0.09, rel=0.1)


def test_what_reaches_over_the_horizon_does_not_lie() -> None:
    """A desk lamp: a thin foot, and a shade to its side above the camera, whose rays meet no table."""
    T = looking_down(8.0, 0.6)
    foot, shade = Cylinder(0.0, 0.0, 0.02, 0.25), Cylinder(0.15, 0.0, 0.08, 0.12, base=0.15)
    mask = (picture(foot, T=T).label == 1) | (picture(shade, T=T).label == 1)
    found = standing_body(CAMERA, mask, NOTHING, true_plane(T), (0.01, np.radians(1.0)))
    assert found.across < 0.4 and found.height == pytest.approx(0.25, rel=0.1)


def test_the_plane_comes_from_the_pose_or_from_height_and_tilt() -> None:
    T = looking_down(25.0)
    frame = replace(picture(CAN, T=T), T_world_camera=T)
    np.testing.assert_allclose(supposed_plane(frame, PlaneGuess()), true_plane(T), atol=1e-12)
    np.testing.assert_allclose(supposed_plane(frame, PlaneGuess(table=0.1))[3], T[2, 3] - 0.1, atol=1e-12)
    given = PlaneGuess(camera_height=float(T[2, 3]), tilt=25.0)
    unposed = replace(frame, T_world_camera=None)
    np.testing.assert_allclose(supposed_plane(unposed, given), true_plane(T), atol=1e-12)
    with pytest.raises(ValueError, match="camera_height"):
        supposed_plane(unposed, PlaneGuess())
    with pytest.raises(ValueError, match="under the table"):
        supposed_plane(frame, PlaneGuess(table=2.0))
    for wrong, says in (
        ({"tilt": 20.0}, "camera_height is missing"),
        ({"camera_height": -1.0, "tilt": 20.0}, "camera_height is -1"),
        ({"camera_height": 1.0, "tilt": 120.0}, "tilt is 120"),
        ({"tilt_sigma": -1.0}, "tilt_sigma is -1"),
    ):
        with pytest.raises(ValueError, match=says):
            PlaneGuess(**wrong)


def test_errors_of_the_plane_move_the_body_as_stated() -> None:
    """A higher camera scales all; a steeper one moves the foot by the error over the slope of its ray."""
    T = looking_down(30.0)
    plane = true_plane(T)
    exact = body(CAN, plane, T)
    higher = body(CAN, plane * [1, 1, 1, 1.1], T)
    np.testing.assert_allclose(higher.foot, 1.1 * exact.foot, rtol=1e-9)
    assert higher.across == pytest.approx(1.1 * exact.across) and higher.height == pytest.approx(1.1 * exact.height)
    delta = np.radians(0.5)
    slope = plane[3] / np.sqrt(exact.foot @ exact.foot - plane[3] ** 2)
    share = [np.log(np.linalg.norm(body(CAN, turned(plane, s * delta), T).foot / 1.0)) for s in (-1, 1)]
    assert abs(np.diff(share)[0]) / (2 * delta) == pytest.approx(1 / slope, rel=0.1)
    pixel = 1.0 / CAMERA.K[1, 1]
    assert exact.sight_sigma == pytest.approx(np.hypot(0.01 / plane[3], np.hypot(np.radians(1.0), pixel) / slope))


def test_what_a_silhouette_cannot_tell_is_named() -> None:
    T = looking_down(30.0)
    rows = np.arange(240)[:, None] > np.flatnonzero((picture(CAN, T=T).label == 1).any(axis=1)).max() - 12
    with pytest.raises(ValueError, match="foot is hidden"):
        body(CAN, true_plane(T), T, np.broadcast_to(rows, (240, 320)))
    with pytest.raises(ValueError, match="straight above"):
        body(CAN, true_plane(looking_down(85.0)), looking_down(85.0))
    with pytest.raises(ValueError, match="above the horizon"):
        body(CAN, turned(true_plane(T), -np.radians(70.0)), T)
    flat = looking_down(1.0)
    with pytest.raises(ValueError, match="raise the camera"):
        standing_body(CAMERA, picture(CAN, T=flat).label == 1, NOTHING, true_plane(flat), (0.05, np.radians(3.0)))


def test_a_body_whose_middle_is_hidden_is_refused() -> None:
    """Two strips at the sides of what stands behind a post."""
    camera = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]), np.zeros(5))
    mask = np.zeros((240, 320), bool)
    mask[140:200, 60:70] = mask[140:200, 250:260] = True
    plane = np.array([0.0, -1.0, 0.0, 0.3])
    with pytest.raises(ValueError, match="nothing of it is seen about its middle"):
        standing_body(camera, mask, np.zeros_like(mask), plane, (0.0, 0.0))


def test_free_pixels_end_on_the_plane() -> None:
    T = looking_down(10.0)
    status = np.full((240, 320), FREE)
    status[100:140] = OBJECT
    depth = plane_depth(CAMERA, true_plane(T), status)
    assert np.isnan(depth[100:140]).all() and not np.isnan(depth[:100]).any() and np.isinf(depth[0]).all()
    v, u = np.nonzero(np.isfinite(depth))
    rays = CAMERA.rays(np.column_stack([u, v]))
    points = rays / rays[:, 2:] * depth[v, u][:, None]
    np.testing.assert_allclose(points @ T[2, :3] + T[2, 3], 0.0, atol=1e-9)


def standardised(seed: int, height_sigma: float, tilt_sigma: float) -> np.ndarray | None:
    """Errors of centre (x, y) and log-scale over their stated widths, and of the distance over its own; None: refused.

    The supposed plane errs by a draw from the stated distribution.
    """
    rng = np.random.default_rng([seed, 37])
    placed = PlacedObject(seed, rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(-np.pi, np.pi))
    middle, elevation = placed.T_world_object[:3, 3], np.radians(rng.uniform(15, 60))
    azimuth, distance = rng.uniform(-0.3, 0.3), max(rng.uniform(0.4, 0.7), 3.5 * placed.half_extent)
    towards = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    T = place_camera(tuple(middle + distance * towards), tuple(middle + rng.normal(0.0, 0.02, 3)))
    camera = Camera(240, 180, np.array([[225.0, 0, 119.5], [0, 225.0, 89.5], [0, 0, 1]]), np.zeros(5))
    seen = render(TableScene((placed,)), camera, T)
    supposed = T.copy()
    supposed[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array([np.radians(tilt_sigma) * rng.normal(), 0, 0]))[0]
    supposed[2, 3] += height_sigma * rng.normal()
    frame = Frame(
        (255 * seen.rgb).astype(np.uint8), None, camera, label=seen.label, frame_id="", T_world_camera=supposed
    )
    guess = PlaneGuess(height_sigma=height_sigma, tilt_sigma=tilt_sigma)
    try:
        found = segment(frame, 1, SegmentConfig(guess=guess))[0]
        cube = object_frame(frame, found, ObserveConfig())
    except ValueError:
        return None
    foot = (np.array([placed.x, placed.y, 0.0]) - T[:3, 3]) @ T[:3, :3]
    x, y, _ = cube.to_cube(foot)
    scale = np.log(placed.half_extent / cube.half_extent)
    guessed = cube.to_camera(np.array([0.0, 0.0, -0.75]))
    nearer = np.log(np.linalg.norm(foot) / np.linalg.norm(guessed))
    widths = [
        np.hypot(cube.xy_sigma + cube.along_sigma, cube.sight_sigma * cube.to_cube(np.zeros(3))[0]),
        cube.xy_sigma,
        np.hypot(cube.log_scale_sigma, cube.sight_sigma),
        np.hypot(cube.sight_sigma, (cube.xy_sigma + cube.along_sigma) * cube.half_extent / np.linalg.norm(guessed)),
    ]
    return np.array([x, y, scale, nearer]) / widths


@pytest.mark.slow
def test_errors_have_the_stated_widths() -> None:
    """Over validation objects (all kinds): spreads of 0.7 to 1.3, but for y, which is known better than is claimed."""
    rows = [standardised(seed, 0.015, 1.5) for seed in VALIDATION_SEEDS[700:760]]
    errors = np.array([row for row in rows if row is not None])
    spread, mean = np.sqrt(np.mean(errors**2, axis=0)), errors.mean(axis=0)
    print(f"{len(errors)} of {len(rows)}: rms of x, y, log-scale, distance {spread.round(2)}, mean {mean.round(2)}")
    assert len(errors) > 50
    assert (spread[[0, 2, 3]] > 0.7).all() and (spread < 1.3).all() and (np.abs(mean) < 0.5).all()
