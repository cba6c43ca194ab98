"""Laws of the faults that follow from the scene: bias is bias, edges move by so many pixels, shadows have a side."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.camera import Camera
from perception.simulation.depth_faults import cavity_depth, fatten_edges, stereo_shadow
from perception.simulation.sensor_faults import SensorConfig, sense
from perception.simulation.simulated_camera import FaultlessImage

SIZE, NEAR, FAR = 80, 0.5, 0.8
CAMERA = Camera(SIZE, SIZE, np.array([[200.0, 0, 40], [0, 200.0, 40], [0, 0, 1]]), np.zeros(5))
CLEAN = SensorConfig(noise=0.0, noise_z2=0.0, quantum=1e-6, blobs=0.0, colour_noise=0.0, baseline=0.0)
SQUARE = np.s_[25:55, 25:55]


def flat_picture(z: float, rgb: float = 0.5) -> FaultlessImage:
    depth = np.full((SIZE, SIZE), z)
    return FaultlessImage(np.full((SIZE, SIZE, 3), rgb), depth, depth, depth, np.zeros((SIZE, SIZE), np.int32))


def step_picture(rgb: float = 0.5) -> FaultlessImage:
    """A square at NEAR before a wall at FAR."""
    flat = flat_picture(FAR, rgb)
    depth, label = flat.depth.copy(), flat.label.copy()
    depth[SQUARE], label[SQUARE] = NEAR, 1
    return replace(flat, depth=depth, nearest=depth, farthest=depth, label=label)


def bowl_picture(rgb: float = 1.0) -> FaultlessImage:
    """A round bowl, 4 cm deep, on a wall, seen from above its opening."""
    v, u = np.mgrid[:SIZE, :SIZE] - 40.0
    r = np.hypot(u, v)
    depth = np.where(r < 20, NEAR + 0.04 * (1.0 - (r / 20) ** 2), np.where(r < 24, NEAR, FAR))
    label = (r < 24).astype(np.int32)
    return FaultlessImage(np.full((SIZE, SIZE, 3), rgb), depth, depth, depth, label)


def test_off_is_as_it_was() -> None:
    """Every fault after `colour_noise` is off by default, alone and together, and draws nothing from the old stream."""
    picture = step_picture()
    plain = sense(picture, CAMERA, None, seed=4)
    faint = SensorConfig(rim=5, patch=3.0, dark=1e-9, cavity_lost=1e-9, rim_lost=1e-12, cavity=1e-12)
    for config in (SensorConfig(), faint):
        again = sense(picture, CAMERA, None, seed=4, config=config)
        assert np.array_equal(again.depth, plain.depth, equal_nan=True)
        assert np.array_equal(again.rgb, plain.rgb) and np.array_equal(again.label, plain.label)


@pytest.mark.parametrize("z", [0.4, 1.0])
def test_bias_is_a_polynomial_of_depth(z: float) -> None:
    config = replace(CLEAN, bias=(0.003, -0.01, 0.02), noise=0.001)
    error = sense(flat_picture(z), CAMERA, None, seed=0, config=config).depth - z
    assert np.nanmean(error) == pytest.approx(0.003 - 0.01 * z + 0.02 * z**2, abs=1e-4)


@pytest.mark.parametrize("width", [1, 3])
def test_fattening_moves_edges_by_its_width_alone(width: int) -> None:
    depth = sense(step_picture(), CAMERA, None, seed=0, config=replace(CLEAN, fattening=width)).depth
    near = np.zeros((SIZE, SIZE), bool)
    near[25 - width : 55 + width, 25 - width : 55 + width] = True
    assert np.abs(depth[near] - NEAR).max() < 1e-5 and np.abs(depth[~near] - FAR).max() < 1e-5


def test_fattening_leaves_slopes_alone() -> None:
    """A table that recedes by 4 mm a pixel has no outline."""
    slope = np.broadcast_to(np.linspace(0.4, 0.72, SIZE)[:, None], (SIZE, SIZE))
    picture = replace(flat_picture(0.4), depth=slope, nearest=slope - 0.001, farthest=slope + 0.001)
    assert np.array_equal(fatten_edges(picture, 4, 0.01).depth, slope)


@pytest.mark.parametrize("baseline", [0.06, 0.12, -0.06, -0.12])
def test_shadow_lies_opposite_the_second_eye(baseline: float) -> None:
    """As wide as the disparities differ, but for a pixel at each end; it leaves the foreground whole."""
    picture = step_picture()
    width = 200.0 * abs(baseline) * (1 / NEAR - 1 / FAR)
    lost = stereo_shadow(picture.depth, 200.0, baseline)
    columns = np.flatnonzero(lost.any(axis=0))
    assert (
        width - 2.01 <= len(columns) <= width + 1.01 and not lost[SQUARE].any() and (lost[25:55].sum(axis=1) > 0).all()
    )
    assert columns.max() == 24 if baseline > 0 else columns.min() == 55
    sensed = sense(picture, CAMERA, None, seed=0, config=replace(CLEAN, baseline=baseline))
    assert np.array_equal(np.isnan(sensed.depth), lost)
    assert not stereo_shadow(picture.depth, 200.0, 0.0).any()


def test_dark_things_have_no_depth() -> None:
    lost = [
        np.isnan(sense(flat_picture(0.5, rgb), CAMERA, None, 0, replace(CLEAN, dark=0.2)).depth).mean()
        for rgb in (0.0, 0.1, 0.3)
    ]
    assert lost[0] == 1.0 and 0.4 < lost[1] < 0.6 and lost[2] == 0.0


def test_glare_blinds_about_the_mirror_direction_on_glossy_things() -> None:
    """A glossy wall that faces the camera mirrors the projector beside the optical axis only."""
    matt = flat_picture(0.5)
    config = replace(CLEAN, shiny=6.0, baseline=0.0)
    assert not np.isnan(sense(matt, CAMERA, None, 0, config).depth).any()
    lost = np.isnan(sense(replace(matt, gloss=np.ones((SIZE, SIZE))), CAMERA, None, 0, config).depth)
    v, u = np.mgrid[:SIZE, :SIZE] - 40.0
    angle = np.degrees(np.arctan(np.hypot(u, v) / 200.0))
    assert lost[angle < 2.5].all() and not lost[angle > 6.5].any() and lost.any()


def test_white_cavities_fill_and_black_ones_do_not() -> None:
    bowl = bowl_picture()
    inside = bowl.depth - NEAR
    assert np.allclose(cavity_depth(bowl), np.where(bowl.label > 0, inside, 0.0))
    for rgb, share in ((1.0, 0.7), (0.5, 0.7), (0.0, 1.0)):
        depth = sense(bowl_picture(rgb), CAMERA, None, 0, replace(CLEAN, cavity=share)).depth
        part = bowl.label > 0
        assert np.allclose(depth[part], NEAR + (1 - rgb * share) * inside[part], atol=1e-5)
        assert np.allclose(depth[bowl.label == 0], FAR, atol=1e-5)
    lost = np.isnan(sense(bowl, CAMERA, None, 0, replace(CLEAN, cavity_lost=0.5)).depth)
    assert 0.35 < lost[inside > 0.005].mean() < 0.65 or not lost[bowl.label == 0].any()
    assert not cavity_depth(step_picture()).any()  # a plain thing has none


def test_rims_lose_depth_within_their_width() -> None:
    picture = step_picture()
    mixed = replace(picture, farthest=np.where(np.roll(picture.label, 1, axis=1) != picture.label, FAR, picture.depth))
    config = replace(CLEAN, rim_lost=1.0, rim=2)
    lost = np.isnan(sense(mixed, CAMERA, None, 0, config).depth)
    assert lost[30:50, 23:28].all() and not lost[30:50, 30:50].any() and not lost[:, :20].any()


def test_registration_moves_colour_and_label_together() -> None:
    u = np.broadcast_to(np.arange(SIZE), (SIZE, SIZE))
    ramp = np.repeat((u / SIZE)[..., None], 3, axis=2)
    picture = replace(step_picture(), rgb=ramp)
    plain = sense(picture, CAMERA, None, 0, CLEAN)
    shifted = sense(picture, CAMERA, None, 0, replace(CLEAN, registration=(1.0, 0.0)))
    half = sense(picture, CAMERA, None, 0, replace(CLEAN, registration=(0.5, 0.0)))
    assert np.array_equal(shifted.depth, plain.depth, equal_nan=True)
    assert np.array_equal(shifted.label[:, 1:], plain.label[:, :-1])
    change = plain.rgb.astype(float) - half.rgb
    assert change[:, 1:].mean() == pytest.approx(0.5 / SIZE * 255, rel=0.1)


def test_smoothing_averages_noise_and_keeps_edges_and_holes() -> None:
    noisy = replace(CLEAN, noise=0.002, noise_width=0.1, blobs=1e-3)
    rough, fine = (sense(step_picture(), CAMERA, None, 0, replace(noisy, smoothing=s)).depth for s in (0.0, 1.5))
    assert np.array_equal(np.isnan(rough), np.isnan(fine))
    assert np.nanstd(fine[30:50, 30:50]) < 0.5 * np.nanstd(rough[30:50, 30:50])
    assert np.nanmax(np.abs(fine[SQUARE] - NEAR)) < 0.01 and np.nanmin(fine[:, :24]) > FAR - 0.01
