"""Laws of mesh objects: exact distances, a canonical frame that does not depend on the file's, and honest refusals."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from probnerf.objects.mesh import WALL, canonical, read_folder, resting_poses, rests
from probnerf.types import BASE_Z, BODY_EXTENT


def box(*sides: float) -> trimesh.Trimesh:
    return trimesh.creation.box(sides)


def spoon() -> trimesh.Trimesh:
    """A ball with a rod: no symmetry between its ends."""
    rod = trimesh.creation.box((0.12, 0.01, 0.01))
    rod.apply_translation([0.09, 0.0, 0.0])
    return together(trimesh.creation.icosphere(3, 0.04), rod)


def together(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """One mesh of several."""
    joined = trimesh.util.concatenate(list(parts))
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def test_the_cube_holds_a_box_as_it_stands() -> None:
    thing = canonical(*_parts(box(0.2, 0.1, 0.05)))
    low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
    np.testing.assert_allclose(high - low, BODY_EXTENT * np.array([1.0, 0.5, 0.25]), atol=1e-9)
    np.testing.assert_allclose([*(low + high)[:2], low[2]], [0.0, 0.0, BASE_Z], atol=1e-9)
    assert thing.half_extent == pytest.approx(0.2 / BODY_EXTENT)


def test_distances_of_a_box_are_exact() -> None:
    thing = canonical(*_parts(box(0.2, 0.1, 0.05)))
    half = 0.5 * BODY_EXTENT * np.array([1.0, 0.5, 0.25])
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    q = np.abs(points - [0.0, 0.0, BASE_Z + half[2]]) - half
    exact = np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)
    np.testing.assert_allclose(thing.signed_distance(points), exact, atol=1e-6)


def test_overlapping_parts_are_solid_throughout() -> None:
    """Where two closed parts overlap a ray crosses an even number of faces, and the winding number is 2."""
    thing = canonical(*_parts(together(box(0.1, 0.1, 0.1), box(0.06, 0.06, 0.06))))
    assert thing.signed_distance(np.array([[0.0, 0.0, BASE_Z + 0.5 * BODY_EXTENT]]))[0] < 0.0


@pytest.mark.parametrize("angle", [0.4, 2.0, -1.3])
def test_the_canonical_frame_forgets_how_a_mesh_was_turned(angle: float) -> None:
    turned = spoon()
    turned.apply_transform(trimesh.transformations.rotation_matrix(angle, [0, 0, 1], [0.3, -0.2, 0.0]))
    np.testing.assert_allclose(canonical(*_parts(turned)).vertices, canonical(*_parts(spoon())).vertices, atol=1e-6)
    x = canonical(*_parts(spoon())).vertices[:, 0]
    assert np.isclose(x.max(), 0.5 * BODY_EXTENT)
    assert np.median(x) < 0.0  # the rod, a longer and lighter tail, points along +x


def test_an_open_sheet_gets_a_wall() -> None:
    sheet = trimesh.Trimesh([[0, 0, 0], [0.2, 0, 0], [0.2, 0, 0.1], [0, 0, 0.1]], [[0, 1, 2], [0, 2, 3]])
    thing = canonical(*_parts(sheet))
    middle = thing.vertices.mean(axis=0)
    offsets = np.array([0.0, 0.4, -0.4, 0.6, -0.6])[:, None] * WALL * np.array([0.0, 1.0, 0.0])
    assert list(thing.signed_distance(middle + offsets) < 0.0) == [True, True, True, False, False]


def test_surface_points_lie_on_the_surface_and_favour_what_is_thin() -> None:
    thing = canonical(*_parts(spoon()))
    points, normals = thing.surface(np.random.default_rng(0), 2000)
    assert np.abs(thing.signed_distance(points)).max() < 0.5 * WALL + 1e-6
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    rod = thing.areas[thing.vertices[thing.faces].mean(axis=1)[:, 0] > 0.0].sum() / thing.areas.sum()
    assert np.mean(points[:, 0] > 0.0) > 1.2 * rod


def test_things_rest_on_what_lets_them_stand() -> None:
    transforms, shares = resting_poses(box(0.2, 0.1, 0.05))
    assert shares.sum() == pytest.approx(1.0)
    lowest = box(0.2, 0.1, 0.05).apply_transform(transforms[np.argmax(shares)])
    assert lowest.extents[2] == pytest.approx(0.05)
    for seed in range(4):
        mesh = rests(spoon(), np.random.default_rng(seed), 0.0, 0.1)
        assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)


def test_an_open_shell_ends_its_search_for_a_resting_pose() -> None:
    """Its centre of mass may lie outside its hull, where trimesh would look for another one for ever."""
    shell = box(0.1, 0.1, 0.1)
    shell.update_faces(np.arange(12) > 3)
    assert len(resting_poses(shell)[0])


def test_a_folder_tells_what_is_left_out_and_why(tmp_path: Path) -> None:
    box(0.1, 0.1, 0.1).export(tmp_path / "good.ply")
    box(100.0, 80.0, 90.0).export(tmp_path / "huge.ply")
    box(0.2, 0.1, 0.0001).export(tmp_path / "flat.ply")
    (tmp_path / "broken.glb").write_bytes(b"glTF\x02\x00")
    (tmp_path / "empty.obj").write_text("")
    (tmp_path / "notes.txt").write_text("no mesh")
    found = dict(read_folder(tmp_path))
    assert isinstance(found.pop("good"), trimesh.Trimesh)
    assert "100 m" in str(found["huge"])
    assert "flat" in str(found["flat"])
    assert set(found) == {"huge", "flat", "broken", "empty"}
    assert all(isinstance(reason, str) and reason for reason in found.values())
    (tmp_path / "nothing").mkdir()
    with pytest.raises(FileNotFoundError, match="no meshes"):
        list(read_folder(tmp_path / "nothing"))


def _parts(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
