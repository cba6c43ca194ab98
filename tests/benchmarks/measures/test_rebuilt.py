"""The views that the prior's gate rebuilds objects from, and those that it judges."""

import numpy as np

from benchmarks.measures.rebuilt import VIEWS, see


def test_given_and_held_out_views_alternate_around_the_object():
    seen = see(2_000_003, 16, 8)
    position = seen.T_object_camera[:, :3, 3]
    azimuth = np.rad2deg(np.arctan2(position[:, 1], position[:, 0]))
    np.testing.assert_allclose(np.diff(np.sort(azimuth)), 45.0, atol=1e-6)
    np.testing.assert_allclose((azimuth[VIEWS:] - azimuth[:VIEWS]) % 360, 45.0, atol=1e-6)
    elevation = np.rad2deg(np.arcsin(position[:, 2] / np.linalg.norm(position, axis=1)))
    assert elevation.min() >= 15.0 and elevation.max() <= 60.0
    assert ((seen.range > 0).sum(axis=(1, 2)) > 10).all()
