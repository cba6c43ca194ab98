"""A mesh as a region: what it fills is asked, whole, and a file that is none is named."""

import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from perception.answers.query import query
from perception.answers.regions import Box, Cells, Points, Swept, moved, read_mesh, read_points
from tests.perception.answers.test_query import LEFT, RIGHT, VOXEL, _swept, mug

__all__ = ["mug"]  # the fixture


def _saved(path: Path, mesh: trimesh.Trimesh) -> Path:
    mesh.export(path)
    return path


def _box(low: tuple[float, ...], high: tuple[float, ...], margin: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=np.array([np.add(low, margin), np.subtract(high, margin)]))


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "glb"])
def test_a_mesh_answers_as_the_box_it_is(mug, tmp_path: Path, kind: str) -> None:
    width = 0.25 * VOXEL
    mesh = _box(*LEFT, margin=0.5 * width)  # cells that the surface meets count whole
    found = query([mug], read_mesh(_saved(tmp_path / f"grasp.{kind}", mesh), width), "object")
    same = query([mug], _swept(LEFT), "object")
    assert found.p_free == same.p_free == pytest.approx(0.7)
    assert found.volume_m3["q95"] == pytest.approx(same.volume_m3["q95"], rel=0.15)
    assert found.unseen_fraction == pytest.approx(same.unseen_fraction, abs=0.05) and found.outside_fraction == 0.0


def test_a_mesh_is_filled_and_says_which_hypotheses_are_in_its_way(mug, tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(radius=0.05)
    ball.apply_translation([-0.07, 0.0, 0.0])  # about the right handle's place, whose surface no handle meets
    found = query([mug], read_mesh(_saved(tmp_path / "ball.obj", ball), 0.5 * VOXEL), "object")
    assert found.blocked_by == {1: [0, 1]}  # the body, too
    handle = trimesh.creation.icosphere(radius=0.015)
    handle.apply_translation([-0.07, 0.0, 0.0])
    cells = read_mesh(_saved(tmp_path / "small.stl", handle), 0.5 * VOXEL)
    found = query([mug], cells, "object")
    assert found.p_free == pytest.approx(0.3) and found.blocked_by == {1: [1]}
    volume = len(cells.centres) * cells.width**3
    assert 1.0 < volume / (4 / 3 * np.pi * 0.015**3) < 2.5
    nothing = query([mug], _swept(((0.0, 0.1, 0.0), (0.02, 0.12, 0.02))), "object")
    assert nothing.p_free == 1.0 and nothing.blocked_by == {}


def test_cells_wider_than_voxels_miss_none(mug) -> None:
    middle = 0.5 * np.add(*RIGHT)
    wide = Cells(middle[None], 3.0 * VOXEL)
    box = Swept(np.eye(4)[None] + np.pad(middle[None, :, None], ((0, 0), (0, 1), (3, 0))), np.full((1, 3), 3 * VOXEL))
    assert query([mug], wide, "object").volume_m3 == pytest.approx(query([mug], box, "object").volume_m3)


def test_a_moved_region_answers_in_its_frame_as_before(mug) -> None:
    """And a box so large that no sample of it falls into the cube is known still: it has the mug in it."""
    T = np.linalg.inv(mug.object_frame.T_camera_object)  # p_object = T @ p_camera
    box = Box((-0.1, -0.1, 0.4), (0.1, 0.02, 0.55))
    points = Points(np.random.default_rng(0).uniform(box.low, box.high, (40, 3)))
    for region in (box, points, moved(box, np.eye(4))):
        before, after = query([mug], region, "camera", now_ns=0), query([mug], moved(region, T), "object", now_ns=0)
        assert before.p_free == after.p_free and before.p_occupied == pytest.approx(after.p_occupied, abs=1e-9)
        assert before.unseen_fraction == pytest.approx(after.unseen_fraction, abs=0.02)
    wide = query([mug], moved(Box((-9, -9, -9), (9, 9, 9)), np.eye(4)), "camera", now_ns=0)
    assert wide.p_free == 0.0 and wide.outside_fraction < 1.0 and wide.verdict() == "unsure"  # of two hypotheses


def test_what_is_no_mesh_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"absent\.obj: no such file"):
        read_mesh(tmp_path / "absent.obj", 0.01)
    (tmp_path / "cut.glb").write_bytes(b"glTF")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\n")
    (tmp_path / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n")
    (tmp_path / "words.txt").write_text("no mesh")
    for name, complaint in {
        "cut.glb": "cannot be read as a mesh",
        "points.obj": "holds no triangles",
        "nan.obj": r"vertex 1 is \[nan, 0.0, 0.0\]",
        "words.txt": "no mesh by its name",
    }.items():
        with pytest.raises(ValueError, match=complaint):
            read_mesh(tmp_path / name, 0.01)
    whole = _box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))  # one vertex that is none would not be missed, but for this
    lines = _saved(tmp_path / "box.obj", whole).read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("v "))
    (tmp_path / "part.obj").write_text("\n".join([*lines[:at], "v nan nan nan", *lines[at + 1 :]]))
    with pytest.raises(ValueError, match="vertex 1 is"):
        read_mesh(tmp_path / "part.obj", 0.01)
    with pytest.raises(ValueError, match="is it in metres"):
        read_mesh(_saved(tmp_path / "mm.stl", trimesh.creation.box((300.0, 300.0, 300.0))), 0.0025)
    with pytest.raises(ValueError, match="more than 0"):
        Cells(np.zeros((1, 3)), 0.0)


def test_points_are_read_and_bad_lines_named(tmp_path):
    path = tmp_path / "grasp.xyz"
    path.write_text("# x y z\n0.1 -2 3e-1\n\n1 2 3 255 0 0  # with colour\n")
    np.testing.assert_allclose(read_points(path).points, [[0.1, -2, 0.3], [1, 2, 3]])
    cases = {
        "1 2\n": "line 1: '1 2' is not a point",
        "1 2 3\nx y z\n": "line 2: 'x y z' is not a point",
        "# a\n\n1 2 3\n# b\n4 5\n6 7 8\n": "line 5: '4 5' is not a point",
        "# a\n1 2 3\n1 -inf 2\n": "line 3: '1 -inf 2' is not finite",
        "1 2 nan\n": "line 1: '1 2 nan' is not finite",
        "# nothing\n": "holds no points",
        "": "holds no points",
    }
    for text, message in cases.items():
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_points(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="not a text file"):
        read_points(path)
    with pytest.raises(FileNotFoundError, match=r"absent\.xyz: no such file"):
        read_points(tmp_path / "absent.xyz")


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("long.obj", "v 0 0 0\nv 40000 0 0\nv 0 0.001 0\nf 1 2 3\n", "too large|too many cells"),
        ("many.obj", "v 0 0 0\nv .2 0 0\nv 0 .2 0\n" + "f 1 2 3\n" * 100_000, "100000 triangles"),
        ("a.zip", "PK", "no mesh by its name"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -3\n", "vertex -3|cannot be read|no triangles"),
    ],
)
def test_a_mesh_that_takes_too_long_or_is_none_is_named(tmp_path: Path, name: str, text: str, why: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=why) as caught:
        read_mesh(tmp_path / name, 0.004)
    assert name in str(caught.value)


def test_a_mesh_meets_every_cell_that_its_surface_crosses_and_no_far_one(tmp_path: Path) -> None:
    rng, width = np.random.default_rng(0), 0.004
    soup = trimesh.Trimesh(rng.uniform(-0.05, 0.05, (60, 3)), np.arange(60).reshape(20, 3), process=False)
    cells = np.rint(read_mesh(_saved(tmp_path / "soup.ply", soup), width).centres / width).astype(int)
    met = {tuple(cell) for cell in cells}
    points, _ = trimesh.sample.sample_surface(soup, 200_000, seed=0)
    inner = points[(np.abs(points / width - np.rint(points / width)) < 0.25).all(axis=1)]  # far from a cell's faces
    assert len(inner) > 10_000 and {tuple(cell) for cell in np.rint(inner / width).astype(int)} <= met
    distance = trimesh.proximity.ProximityQuery(soup).on_surface(width * cells[::17])[1]
    assert (distance <= 0.5 * np.sqrt(3.0) * width + 1e-6).mean() > 0.99  # of the others, the soup encloses them


def test_a_large_tray_is_filled_in_seconds(tmp_path: Path) -> None:
    """0.8 m, of few and long triangles."""
    outer, inner = trimesh.creation.box((0.8, 0.8, 0.05)), trimesh.creation.box((0.792, 0.792, 0.05))
    inner.apply_translation((0.0, 0.0, 0.004))
    inner.invert()
    path = _saved(tmp_path / "tray.stl", trimesh.util.concatenate([outer, inner]))
    begun = time.monotonic()
    cells = read_mesh(path, 0.002)
    assert time.monotonic() - begun < 20.0
    assert len(cells.centres) > 400 * 400
