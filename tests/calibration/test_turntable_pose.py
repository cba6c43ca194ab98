"""The plate's pose is the camera's true one, its axis the true axis, and a picture that tells neither says why."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.boards import Board, parse_board
from calibration.camera import Camera
from calibration.turntable_pose import PlateNotFoundError, T_board_plate, locate_plate, plate_axis, turned
from tests.calibration.boards import CAMERAS, poses
from tests.perception.turning import BOARD, Turning

SCENE = Turning(depth=False, block=False)


FISHEYE = replace(SCENE, distortion=(-0.02, 0.01, -0.004, 0.001), model="equidistant")


@pytest.mark.parametrize("scene", [SCENE, FISHEYE], ids=["pinhole", "fisheye"])
def test_the_pose_is_where_the_camera_is(scene: Turning) -> None:
    for angle in (0.0, 100.0):
        found = locate_plate(BOARD, scene.camera, scene.frame(angle).rgb)
        error = np.linalg.inv(scene.T_plate_camera(angle)) @ found.T_plate_camera
        assert np.linalg.norm(error[:3, 3]) < 0.003 and np.trace(error[:3, :3]) > 1 + 2 * np.cos(np.deg2rad(0.5))
        assert found.corners > 15 and found.rms < 0.6


@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_the_pose_of_noisy_corners_is_right_within_their_noise(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over many poses the errors are as large as least squares says: chi2 of 6 degrees of freedom has mean 6."""
    camera, rng, noise, chi2 = CAMERAS[model], np.random.default_rng(0), 0.2, []
    for T in poses(camera, BOARD, 40, 40.0, seed=1, away=(5, 12)):
        px = camera.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])
        seen = BOARD.corners, px + noise * rng.standard_normal(px.shape)
        monkeypatch.setattr(Board, "find", lambda self, rgb, seen=seen: seen)
        found = locate_plate(BOARD, camera, np.zeros((480, 640, 3), np.uint8)).T_plate_camera
        T_camera_board = np.linalg.inv(T_board_plate(BOARD) @ found)
        turn, true = cv2.Rodrigues(T_camera_board[:3, :3])[0].ravel(), cv2.Rodrigues(T[:3, :3])[0].ravel()
        off = np.concatenate([turn - true, T_camera_board[:3, 3] - T[:3, 3]])
        J = camera.project_posed(BOARD.corners, true, T[:3, 3])[2]
        chi2.append(off @ (J.T @ J / noise**2) @ off)
    assert np.mean(chi2) == pytest.approx(6.0, abs=4 * np.sqrt(12 / 40))


def test_the_plates_frame_is_as_it_says() -> None:
    """z up, x along the columns, y to the top edge, origin in the middle."""
    w, h = BOARD.size
    corners = np.array([[-w / 2, h / 2, 0, 1], [w / 2, h / 2, 0, 1], [-w / 2, -h / 2, 0, 1], [0, 0, 0.1, 1]]).T
    np.testing.assert_allclose(
        (T_board_plate(BOARD) @ corners)[:3].T, [[0, 0, 0], [w, 0, 0], [0, h, 0], [w / 2, h / 2, -0.1]]
    )
    ideal = cv2.copyMakeBorder(BOARD.picture(60), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255)
    side = ideal.shape[0]
    camera = Camera(
        side, side, np.array([[side, 0, side / 2 - 0.5], [0, side, side / 2 - 0.5], [0, 0, 1.0]]), np.zeros(5)
    )
    T = locate_plate(BOARD, camera, np.repeat(ideal[..., None], 3, axis=2)).T_plate_camera
    height = side / 60 * BOARD.square
    np.testing.assert_allclose(T, [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, height], [0, 0, 0, 1]], atol=2e-3)


def test_the_axis_is_where_the_plate_turns() -> None:
    rng = np.random.default_rng(0)
    T = np.stack([SCENE.T_plate_camera(angle) for angle in range(0, 360, 30)])
    np.testing.assert_allclose(plate_axis(T)[0], SCENE.axis, atol=1e-9)
    assert plate_axis(T)[1] < 1e-9
    T[:, :3, 3] += 0.001 * rng.standard_normal((12, 3))
    np.testing.assert_allclose(plate_axis(T)[0], SCENE.axis, atol=1e-3)
    assert 0.0003 < plate_axis(T)[1] < 0.002
    assert turned(T[0], T[1]) == pytest.approx(30.0) and turned(T[3], T[0]) == pytest.approx(-90.0)
    for few in (T[:2], np.repeat(T[:1], 5, axis=0)):
        with pytest.raises(ValueError, match="do not tell the plate's axis; take three or more"):
            plate_axis(few)


def test_a_picture_without_the_plate_says_so() -> None:
    rgb = SCENE.frame(0.0).rgb
    with pytest.raises(PlateNotFoundError, match=r"^fewer than 8 corners of the board were found, or all in a line"):
        locate_plate(BOARD, SCENE.camera, np.full_like(rgb, 128))
    with pytest.raises(PlateNotFoundError, match="corners of the board were found"):
        locate_plate(parse_board("charuco:7x7:0.03:0.022:DICT_6X6_50"), SCENE.camera, rgb)
    K = SCENE.camera.K.copy()
    K[0, 0] *= 2.0
    with pytest.raises(PlateNotFoundError, match="px off their pose; check the camera's calibration"):
        locate_plate(BOARD, Camera(480, 360, K, np.zeros(5)), rgb)
