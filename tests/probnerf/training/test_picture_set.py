"""What training does to pictures: occluders hide what they should, a known pose is one, held-out objects stay out."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.training.picture_set import PictureSet, changed, occluders, split
from probnerf.training.settings import PosteriorTrainConfig
from probnerf.types import Pose
from tests.probnerf.prior.small_networks import SIGMA, picture

PLAIN = PosteriorTrainConfig(without_depth=0.0, known_pose=0.0, occluded=0.0)
COUNT = 40


@pytest.fixture(scope="module")
def pictures() -> PictureSet:
    rng, one = np.random.default_rng(0), picture()

    def repeated(a, dtype=np.float32) -> np.ndarray:
        return np.stack([np.asarray(a)] * COUNT).astype(dtype)

    return PictureSet(
        rgb=repeated(255 * one.rgb, np.uint8),
        distance=repeated(one.distance, np.float16),
        unknown=repeated(one.unknown, np.uint8),
        T_view_camera=repeated(one.T_view_camera),
        tan_half_fov=repeated(one.tan_half_fov),
        pose_sigma=repeated(SIGMA),
        yaw=rng.uniform(-3.0, 3.0, COUNT).astype(np.float32),
        pose=rng.normal(size=(COUNT, 4)).astype(np.float32),
        mean=rng.normal(size=(COUNT, 3)).astype(np.float32),
        sd=np.zeros((COUNT, 3), np.float32),
        object_id=np.arange(COUNT) // 2,
        kind=np.arange(COUNT, dtype=np.uint8) % 3,
    )


def test_occluders_hide_their_share_of_the_object():
    rng = np.random.default_rng(0)
    seen = rng.uniform(size=(60, 24, 24)) < 0.4
    share = rng.uniform(0.1, 0.8, 60)
    share[:5] = 0.0
    hidden = occluders(rng, seen, share)
    np.testing.assert_allclose((hidden & seen).sum((1, 2)) / seen.sum((1, 2)), share, atol=0.02)
    assert not hidden[:5].any() and (hidden & ~seen)[5:].any((1, 2)).all()


def test_a_picture_without_changes_is_as_it_was(pictures: PictureSet):
    examples = changed(pictures, np.arange(COUNT), np.random.default_rng(0), PLAIN)
    np.testing.assert_array_equal(examples.picture.distance, pictures.distance)
    np.testing.assert_array_equal(examples.picture.unknown, pictures.unknown)
    np.testing.assert_array_equal(examples.yaw, pictures.yaw)
    np.testing.assert_array_equal(examples.pose, pictures.pose[:, :3])
    assert not examples.known.any()


def test_without_depth_only_ranges_go(pictures: PictureSet):
    config = replace(PLAIN, without_depth=1.0)
    distance = changed(pictures, np.arange(COUNT), np.random.default_rng(0), config).picture.distance
    np.testing.assert_array_equal(distance, np.where(pictures.distance != 0, -1.0, 0.0))


def test_at_a_known_pose_each_seen_point_is_in_the_object_s_frame(pictures: PictureSet):
    examples = changed(pictures, np.arange(COUNT), np.random.default_rng(0), replace(PLAIN, known_pose=1.0))
    assert examples.known.all() and not examples.yaw.any() and not examples.pose.any()
    for i in range(3):
        x, y, log_scale, z = pictures.pose[i] * SIGMA[[0, 1, 2, 4]]
        pose = Pose(*(jnp.asarray(v) for v in (pictures.yaw[i], x, y, log_scale, z)))
        ray = np.array([0.1, -0.2, 1.0]) / np.sqrt(1.05)
        T, known = pictures.T_view_camera[i], examples.picture.T_view_camera[i]
        point = T[:3, :3] @ ray * float(pictures.distance[i].max()) + T[:3, 3]
        found = known[:3, :3] @ ray * float(examples.picture.distance[i].max()) + known[:3, 3]
        np.testing.assert_allclose(found, pose.to_object(jnp.asarray(point, jnp.float32)), atol=4e-3)  # half precision


def test_held_out_objects_are_never_trained_on(pictures: PictureSet):
    rows, held = split(pictures, replace(PLAIN, validation=0.3))
    assert len(held) == 12 and len(rows) == 28
    assert not set(pictures.object_id[rows]) & set(pictures.object_id[held])


def test_a_set_survives_its_files(pictures: PictureSet, tmp_path: Path):
    pictures.save(tmp_path)
    found = PictureSet.load(tmp_path)
    np.testing.assert_array_equal(found.rgb, pictures.rgb)
    assert found.distance.dtype == np.float16 and len(found) == COUNT
    (tmp_path / "yaw.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"yaw\.npy: no such array of a picture set"):
        PictureSet.load(tmp_path)
    with pytest.raises(ValueError, match="arrays have different lengths"):
        replace(pictures, yaw=pictures.yaw[1:])


def test_a_share_is_between_0_and_1():
    with pytest.raises(ValueError, match=r"occluded is 1\.5; it must be between 0 and 1"):
        PosteriorTrainConfig(occluded=1.5)
    with pytest.raises(ValueError, match=r"average is 1\.0"):
        PosteriorTrainConfig(average=1.0)
