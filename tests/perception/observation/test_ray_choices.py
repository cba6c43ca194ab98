"""Several choices of a view's pixels, of which each is an observation of its own."""

from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest
from scipy import ndimage

from perception.observation.rays import observations
from perception.observation.settings import ObserveConfig
from probnerf.pixel_status import FREE, UNKNOWN
from tests.perception.cylinders import CAN
from tests.perception.observation.test_rays import CONFIG, seen


def test_each_choice_is_of_other_pixels_and_the_first_is_the_one_of_observe() -> None:
    frame, found, first, cube, _ = seen(CAN)
    every, own = observations(frame, found, replace(CONFIG, choices=3))
    assert len(every) == 3 and own.half_extent == cube.half_extent
    jax.tree.map(np.testing.assert_array_equal, every[0], first)
    directions = [np.asarray(o.rays.direction) for o in every]
    for one, other in combinations(directions, 2):
        same = (one[:, None] == other).all(axis=-1).any(axis=1)
        assert same.mean() < 0.2
    for one, o in zip(directions, every, strict=True):
        told = np.asarray(o.status) != UNKNOWN
        assert told.sum() == CONFIG.colour_rays + CONFIG.free_rays
        assert len(np.unique(one[told], axis=0)) == told.sum()  # no pixel counts twice
    with pytest.raises(ValueError, match="choices is 0"):
        ObserveConfig(choices=0)


def test_few_pixels_are_all_taken_once() -> None:
    """More free rays than there are free pixels near the outline, and than there are at all."""
    frame, found, _, _, _ = seen(CAN)
    away = np.where(found.status == FREE, ndimage.distance_transform_edt(~found.mask), np.inf)
    beside = np.unravel_index(np.argsort(away, axis=None)[:40], away.shape)
    status = np.where(found.status == FREE, UNKNOWN, found.status)
    status[beside] = FREE
    few = replace(found, status=status, occluder=np.zeros_like(found.occluder))
    for observation in observations(frame, few, replace(CONFIG, choices=3))[0]:
        free = np.asarray(observation.status) == FREE
        directions = np.asarray(observation.rays.direction)[free]
        assert len(np.unique(directions, axis=0)) == free.sum() == 40
