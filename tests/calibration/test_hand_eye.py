"""The camera is found where it is, within the stated deviations; what is not determined is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.hand_eye import Eye, HandEye, PosedView, hand_eye
from tests.calibration.boards import poses
from tests.calibration.robots import BOARD, CAMERA, X, Y, gripper, placed, posed_views

EYES = pytest.mark.parametrize("eye", ["in-hand", "to-hand"])


def off(result: HandEye) -> np.ndarray:
    """Turn (rad) and shift (m) from what was found to what is true, as `std` has them."""
    T = result.T_parent_camera
    return np.concatenate([Rotation.from_matrix(X[:3, :3] @ T[:3, :3].T).as_rotvec(), X[:3, 3] - T[:3, 3]])


@EYES
def test_without_noise_it_is_exact(eye: Eye) -> None:
    result = hand_eye(posed_views(eye, px=0.0, turn=0.0, shift=0.0, count=8), CAMERA, eye)
    np.testing.assert_allclose(result.T_parent_camera, X, atol=1e-6)
    np.testing.assert_allclose(result.T_other_board, Y, atol=1e-6)
    assert result.trouble is None and result.rms < 1e-3 and not result.dropped


@EYES
def test_deviations_are_the_spread_over_repetitions(eye: Eye) -> None:
    """Of the robot's noise and the corners' together: neither far too small nor far too large."""
    z = []
    for seed in range(12):
        result = hand_eye(posed_views(eye, seed, turn=0.2, shift=1e-3), CAMERA, eye)
        assert result.trouble is None
        z.append(off(result) / result.std)
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35
    assert np.abs(z).max() < 4.5


def test_a_robot_s_errors_count_as_the_robot_s() -> None:
    """Least squares in pixels alone would take them for noise of the corners, and miss by more."""
    misses = [off(hand_eye(posed_views("in-hand", seed, turn=0.1), CAMERA)) for seed in range(8)]
    turn, shift = np.sqrt(np.mean(np.square(misses), axis=0)).reshape(2, 3).max(axis=1)
    assert np.degrees(turn) < 0.12 and shift < 1e-3


def test_a_camera_of_uncertain_focal_length_is_at_an_uncertain_place() -> None:
    views = posed_views("in-hand")
    unsure = replace(CAMERA, K_std=np.array([[4.0, 0, 0], [0, 4.0, 0], [0, 0, 0]]))
    exact, wide = hand_eye(views, CAMERA), hand_eye(views, unsure)
    np.testing.assert_array_equal(wide.T_parent_camera, exact.T_parent_camera)
    wrong = hand_eye(views, replace(CAMERA, K=CAMERA.K + np.diag([4.0, 4.0, 0.0])))
    moved = np.abs(wrong.T_parent_camera[:3, 3] - exact.T_parent_camera[:3, 3]).max()
    added = np.sqrt(wide.std[3:] ** 2 - exact.std[3:] ** 2).max()
    assert 0.5 < added / moved < 1.5


def test_a_pose_of_another_picture_is_left_out() -> None:
    views = posed_views("in-hand")
    views[4] = replace(views[4], T_base_gripper=views[9].T_base_gripper)
    result = hand_eye(views, CAMERA)
    ((name, why),) = result.dropped
    assert name == "04.png" and "another picture's" in why and result.trouble is None
    assert np.abs(off(result) / result.std).max() < 4.5


def turned_about(axis: list[float]) -> list[PosedView]:
    """Turns about one axis of the gripper alone."""
    first, made = posed_views("in-hand", px=0.0, turn=0.0, shift=0.0)[0], []
    for i, angle in enumerate(np.radians(np.linspace(-15, 15, 8))):
        moved = first.T_base_gripper @ placed(list(angle * np.array(axis)), [0, 0, 0])
        T = np.linalg.inv(X) @ np.linalg.inv(moved) @ Y
        pixels = CAMERA.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])
        made.append(PosedView(replace(first.view, name=str(i), pixels=pixels), moved))
    return made


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
def test_turns_about_one_axis_are_refused(axis: list[float]) -> None:
    with pytest.raises(ValueError, match=r"turns about one axis alone .* about another$"):
        hand_eye(turned_about(axis), CAMERA)


def test_few_and_wrong_poses_are_refused() -> None:
    views = posed_views("in-hand")
    with pytest.raises(ValueError, match=r"^4 pictures with the board and a pose are too few; take 5 or more"):
        hand_eye(views[:4], CAMERA)
    shuffled = [replace(v, T_base_gripper=views[i - 1].T_base_gripper) for i, v in enumerate(views)]
    with pytest.raises(ValueError, match="in this order, and are their quaternions x y z w"):
        hand_eye(shuffled, CAMERA)


@EYES
def test_the_other_way_round_is_named(eye: Eye) -> None:
    """The camera is elsewhere, or the poses are inverted, which is the same to the equations."""
    other: Eye = "to-hand" if eye == "in-hand" else "in-hand"
    result = hand_eye(posed_views(eye), CAMERA, other)
    assert result.trouble is not None and f"with --eye {eye} they miss by" in result.trouble
    inverted = [replace(v, T_base_gripper=np.linalg.inv(v.T_base_gripper)) for v in posed_views(eye)]
    assert "poses are inverted" in str(hand_eye(inverted, CAMERA, eye).trouble)


def test_what_is_hardly_determined_is_not_saved() -> None:
    """Small turns and a poor robot."""
    rng, views = np.random.default_rng(0), []
    first = poses(CAMERA, BOARD, 1, 20.0, 3)[0]
    for i in range(6):
        T = first.copy()
        T[:3, :3] = Rotation.from_rotvec(np.radians(6) * rng.normal(size=3)).as_matrix() @ T[:3, :3]
        pixels = CAMERA.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])
        error = placed(np.radians(0.4) * rng.normal(size=3), 2e-3 * rng.normal(size=3))
        views.append(PosedView(replace(posed_views("in-hand")[i].view, pixels=pixels), gripper(T, "in-hand") @ error))
    assert "is not determined: standard deviations up to" in str(hand_eye(views, CAMERA).trouble)
