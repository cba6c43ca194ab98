"""Other people's cars: upright, the right size, the front ahead, in the colours of their textures."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.road_meshes import MODELS, RUBBER, read_road_mesh
from probnerf.types import BASE_Z, BODY_EXTENT

BOX = """mtllib box.mtl
v -1 -4 0
v 1 -4 0
v 1 4 0
v -1 4 0
v -1 -4 3
v 1 -4 3
vt 0.25 0.5
vt 0.75 0.5
usemtl Painted
f 1/1 2/1 3/1
f 1/1 3/1 4/1
usemtl Wheels
f 1/1 2/1 6/1
f 1/1 6/1 5/1
"""


def test_a_model_is_placed_as_the_family_is(tmp_path: Path) -> None:
    folder = tmp_path / "box" / "meshes"
    folder.mkdir(parents=True)
    (folder / "box.obj").write_text(BOX)
    (folder / "box.mtl").write_text("newmtl Painted\nKd 1 0 0\nnewmtl Wheels\nmap_Kd model://none/textures/no.png\n")
    car = read_road_mesh(tmp_path, "box")
    low, high = car.mesh.vertices.min(axis=0), car.mesh.vertices.max(axis=0)
    np.testing.assert_allclose(high - low, np.array([8, 2, 3]) * BODY_EXTENT / 8, rtol=1e-6)
    np.testing.assert_allclose([low[0], low[2]], [-0.5 * BODY_EXTENT, BASE_Z], atol=1e-6)
    tall = car.mesh.vertices[car.mesh.vertices[:, 2] > BASE_Z + 0.1]
    np.testing.assert_allclose(tall[:, 0], 0.5 * BODY_EXTENT, rtol=1e-6)  # the file's -y is ahead
    np.testing.assert_array_equal(car.colours[-1], np.round(255 * np.array(RUBBER)).astype(int))
    lit = car.rgb(car.points[:5], np.tile([0.0, 0.0, 1.0], (5, 1)))
    assert lit.shape == (5, 3) and lit.max() <= 1.0


def test_a_folder_without_a_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"van.meshes holds no .obj; give a folder of Gazebo's models"):
        read_road_mesh(tmp_path, "van")


def test_gazebo_s_hatchbacks_differ_in_paint_alone(shared_data: Path) -> None:
    cars = {name: read_road_mesh(shared_data / "meshes" / "gazebo", name) for name in MODELS[:3]}
    assert len({car.mesh.vertices.tobytes() for car in cars.values()}) == 1
    tints = {name: car.colours.mean(axis=0) for name, car in cars.items()}
    assert tints["hatchback_blue"].argmax() == 2 and tints["hatchback_red"].argmax() == 0
