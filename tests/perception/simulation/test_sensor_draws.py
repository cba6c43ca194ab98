"""Drawn sensors see; drawn planes are off by what is stated."""

import numpy as np
import pytest

from calibration.camera import Camera
from perception.simulation.sensor_draws import KINDS, PlaneErrorConfig, draw_sensor, mistaken_plane
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import FaultlessImage

SIZE, NEAR, FAR = 80, 0.5, 0.8
CAMERA = Camera(SIZE, SIZE, np.array([[200.0, 0, 40], [0, 200.0, 40], [0, 0, 1]]), np.zeros(5))


def step_picture() -> FaultlessImage:
    """A square at NEAR before a wall at FAR."""
    depth, label = np.full((SIZE, SIZE), FAR), np.zeros((SIZE, SIZE), np.int32)
    depth[25:55, 25:55], label[25:55, 25:55] = NEAR, 1
    return FaultlessImage(np.full((SIZE, SIZE, 3), 0.5), depth, depth, depth, label)


@pytest.mark.parametrize("kind", KINDS)
def test_drawn_sensors_see_most_of_a_plain_scene(kind: str) -> None:
    """To a centimetre or two, on a scene at arm's length; never the same sensor twice."""
    drawn = [draw_sensor(np.random.default_rng(i), kind) for i in range(40)]
    assert len({config.noise for config in drawn}) == 40
    assert {np.sign(config.baseline) for config in drawn} == {-1.0, 1.0}
    known = []
    for i, config in enumerate(drawn):
        depth = sense(step_picture(), CAMERA, None, i, config).depth
        middle = depth[32:48, 32:48]
        if config.shiny:  # it looks into the mirror
            middle = depth[:16, :16] - FAR + NEAR
        assert abs(np.nanmedian(middle) - NEAR) < 0.02
        known.append(np.isfinite(middle).mean())
    assert np.mean(known) > 0.95
    assert draw_sensor(np.random.default_rng(3)) == draw_sensor(np.random.default_rng(3))


def test_mistaken_planes_are_off_by_millimetres_at_the_foot() -> None:
    up = np.array([0.0, -0.6, -0.8])
    plane, at = np.append(up, 0.5), np.array([0.02, 0.1, 0.55])
    foot = at - (at @ up + 0.5) * up
    rng, config = np.random.default_rng(0), PlaneErrorConfig()
    wrong = np.array([mistaken_plane(plane, at, rng) for _ in range(500)])
    offset = wrong[:, :3] @ foot + wrong[:, 3]
    tilt = np.degrees(np.arccos(np.clip(wrong[:, :3] @ up, -1.0, 1.0)))
    assert offset.std() == pytest.approx(config.offset_sigma, rel=0.1) and abs(offset).max() <= 0.010 + 1e-9
    assert tilt.max() <= config.tilt_most + 1e-6 and (tilt > 0.8).any()
    assert np.allclose(np.linalg.norm(wrong[:, :3], axis=1), 1.0)
    assert np.allclose(mistaken_plane(plane, at, rng, PlaneErrorConfig(0.0, 0.0, 0.0, 0.0)), plane)
