"""The real frame's measures: normals, boxes and free points are what they are called."""

import numpy as np
from scipy.spatial import Delaunay

from benchmarks.measures.real_objects import free_points, hidden_surface, is_hidden, near_points, outward_normals
from benchmarks.scenes.real_frames import DATA, FRAMES, TrueObject, read_truth
from perception.observation.segmentation import segment
from perception.observation.support_plane import heights
from perception.sources.frame_folder import read_frame_folder


def test_normals_of_a_sphere_point_outwards():
    rng = np.random.default_rng(2)
    points = rng.standard_normal((2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normals = outward_normals(0.05 * points + [0.1, 0.2, 0.7])
    assert (np.einsum("ni,ni->n", normals, points) > 0.97).mean() > 0.99


def test_a_box_turns_with_its_object():
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [1.0, 0.0, 0.0]
    model = TrueObject(np.array([[0.0, 0, 0], [0.3, 0.1, 0.1]]), T)
    inside = model.box_holds(np.array([[0.95, 0.25, 0.05], [1.25, 0.05, 0.05]]), 0.01)
    assert inside.tolist() == [True, False]


def test_free_points_of_the_real_frame_are_free_and_unseen(shared_data):
    folder = DATA / "ycbv_000002"
    frame, truth = read_frame_folder(folder), read_truth(folder)
    plane = segment(frame, 1)[0].plane
    points = free_points(frame, plane, truth, 1)
    assert len(points) > 500 and set(truth) == set(FRAMES["ycbv 000002"].things)
    assert (heights(points, plane) > 0).all() and is_hidden(frame, points).all()
    for other in truth.values():
        assert not other.box_holds(points, 0.0).any()
        assert np.linalg.norm(points[::50, None] - other.in_camera[None], axis=-1).min() >= 0.015


def test_points_near_the_hidden_surface_are_outside_of_it(shared_data):
    folder = DATA / "ycbv_000002"
    frame, truth = read_frame_folder(folder), read_truth(folder)
    plane, surface = segment(frame, 1)[0].plane, truth[1].in_camera
    near = near_points(frame, plane, truth, 1)
    gap = np.linalg.norm(near[::20, None] - surface[None], axis=-1).min(axis=1)
    assert len(near) > 100 and gap.min() > 0.003 and gap.max() < 0.016
    assert (Delaunay(surface).find_simplex(near) < 0).mean() > 0.97  # a can is convex
    above, in_table = hidden_surface(frame, plane, truth[1])
    assert is_hidden(frame, np.concatenate([above, in_table])).all()
    assert heights(above, plane).min() > 0 > heights(in_table, plane).max()
