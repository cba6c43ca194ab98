"""Frames compose: a way there and back is no way, and two steps are the product of their transforms."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from node.ros.messages import matrix, pose
from node.ros.scene_messages import transforms_message
from perception.answers.hypotheses import Hypotheses
from perception.observation.rays import ObjectFrame
from tests.properties.drawn import hypotheses, law, object_frames, poses, scenes, vectors

points = st.lists(vectors(3, 1.0), min_size=1, max_size=4).map(np.stack)
ROUNDING = 1e-9


def moved(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    return p @ T[:3, :3].T + T[:3, 3]


def close(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(a, b, atol=ROUNDING, rtol=ROUNDING)


@law
@given(object_frames(), points)
def test_into_the_cube_and_out_is_no_way(cube: ObjectFrame, p: np.ndarray) -> None:
    close(cube.to_camera(cube.to_cube(p)), p)
    close(cube.to_cube(cube.to_camera(p)), p)
    close(cube.to_camera(np.zeros(3)), cube.T_camera_object[:3, 3])
    close(cube.to_camera(p), moved(cube.T_camera_object, cube.half_extent * p))


@law
@given(object_frames(), poses(), poses(), points)
def test_a_cube_seen_from_elsewhere_is_the_same_cube(
    cube: ObjectFrame, T_b_a: np.ndarray, T_c_b: np.ndarray, p: np.ndarray
) -> None:
    other = cube.seen_from(T_b_a)
    close(other.to_camera(p), moved(T_b_a, cube.to_camera(p)))
    close(other.to_cube(moved(T_b_a, p)), cube.to_cube(p))
    close(
        moved(T_b_a, p) @ other.plane[:3] + other.plane[3], p @ cube.plane[:3] + cube.plane[3]
    )  # height over the plane
    twice, at_once = other.seen_from(T_c_b), cube.seen_from(T_c_b @ T_b_a)
    back = other.seen_from(np.linalg.inv(T_b_a))
    for a, b in ((twice, at_once), (back, cube)):
        close(a.T_camera_object, b.T_camera_object)
        close(a.plane, b.plane)
        assert (a.half_extent, a.xy_sigma, a.sight_sigma) == (b.half_extent, b.xy_sigma, b.sight_sigma)


@law
@given(hypotheses(T_world_camera=poses()), points)
def test_object_camera_and_world_are_a_chain(h: Hypotheses, p: np.ndarray) -> None:
    assert h.T_world_camera is not None
    close(h.T_object_from("object"), np.eye(4))
    close(h.T_object_from("world") @ h.T_world_camera, h.T_object_from("camera"))
    close(h.T_object_from("camera") @ h.object_frame.T_camera_object, np.eye(4))
    close(moved(h.T_object_from("camera"), p), h.object_frame.half_extent * h.object_frame.to_cube(p))


@law
@given(poses(), poses(), points)
def test_messages_of_poses_compose_as_their_matrices(A: np.ndarray, B: np.ndarray, p: np.ndarray) -> None:
    close(matrix(pose(A)), A)
    close(matrix(pose(A)) @ matrix(pose(B)), matrix(pose(A @ B)))
    close(moved(matrix(pose(np.linalg.inv(A))), moved(A, p)), p)


@law
@given(scenes())
def test_tf_has_the_frame_of_each_object(scene: list[Hypotheses]) -> None:
    transforms = transforms_message(scene, "/robot/farside").transforms
    assert [t.child_frame_id for t in transforms] == [f"robot/farside/object_{h.object_id}" for h in scene]
    for t, h in zip(transforms, scene, strict=True):
        p = t.transform.translation
        assert t.header.frame_id == h.frame_id
        close(np.array([p.x, p.y, p.z]), h.object_frame.T_camera_object[:3, 3])
