"""The network of features: it learns what cars are, and its file gives the same features back."""

from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.paper.families import CARS, TAN_HALF_FOV, view_set
from benchmarks.rivals.features import Features, FeatureSizes, Options, features_of, labels, load_features, loss, train
from benchmarks.rivals.model import save_rival
from benchmarks.rivals.picture_set import PictureSet

SIZES = FeatureSizes(channels=(8, 8), features=8)


@pytest.fixture(scope="module")
def cars() -> PictureSet:
    seen = view_set(CARS, range(4), 3, 16)
    arrays = (seen.rgb, seen.range.astype(np.float16), seen.T_object_camera)
    return PictureSet(*arrays, np.asarray(TAN_HALF_FOV, np.float32), np.arange(4), np.asarray("cars"))


def test_labels_are_of_the_car_and_the_view(cars: PictureSet) -> None:
    style, numbers = labels(cars)
    assert style.shape == (4,) and numbers.shape == (4, 3, 6)
    towards = cars.T_object_camera[..., :3, 3] - np.asarray(CARS.middle)
    np.testing.assert_allclose(numbers[..., :3], towards / CARS.distance, atol=1e-5)
    np.testing.assert_array_equal(numbers[:, 0, 3:], numbers[:, 1, 3:])


@pytest.mark.nightly
def test_it_learns_and_its_file_gives_the_same_features(cars: PictureSet, tmp_path: Path) -> None:
    style, numbers = labels(cars)
    losses, figures = [], {}
    for steps in (1, 60):
        figures = train(Options(tmp_path, tmp_path / f"{steps}.safetensors", steps), cars, SIZES)
        model, story = load_features(tmp_path / f"{steps}.safetensors")
        losses.append(float(loss(model, cars.rgb[:3, 0], style[:3], numbers[:3, 0])[0]))
    assert losses[1] < 0.7 * losses[0]
    assert story["objects"] == 3 and story["squared_new"] == figures["squared_new"]
    found = np.asarray(features_of(model, cars.rgb[:, 0] / 255.0))
    assert found.shape == (4, SIZES.features) and found.std(axis=0).min() > 0.0


def test_another_file_is_refused(tmp_path: Path) -> None:
    save_rival(tmp_path / "other.safetensors", "functa", Features(SIZES, jax.random.key(0)), {})
    with pytest.raises(ValueError, match=r"other.safetensors is not a readable rival \(it holds 'functa'"):
        load_features(tmp_path / "other.safetensors")
