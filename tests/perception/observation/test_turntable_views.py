"""Posed pictures: squares keep what rays see, masks are the object, the cube fits it."""

import numpy as np
import pytest

from calibration.camera import Camera
from perception.observation.turntable_views import (
    PlateMaskConfig,
    bounds_by_carving,
    bounds_by_depth,
    cube_of,
    mask_by_depth,
    mask_by_picture,
    plate_points,
    square,
)
from perception.sources.frame import Frame
from tests.perception.turning import BOARD, HIGH, LOW, Turning


def truth(frame: Frame) -> np.ndarray:
    """The block's pixels in the square."""
    assert frame.label is not None
    depth = (frame.label + 1).astype(np.float32)
    return square(Frame(frame.rgb, depth, frame.camera, frame_id="c")).depth > 1.5


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


LENSES = {
    "plumb_bob": np.array([-0.2, 0.05, 0.002, -0.001, 0.0]),
    "rational_polynomial": np.array([0.4, 0.1, 1e-4, -6e-5, 0.02, 0.7, 0.2, 0.05]),
    "equidistant": np.array([-0.02, 0.01, -0.004, 0.001]),
}


@pytest.mark.parametrize("model", sorted(LENSES))
def test_a_known_point_is_where_the_square_says(model: str) -> None:
    """Depth that is its pixel's place in the frame (0.1 m a pixel): a point is found there, within 0.1 px."""
    camera = Camera(640, 480, np.array([[300.0, 0, 310.0], [0, 302.0, 233.0], [0, 0, 1]]), LENSES[model], model)
    v, u = np.mgrid[:480, :640].astype(np.float32)
    rgb = np.zeros((480, 640, 3), np.uint8)
    columns, rows = (square(Frame(rgb, (place + 1) / 10, camera)).depth for place in (u, v))
    view = square(Frame(rgb, u / 10, camera))
    rng = np.random.default_rng(0)
    at = rng.uniform(20, view.side - 20, (200, 2)).round()
    rays = np.column_stack([at, np.ones(200)]) @ np.linalg.inv(view.K).T
    px = camera.project(rays * rng.uniform(0.3, 2.0, (200, 1)))
    x, y = at.astype(int).T
    there = view.inside[y, x]
    assert there.sum() > 100
    found = np.rint(
        10 * np.column_stack([columns[y, x], rows[y, x]])[there] - 1
    )  # whole pixels: depth is not interpolated
    assert np.abs(found - px[there]).max() < 0.5 + 0.1


@pytest.mark.parametrize("model", sorted(LENSES))
def test_a_square_shows_what_the_rays_of_the_frame_see(model: str) -> None:
    """With a lens that bends: colour that is a function of direction is the same function in the square."""
    K = np.array([[150.0, 0, 84.0], [0, 152.0, 57.0], [0, 0, 1]])
    camera = Camera(160, 120, K, LENSES[model], model)
    v, u = np.mgrid[:120, :160]
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    colour = np.rint(127 + 120 * np.stack([rays[:, 0], rays[:, 1], rays[:, 0] - rays[:, 1]], -1)).astype(np.uint8)
    frame = Frame(
        colour.reshape(120, 160, 3), (rays[:, 2] * 2).reshape(120, 160).astype(np.float32), camera, frame_id="c"
    )
    view = square(frame)
    assert view.side == 120 and view.inside[5:-5, 5:-5].all() and view.depth is not None
    y, x = np.mgrid[:120, :120] - 59.5
    d = np.stack([x, y, np.full_like(x, view.focal)], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    want = 127 + 120 * np.stack([d[..., 0], d[..., 1], d[..., 0] - d[..., 1]], -1)
    assert np.abs(view.rgb - want)[view.inside].max() < 2.0
    np.testing.assert_allclose(view.depth[view.inside], 2 * d[..., 2][view.inside], atol=0.02)


def test_depth_points_are_in_the_plates_frame() -> None:
    scene = Turning(block=False)
    points = plate_points(square(scene.frame(70.0)), scene.T_plate_camera(70.0))
    z = points[..., 2][np.isfinite(points[..., 2])]
    assert abs(np.median(z)) < 2e-4 and np.percentile(np.abs(z), 95) < 2e-3


@pytest.mark.parametrize("how", ["depth", "white", "background"])
def test_masks_are_the_object(how: str) -> None:
    scene = Turning(depth=how == "depth", ground=(255.0, 255.0, 255.0) if how == "white" else (120.0, 90.0, 60.0))
    empty = None
    if how == "background":
        bare = Turning(depth=False, ground=scene.ground, block=False)
        empty = square(bare.frame(33.0)), bare.T_plate_camera(33.0)
    for angle in (0.0, 150.0):
        frame, T = scene.frame(angle), scene.T_plate_camera(angle)
        view = square(frame)
        if how == "depth":
            mask = mask_by_depth(view, T, BOARD, PlateMaskConfig())
        else:
            mask = mask_by_picture(view, T, BOARD, empty, PlateMaskConfig())
        assert overlap(mask, truth(frame)) > 0.92
    bare_view = square(Turning(depth=how == "depth", ground=scene.ground, block=False).frame(0.0))
    T = scene.T_plate_camera(0.0)
    found = (
        mask_by_depth(bare_view, T, BOARD, PlateMaskConfig())
        if how == "depth"
        else mask_by_picture(bare_view, T, BOARD, empty, PlateMaskConfig())
    )
    assert found.mean() < 5e-4  # an empty plate holds no object


def test_bounds_are_the_objects() -> None:
    scene, angles = Turning(), np.arange(0, 360, 45)
    T = np.stack([scene.T_plate_camera(a) for a in angles])
    frames = [scene.frame(a) for a in angles]
    views, masks = [square(f) for f in frames], np.stack([truth(f) for f in frames])
    parts = np.stack([bounds_by_depth(view, t, mask) for view, t, mask in zip(views, T, masks, strict=True)])
    np.testing.assert_allclose(parts[:, 0].min(axis=0), LOW, atol=0.004)
    np.testing.assert_allclose(parts[:, 1].max(axis=0), HIGH, atol=0.004)
    hull = bounds_by_carving(masks, T, views[0].focal, BOARD)
    np.testing.assert_allclose(hull[:, :2], np.stack([LOW, HIGH])[:, :2], atol=0.01)
    assert hull[0, 2] < 0.005 and HIGH[2] - 0.005 < hull[1, 2] < HIGH[2] + 0.03  # pointed on top, never cut
    with pytest.raises(ValueError, match="masks have no object in common"):
        bounds_by_carving(np.zeros_like(masks), T, views[0].focal, BOARD)


def test_the_cube_holds_the_object_as_the_family_has_it() -> None:
    """Largest side 1.4 of the half side, base at -0.75, middle on the axis."""
    centre, side = cube_of(np.stack([LOW, HIGH]))
    low, high = (2 * (corner - centre) / side for corner in (LOW, HIGH))
    np.testing.assert_allclose(high - low, np.array([0.06, 0.04, 0.08]) * 1.4 / 0.08)
    np.testing.assert_allclose(low[:2], -high[:2])
    assert low[2] == pytest.approx(-0.75)
