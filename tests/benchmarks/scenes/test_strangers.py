"""Strangers on a plane: what the independent ray caster sees, and what is solid, is what stands there."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.scenes.strangers import (
    BULLET,
    FILES,
    GSO,
    Stranger,
    StrangerConfig,
    files,
    hidden_points,
    household_files,
    solid_at,
    stranger,
)
from probnerf.objects.tabletop import VALIDATION_SEEDS

SIDES = np.array([0.08, 0.12, 0.2])
SMALL = StrangerConfig(width=320, height=240, focal=300.0)


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Stranger:
    path = tmp_path_factory.mktemp("meshes") / "box.ply"
    trimesh.creation.box(SIDES).export(path)
    return stranger(path, SMALL)


def in_world(scene: Stranger, points: np.ndarray) -> np.ndarray:
    return points @ scene.T_world_camera[:3, :3].T + scene.T_world_camera[:3, 3]


def in_box(scene: Stranger, points: np.ndarray) -> np.ndarray:
    """Distances of world points from the box's six sides, inside positive."""
    normals, at = scene.mesh.face_normals, scene.mesh.triangles[:, 0]
    return np.min(np.sum((at - points[:, None]) * normals, axis=-1), axis=1)


def test_a_box_rests_on_a_side_and_is_seen_where_it_stands(box: Stranger) -> None:
    assert box.mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert np.abs(SIDES - box.mesh.bounds[1, 2]).min() < 1e-5
    mask = box.frame.label == 1
    v, u = np.nonzero(mask)
    rays = box.frame.camera.rays(np.column_stack([u, v]))
    points = in_world(box, rays / rays[:, 2:] * box.depth[mask][:, None])
    assert np.abs(in_box(box, points)).max() < 1e-4
    v, u = np.nonzero(~mask & (box.depth < 2.0))
    rays = box.frame.camera.rays(np.column_stack([u, v]))
    assert np.abs(in_world(box, rays / rays[:, 2:] * box.depth[v, u][:, None])[:, 2]).max() < 1e-6
    distance = np.linalg.norm(box.T_world_camera[:3, 3] - box.mesh.bounds.mean(axis=0))
    assert 0.45 <= distance <= 0.8
    up = (box.T_world_camera[2, 3] - box.mesh.bounds[:, 2].mean()) / distance
    assert np.sin(np.deg2rad(25)) <= up <= np.sin(np.deg2rad(60))


def test_depth_has_the_stated_noise_and_none_at_the_outline(box: Stranger) -> None:
    config, measured = SMALL, np.isfinite(box.frame.depth)
    error = (box.frame.depth - box.depth)[measured] / (config.noise + config.noise_z2 * box.depth[measured] ** 2)
    assert abs(error.mean()) < 0.01 and error.std() == pytest.approx(1.0, abs=0.01)
    step = np.abs(np.diff(box.depth, axis=1)) > 0.02
    step &= box.depth[:, 1:] < 2.0
    assert step.any() and not (measured[:, 1:] & measured[:, :-1] & step).any()
    assert measured[box.depth < 3.0].mean() > 0.95  # a slanted table is no edge


def test_points_are_hidden_and_their_truth_is_the_boxes(box: Stranger) -> None:
    points, occupied = hidden_points(box)
    world = in_world(box, points)
    inside = in_box(box, world)
    assert len(points) > 500 and np.array_equal(occupied, inside > 0) and 0.2 < occupied.mean() < 0.9
    assert world[:, 2].min() > 0.0
    assert np.all(world > box.mesh.bounds[0] - 0.03) and np.all(world < box.mesh.bounds[1] + 0.03)
    u, v = np.rint(box.frame.camera.project(points)).astype(int).T
    assert np.mean(points[:, 2] > box.depth[v, u] + 0.004) > 0.97  # of the pixel's centre


def test_parts_that_overlap_are_solid_where_parity_says_free() -> None:
    one, other = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.1, 0.1, 0.1))
    other.apply_translation([0.05, 0.0, 0.0])
    both = trimesh.util.concatenate([one, other])
    assert solid_at(both, np.array([[0.025, 0.0, 0.0], [-0.04, 0.0, 0.0], [0.2, 0.0, 0.0]])).tolist() == [1, 1, 0]


def test_a_scene_is_made_again_the_same_and_sizes_are_plausible(box: Stranger, tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box(SIDES).export(path)
    again = stranger(path, SMALL)
    assert np.array_equal(again.frame.rgb, box.frame.rgb)
    assert np.array_equal(again.frame.depth, box.frame.depth, equal_nan=True)
    trimesh.creation.box(100.0 * SIDES).export(path)
    longest = np.max(np.linalg.norm(np.diff(stranger(path, SMALL).mesh.triangles, axis=1), axis=-1))
    assert 0.08 < longest < 0.25  # of the faces' edges, diagonals among them


def test_files_without_triangles_and_missing_data_are_named(tmp_path: Path) -> None:
    path = tmp_path / "points.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\n")
    with pytest.raises(ValueError, match=r"points\.obj holds no triangles"):
        stranger(path)
    with pytest.raises(FileNotFoundError, match="--data"):
        files(GSO, tmp_path)


def test_the_sets_are_whole(shared_data: Path) -> None:
    assert {condition: len(files(condition)) for condition in FILES} == {GSO: 27, BULLET: 61}


def test_the_generators_validation_objects_are_written_to_be_read_as_any_mesh(tmp_path: Path) -> None:
    paths = household_files(2, tmp_path / "here")
    assert all(trimesh.load_mesh(path).is_watertight or len(trimesh.load_mesh(path).faces) for path in paths)
    assert [path.stem.rsplit("_", 1)[1] for path in paths] == [str(seed) for seed in VALIDATION_SEEDS[:2]]
