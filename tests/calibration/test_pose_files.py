"""Poses are read in the forms that field tools write, and what is no pose is refused in one line with the entry."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibration.hand_eye import hand_eye
from calibration.pose_files import quaternion, read_mounting, read_robot_poses, write_hand_eye
from tests.calibration.robots import CAMERA, placed, posed_views

T = [placed([0.1, 0.2, 0.3], [0.4, -0.1, 0.2]), placed([-1.0, 0.0, 2.0], [0.0, 0.5, -0.2])]
ROWS = [[*p[:3, 3].tolist(), *Rotation.from_matrix(p[:3, :3]).as_quat().tolist()] for p in T]
PARTS = [
    {"translation": dict(zip("xyz", r[:3], strict=True)), "rotation": dict(zip("xyzw", r[3:], strict=True))}
    for r in ROWS
]


def rows(mark: str, *before: str) -> str:
    return "\n".join(mark.join([*before[i : i + 1], *map(repr, row)]) for i, row in enumerate(ROWS))


def headed() -> str:
    lines = [f"b{i}.png,{q[3]},{q[0]},{q[1]},{q[2]},{x},{y},{z}" for i, (x, y, z, *q) in enumerate(ROWS)]
    return "\n".join(["image,qw,qx,qy,qz,tx,ty,tz", *lines])


FORMS: dict[str, tuple[str, list[str | None]]] = {
    "plain.csv": (rows(","), [None, None]),
    "named.csv": (rows(", ", "a.png", "b.png"), ["a.png", "b.png"]),
    "semicolons.csv": (rows("; "), [None, None]),
    "headed.csv": (headed(), ["b0.png", "b1.png"]),
    "tum.txt": ("# timestamp tx ty tz qx qy qz qw\n" + rows(" ", "1.5", "2.5"), ["1.5", "2.5"]),
    "list.json": (json.dumps(ROWS), [None, None]),
    "matrices.json": (json.dumps({"poses": [p.tolist() for p in T]}), [None, None]),
    "flat.json": (json.dumps([p.ravel().tolist() for p in T]), [None, None]),
    "by_name.json": (json.dumps({"a.png": ROWS[0], "b.png": ROWS[1]}), ["a.png", "b.png"]),
    "transforms.yaml": (yaml.safe_dump([{"file": "a.png", "transform": PARTS[0]}, PARTS[1]]), ["a.png", None]),
    "samples.yaml": (yaml.safe_dump({"samples": [{"robot": p, "optical": {}} for p in PARTS]}), [None, None]),
    "poses.yaml": (
        yaml.safe_dump([{"pose": {"position": r[:3], "orientation": r[3:]}} for r in ROWS]),
        [None, None],
    ),
}


@pytest.mark.parametrize("name", FORMS)
def test_the_forms_of_field_tools(tmp_path: Path, name: str) -> None:
    text, names = FORMS[name]
    (tmp_path / name).write_text(text)
    found = read_robot_poses(tmp_path / name)
    assert [p.picture for p in found] == names
    np.testing.assert_allclose([p.T_base_gripper for p in found], T, atol=1e-9)


MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "1,2,3,0,0,0\n", r"a.csv: pose 1: .*; give x y z qx qy qz qw \(metres"),
        ("a.csv", "0,0,0,0,0,0,1\n0,0,0,0,0,0\n", "a.csv: pose 2: "),
        ("a.csv", "0,0,0,0,0,0,1,9,9\n", "a.csv: pose 1: its quaternion"),
        ("a.csv", "0,0,0,0,0,x,1\n", "a.csv: pose 1: could not convert"),
        ("a.csv", "x,y,z,roll,pitch,yaw\n1,2,3,0,0,0\n", "its headings x, y, z, roll, pitch, yaw lack qx, qy, qz, qw"),
        ("a.csv", "0,0,0,0,0,0,2\n", r"pose 1: its quaternion \[0.0, 0.0, 0.0, 2.0\] has not the length 1"),
        ("a.csv", "400,0,300,0,0,0,1\n", "pose 1: it is 500 m away; are these millimetres"),
        ("a.csv", "1e308,1e308,0,0,0,0,1\n", r"pose 1: it is .*308 m away"),
        ("a.csv", "0,0,0,0,0,1e308,1e308\n", "pose 1: its quaternion"),
        ("a.csv", "0,0,0,0,0,0,1\n" * 20_000, "has 20000 poses; give one for each picture"),
        ("a.csv", "nan,0,0,0,0,0,1\n", "pose 1: it is not three finite numbers"),
        ("a.csv", "# nothing\n", "a.csv holds no pose"),
        ("a.json", "{", "a.json cannot be read"),
        ("a.json", "[" * 100_000, "a.json cannot be read .*nested too deep"),
        ("a.json", "3", "a.json holds int, no list of poses"),
        ("a.json", json.dumps([MIRRORED]), "pose 1: its matrix mirrors"),
        ("a.json", json.dumps([[1] * 16]), "pose 1: its matrix is no rotation"),
        ("a.yaml", "a.png: {translation: [0, 0, 0]}\nb.png: 3", r"pose 1 \(a.png\): it has no rotation or orientation"),
        ("a.yaml", "- {position: {x: 1, y: 2}, rotation: [0, 0, 0, 1]}", "its translation or position has no z"),
        ("a.json", json.dumps([[1e308] * 16]), "pose 1: its matrix is no rotation"),
        ("a.yaml", "- {robot: {robot: x}}", "pose 1: could not convert"),
    ],
)
def test_what_is_no_pose_is_refused(tmp_path: Path, name: str, text: str, says: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=says) as refused:
        read_robot_poses(tmp_path / name)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 600


def test_an_absent_file_and_no_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"a.csv: no such file; give one of x y z"):
        read_robot_poses(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(ValueError, match=r"a.csv is no text"):
        read_robot_poses(tmp_path / "a.csv")


def test_a_result_is_read_back(tmp_path: Path) -> None:
    result, path = hand_eye(posed_views("to-hand"), CAMERA, "to-hand"), tmp_path / "new" / "hand_eye.yaml"
    write_hand_eye(path, result, "base_link", "cam_optical")
    mounting = read_mounting(path)
    assert (mounting.parent, mounting.camera) == ("base_link", "cam_optical")
    np.testing.assert_allclose(mounting.T_parent_camera, result.T_parent_camera, atol=1e-12)
    said = yaml.safe_load(path.read_text())["hand_eye"]
    assert said["eye"] == "to-hand" and said["pictures"] == 15
    np.testing.assert_array_equal([*said["rotation_std_rad"], *said["translation_std_m"]], result.std)
    np.testing.assert_array_equal(said["T_gripper_board"], result.T_other_board)
    assert quaternion(result.T_parent_camera)[3] >= 0


@pytest.mark.parametrize("text", ["", "[]", "header: {frame_id: a}", "a: &a [*a]", "\t"])
def test_what_is_no_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "h.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"h.yaml is no result of `farside hand-eye`"):
        read_mounting(tmp_path / "h.yaml")
    with pytest.raises(FileNotFoundError, match=r"g.yaml: no such file; `farside hand-eye` writes one"):
        read_mounting(tmp_path / "g.yaml")
