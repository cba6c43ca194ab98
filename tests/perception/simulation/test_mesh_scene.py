"""The mesh camera sees what geometry says, and a window of a picture is that part of the whole."""

import sys

import numpy as np
import pytest
import trimesh

from calibration.camera import Camera
from perception.simulation.mesh_scene import (
    Light,
    MeshScene,
    MeshShape,
    PlacedMesh,
    render_meshes,
    window_about,
    windowed,
)
from perception.simulation.ray_caster import RayCaster
from perception.simulation.simulated_camera import TableScene, place_camera, render
from probnerf.types import BASE_Z

pytest.importorskip("embreex")
CAMERA = Camera(160, 120, np.array([[150.0, 0, 80.3], [0, 151.0, 59.1], [0, 0, 1]]), np.array([0.05, -0.1, 0, 0, 0.0]))
T_WORLD_CAMERA = place_camera((0.4, 0.1, 0.3), (0.0, 0.0, 0.03))


def standing(mesh: trimesh.Trimesh, half_extent: float, **looks: object) -> MeshShape:
    """A mesh in cube units, lifted onto the resting plane."""
    vertices = np.asarray(mesh.vertices) + np.array([0.0, 0.0, BASE_Z - mesh.bounds[0, 2]])
    return MeshShape(vertices, np.asarray(mesh.faces), half_extent, **{"paint": (0.7, 0.2, 0.1), **looks})


BALL = standing(trimesh.creation.icosphere(subdivisions=5, radius=0.7), 0.05)
BOX = standing(trimesh.creation.box((1.0, 0.6, 1.4)), 0.08, gloss=0.5)
SCENE = MeshScene((PlacedMesh(BALL, 0.03, 0.06, 0.3), PlacedMesh(BOX, -0.06, -0.06, 1.1)))


def world_points(depth: np.ndarray, camera: Camera, T: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    return (rays / rays[:, 2:] * depth.reshape(-1, 1)) @ T[:3, :3].T + T[:3, 3]


def test_depth_and_label_are_those_of_geometry() -> None:
    picture = render_meshes(SCENE, CAMERA, T_WORLD_CAMERA)
    points, label = world_points(picture.depth, CAMERA, T_WORLD_CAMERA), picture.label.ravel()
    assert set(label) == {0, 1, 2}
    on_ball = np.linalg.norm(points[label == 1] - [0.03, 0.06, 0.035], axis=1)
    assert np.abs(on_ball - 0.035).max() < 1e-4  # facets
    in_box = SCENE.objects[1].to_cube(points[label == 2]) / [0.5, 0.3, 0.7] - [0, 0, (BASE_Z + 0.7) / 0.7]
    assert np.abs(np.abs(in_box).max(axis=1) - 1.0).max() < 1e-4
    assert (np.abs(points[label == 0, 2]) < 1e-6).mean() > 0.5
    assert (picture.nearest <= picture.depth).all() and (picture.depth <= picture.farthest).all()
    assert np.array_equal(picture.gloss, np.array([0.0, 0.0, 0.5])[picture.label])


def test_surroundings_are_those_of_the_family_s_camera() -> None:
    empty = render(TableScene(()), CAMERA, T_WORLD_CAMERA)
    picture = render_meshes(MeshScene((PlacedMesh(BALL),), light=Light(ambient=1.0)), CAMERA, T_WORLD_CAMERA)
    calm = (picture.label == 0) & (picture.depth == empty.depth)
    assert calm.mean() > 0.8 and np.allclose(picture.depth[calm], empty.depth[calm])
    edge = np.abs(picture.rgb - empty.rgb).max(axis=-1) > 1e-9
    assert edge[picture.label == 0].mean() < 0.02


def test_windows_are_parts_of_the_picture() -> None:
    whole = render_meshes(SCENE, CAMERA, T_WORLD_CAMERA)
    window = window_about(SCENE.objects[0], CAMERA, T_WORLD_CAMERA)
    assert window.width < CAMERA.width and (whole.label == 1).sum() > 100
    part = render_meshes(SCENE, windowed(CAMERA, window), T_WORLD_CAMERA)
    inside = np.s_[window.top : window.top + window.height, window.left : window.left + window.width]
    assert (part.label == 1).sum() == (whole.label == 1).sum()  # all of the ball
    assert np.allclose(part.depth, whole.depth[inside], atol=1e-6) and np.allclose(
        part.rgb, whole.rgb[inside], atol=0.02
    )
    with pytest.raises(ValueError, match="outside the picture"):
        window_about(PlacedMesh(BALL, 0.0, 5.0), CAMERA, T_WORLD_CAMERA)


def test_paint_is_asked_in_the_canonical_cube() -> None:
    """By points or by faces, whatever the pose, and light only darkens it."""
    asked = []

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        asked.append((points, normals))
        return np.where(points[:, :1] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])

    faces = np.asarray(trimesh.creation.box().faces)
    ball = MeshShape(BALL.vertices, BALL.faces, BALL.half_extent, paint)
    box = MeshShape(BOX.vertices, BOX.faces, BOX.half_extent, np.full((len(faces), 3), 0.25))
    scene = MeshScene((PlacedMesh(ball, 0.03, 0.06, 0.3), PlacedMesh(box, -0.06, -0.06, 1.1)), light=Light(ambient=1.0))
    picture = render_meshes(scene, CAMERA, T_WORLD_CAMERA)
    points, normals = (np.concatenate(a) for a in zip(*asked, strict=True))
    middle = np.array([0.0, 0.0, BASE_Z + 0.7])
    assert np.abs(np.einsum("ni,ni->n", points - middle, normals) - 0.7).max() < 0.01
    inner = (picture.label == 2) & (picture.farthest - picture.nearest < 0.005)
    assert np.median(picture.rgb[inner]) == pytest.approx(0.25)
    dim = render_meshes(MeshScene(scene.objects, light=Light(ambient=0.4)), CAMERA, T_WORLD_CAMERA)
    assert (dim.rgb <= picture.rgb + 1e-9).all() and (dim.rgb < picture.rgb - 0.05).any()


def test_shadows_lie_away_from_the_lamp() -> None:
    caster = RayCaster([(np.asarray(trimesh.creation.box((0.1, 0.1, 0.1)).vertices), trimesh.creation.box().faces)])
    up = np.array([0.0, 0.0, 1.0])
    table = np.array([[-0.12, 0.0, -0.05], [0.12, 0.0, -0.05]])
    assert caster.shaded(table, up, np.array([0.8, 0.0, 0.6])).tolist() == [True, False]


def test_missing_embree_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(ImportError, match=r"farside\[meshes\]"):
        RayCaster([(BALL.vertices, BALL.faces)])


def test_meshes_without_a_surface_are_refused() -> None:
    with pytest.raises(ValueError, match="mesh 0 has 0 faces"):
        RayCaster([(np.zeros((0, 3)), np.zeros((0, 3), int))])
    with pytest.raises(ValueError, match="finite"):
        RayCaster([(np.full((3, 3), np.nan), np.array([[0, 1, 2]]))])
