"""Pictures for the rivals: what they show is where they say it is, and a file gives them back."""

from dataclasses import fields

import numpy as np
import pytest

from benchmarks.paper.families import CARS
from benchmarks.rivals.picture_set import PictureSet, load_pictures
from benchmarks.rivals.pictures import Options, draw_pictures
from probnerf.geometry import pinhole_rays


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    return draw_pictures(Options(tmp_path_factory.mktemp("pictures") / "f.npz", "cars", "val", 2, 3, 16, processes=1))


def test_pictures_are_of_the_objects_of_their_seeds_in_the_cube(pictures):
    assert pictures.seed.tolist() == [1_000_000, 1_000_001]
    np.testing.assert_allclose(pictures.T_object_camera[1], CARS.cameras(1_000_001, 3), atol=1e-6)
    focal = 8.0 / float(pictures.tan_half_fov)
    for T, ranges in zip(pictures.T_object_camera[0], pictures.range[0], strict=True):
        origins, directions = pinhole_rays(T, focal, 16)
        hit = ranges.ravel() > 0
        points = origins[hit] + ranges.astype(np.float32).ravel()[hit, None] * directions[hit]
        assert hit.any() and np.abs(points).max() < 1.0
    assert (pictures.rgb[pictures.range == 0] == 255).all()


def test_a_file_gives_pictures_back(pictures, tmp_path):
    pictures.save(tmp_path / "pictures.npz")
    found = load_pictures(tmp_path / "pictures.npz")
    for field in fields(PictureSet):
        before, after = getattr(pictures, field.name), getattr(found, field.name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)


def test_another_file_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", rgb=np.zeros(1))
    with pytest.raises(ValueError, match="holds no pictures"):
        load_pictures(tmp_path / "other.npz")
