"""The command `farside hand-eye`: pictures and poses become the camera's place, or one line says why not."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.boards import parse_board
from calibration.camera_file import write_camera
from calibration.pose_files import read_mounting
from node.__main__ import main
from node.ros.bus import Bus
from node.ros.frame_tree import FrameTree
from node.ros.settings import BusConfig
from tests.calibration.boards import CAMERAS, photograph, poses
from tests.calibration.robots import X, gripper
from tests.calibration.test_boards import AWAY

BOARD = parse_board("charuco:7x5:0.035:0.026:DICT_5X5_100")
CAMERA = CAMERAS["plumb_bob"]
COUNT = 8


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures with a camera on the gripper, the robot's poses at them, and the camera's file."""
    folder = tmp_path_factory.mktemp("session")
    (folder / "pictures").mkdir()
    lines = []
    for i, T in enumerate(poses(CAMERA, BOARD, COUNT, 40.0, 1, AWAY["plumb_bob"])):
        cv2.imwrite(str(folder / "pictures" / f"{i:02}.png"), photograph("plumb_bob", BOARD, T))
        G = gripper(T, "in-hand")
        row = [*G[:3, 3], *Rotation.from_matrix(G[:3, :3]).as_quat()]
        lines.append(",".join([f"{i:02}.png", *(f"{v:.9f}" for v in row)]))
    (folder / "poses.csv").write_text("\n".join(lines))
    write_camera(folder / "camera.yaml", CAMERA)
    return folder


def asked(session: Path, out: Path, *more: str, poses: Path | None = None) -> list[str]:
    given = ["--poses", str(poses or session / "poses.csv"), "--camera", str(session / "camera.yaml")]
    return ["hand-eye", str(session / "pictures"), *given, "--out", str(out), *more]


def refused(args: list[str], capsys: pytest.CaptureFixture) -> str:
    capsys.readouterr()
    assert main(args) == 1
    *notes, line = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("farside: error: ") and all(note.startswith("note: ") for note in notes)
    return line


def test_pictures_and_poses_give_the_camera_s_place(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "new" / "hand_eye.yaml"
    assert main(asked(session, out, "--gripper-frame", "flange", "--camera-frame", "wrist_optical")) == 0
    said = capsys.readouterr().out
    assert "wrist_optical in flange" in said and "8 used" in said and "±" in said and "07.png" in said
    mounting = read_mounting(out)
    assert (mounting.parent, mounting.camera) == ("flange", "wrist_optical")
    np.testing.assert_allclose(mounting.T_parent_camera, X, atol=2e-3)


def test_poses_in_order_are_those_of_the_pictures_in_order(session: Path, tmp_path: Path) -> None:
    """Also with stamps in place of names."""
    rows = [line.split(",")[1:] for line in (session / "poses.csv").read_text().splitlines()]
    (tmp_path / "tum.txt").write_text("\n".join(" ".join([f"{10.5 + i}", *row]) for i, row in enumerate(rows)))
    assert main(asked(session, tmp_path / "h.yaml", poses=tmp_path / "tum.txt")) == 0
    np.testing.assert_allclose(read_mounting(tmp_path / "h.yaml").T_parent_camera, X, atol=2e-3)


def test_without_a_camera_file_the_pictures_calibrate_it(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "h.yaml"
    args = ["hand-eye", str(session / "pictures"), "--poses", str(session / "poses.csv"), "--out", str(out)]
    assert main(args) == 0
    assert "calibrated from these pictures" in capsys.readouterr().err
    np.testing.assert_allclose(read_mounting(out).T_parent_camera, X, atol=5e-3)


def test_what_is_wrong_is_named_and_nothing_is_written(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "h.yaml"
    rows = [line.split(",") for line in (session / "poses.csv").read_text().splitlines()]

    def says(text: str, *more: str) -> str:
        (tmp_path / "p.csv").write_text(text)
        line = refused(asked(session, out, *more, poses=tmp_path / "p.csv"), capsys)
        assert not out.exists()
        return line

    whole = (session / "poses.csv").read_text()
    assert "nothing is saved" in (line := says(whole, "--eye", "to-hand")) and "with --eye in-hand" in line
    few = "\n".join(",".join(row[1:]) for row in rows[:3])
    assert "has 3 poses, but" in (line := says(few)) and "has 8 pictures" in line
    assert "too few" in says("\n".join(",".join(row) for row in rows[:3]))
    wxyz = "\n".join(",".join([*row[:4], row[7], *row[4:7]]) for row in rows)
    assert "quaternions x y z w" in says(wxyz) or "miss their places" in says(wxyz)
    assert "ends in .yaml" in refused(asked(session, tmp_path / "h.txt"), capsys)
    far = "\n".join(",".join([row[0], *(str(100 * float(v)) for v in row[1:4]), *row[4:]]) for row in rows)
    assert "more than the picture's width" in (line := says(far)) and "to-hand" not in line
    assert "two poses of 02.png" in says(whole + "\n" + ",".join(["02.png", *rows[3][1:]]))
    for name in ("", "a\nb", "/", "\udcff"):
        assert f"--camera-frame is {name!r}" in says(whole, "--camera-frame", name)
    assert "are both 'a'" in says(whole, "--camera-frame", "a", "--gripper-frame", "a")
    assert "is a file; give a folder" in refused(asked(session, session / "camera.yaml" / "h.yaml"), capsys)
    assert "in none of 8 pictures" in refused(asked(session, out, "--board", "chessboard:9x9:0.1"), capsys)


def test_what_has_no_partner_is_told(session: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    text = (session / "poses.csv").read_text()
    (tmp_path / "p.csv").write_text(text.replace("03.png", "99.png") + "\n" + text.splitlines()[0])
    assert main(asked(session, tmp_path / "h.yaml", poses=tmp_path / "p.csv")) == 0
    said = capsys.readouterr().err
    assert "1 pictures have no pose: 03.png" in said and "1 poses name no picture: 99.png" in said


def test_the_node_tells_all_where_its_camera_is(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "h.yaml"
    assert main(asked(session, out)) == 0
    with Bus(BusConfig()) as bus:
        own, other = FrameTree(bus), FrameTree(bus)
        own.mount(bus, read_mounting(out))
        np.testing.assert_allclose(own.T("tool0", "camera_color_optical_frame", 5), X, atol=2e-3)
        heard = 0
        while not other.knows("tool0") and heard < 500:
            heard += 1
            bus.graph(0.02)
        np.testing.assert_allclose(other.T("tool0", "camera_color_optical_frame", 5), X, atol=2e-3)
