"""Files of poses: the robot's at each picture, as field tools write them, and the result of a hand-eye calibration."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from calibration.hand_eye import HandEye
from foundation.bounded import check_size, parse_json, parse_yaml, read_text
from foundation.one_line import one_line
from foundation.whole_file import write_whole

Matrix = Float[np.ndarray, "4 4"]
_FORMS = "x y z qx qy qz qw (metres; quaternion with w last) of T_base_gripper, perhaps after the picture's name"
_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_NAMES = ("picture", "image", "file", "filename", "name", "timestamp", "time", "stamp")
_FAR = 100.0  # m; farther is millimetres
_MOST = 10_000  # poses of a file


@dataclass(frozen=True, eq=False)
class RobotPose:
    """Where the gripper was, and at which picture; None: at the next in the order of names."""

    picture: str | None
    T_base_gripper: Matrix


def read_robot_poses(path: Path) -> list[RobotPose]:
    """The poses in a CSV, text, JSON or YAML file, one for each picture.

    CSV and text (TUM's) have a row of x y z qx qy qz qw, perhaps after a picture's name or a stamp; a row of headings
    may give another order (tx, ty, tz; qw first). JSON and YAML have a list, or a mapping by the picture's name, of
    geometry_msgs' Pose or Transform (also inside `robot`, `pose` or `transform`; `picture`, `file` or `name` beside
    it), of 7 numbers, or of 4x4 matrices. Raises FileNotFoundError, or ValueError naming the file and the entry.
    """
    try:
        text = read_text(path)
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such file; give one of {_FORMS}") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no text; give a file of {_FORMS}") from None
    except ValueError as error:
        raise ValueError(f"{path} is no file of poses: {error}; give {_FORMS}") from None
    entries = _structured(path, text) if path.suffix.lower() in (".json", ".yaml", ".yml") else _rows(path, text)
    if len(entries) > _MOST:
        raise ValueError(f"{path} has {len(entries)} poses; give one for each picture, {_MOST} at most")
    poses: list[RobotPose] = []
    for name, entry in entries:
        where = f"{path}: pose {len(poses) + 1}" + ("" if name is None else f" ({name[:60]})")
        try:
            poses.append(RobotPose(name, _matrix(entry)))
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{where}: {one_line(error)[:200]}; give {_FORMS}") from None
    if not poses:
        raise ValueError(f"{path} holds no pose; give {_FORMS}")
    return poses


def _rows(path: Path, text: str) -> list[tuple[str | None, Any]]:
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]
    if not lines:
        return []
    mark = next((m for m in (",", ";", "\t") if m in lines[0]), None)
    try:
        cut = csv.reader(lines, delimiter=mark) if mark else (line.split() for line in lines)
        rows = [[c.strip() for c in row] for row in cut]
    except csv.Error as error:
        raise ValueError(f"{path} is no table of poses ({error}); give {_FORMS}") from None
    names = [c.lower() for c in rows[0]]
    order, named = list(range(-7, 0)), len(rows[0]) == 8
    if not any(_is_number(c) for c in rows[0]):
        plain = [n[1:] if n in ("tx", "ty", "tz", "px", "py", "pz") else n for n in names]
        if not set(_COLUMNS) <= set(plain):
            missing = ", ".join(c for c in _COLUMNS if c not in plain)
            raise ValueError(f"{path}: its headings {', '.join(rows[0])[:100]} lack {missing}; give {_FORMS}")
        order = [plain.index(c) for c in _COLUMNS]
        at = next((i for i, n in enumerate(names) if n in _NAMES), None)
        return [
            (None if at is None or len(r) != len(names) else r[at], _chosen(r, order, len(names))) for r in rows[1:]
        ]
    return [(r[0] if named and len(r) == 8 else None, _chosen(r, order, len(rows[0]))) for r in rows]


def _chosen(row: list[str], order: Sequence[int], columns: int) -> list[str] | None:
    return [row[i] for i in order] if len(row) == columns >= 7 else None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _structured(path: Path, text: str) -> list[tuple[str | None, Any]]:
    try:
        content = parse_json(text) if path.suffix.lower() == ".json" else parse_yaml(text)
        check_size(content)
    except ValueError as error:
        raise ValueError(
            f"{path} cannot be read ({one_line(error)[:200]}); give, in text, JSON or YAML, {_FORMS}"
        ) from None
    if isinstance(content, Mapping) and len(content) == 1 and isinstance(inner := next(iter(content.values())), list):
        content = inner  # poses: [...]
    if isinstance(content, Mapping):
        return [(str(name), entry) for name, entry in content.items()]
    if not isinstance(content, list):
        raise ValueError(f"{path} holds {type(content).__name__}, no list of poses; give {_FORMS}")
    return [(_name(entry), entry) for entry in content]


def _name(entry: Any) -> str | None:
    names = [entry[n] for n in _NAMES if n in entry] if isinstance(entry, Mapping) else []
    return str(names[0]) if names else None


def _matrix(entry: Any) -> Matrix:
    """Raises ValueError, TypeError or OverflowError for what is no rigid transform in metres."""
    while isinstance(entry, Mapping):
        inner = next((entry[k] for k in ("robot", "pose", "transform", "matrix", "T_base_gripper") if k in entry), None)
        if inner is None:
            return _of_parts(entry)
        entry = inner
    values = np.array(entry, np.float64)
    if values.size == 7:
        return _rigid(values.ravel()[:3], values.ravel()[3:])
    if values.size != 16:
        raise ValueError(f"it is {str(entry)[:80]}")
    T = values.reshape(4, 4)
    with np.errstate(all="ignore"):  # any numbers
        turned = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3)
    if not turned or not np.allclose(T[3], [0, 0, 0, 1]):
        raise ValueError("its matrix is no rotation with a shift beside it and a last row 0 0 0 1")
    if np.linalg.det(T[:3, :3]) < 0:
        raise ValueError("its matrix mirrors: an axis points the wrong way")
    return _rigid(T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat())


def _of_parts(entry: Mapping[str, Any]) -> Matrix:
    parts = []
    for names, axes in ((("translation", "position"), "xyz"), (("rotation", "orientation", "quaternion"), "xyzw")):
        part = next((entry[n] for n in names if n in entry), None)
        if part is None:
            raise ValueError(f"it has no {' or '.join(names)}")
        if isinstance(part, Mapping):
            if missing := [axis for axis in axes if axis not in part]:
                raise ValueError(f"its {' or '.join(names)} has no {missing[0]}")
            part = [part[axis] for axis in axes]
        parts.append(np.array(part, np.float64))
    return _rigid(*parts)


def _rigid(shift: np.ndarray, quaternion: np.ndarray) -> Matrix:
    if shift.shape != (3,) or quaternion.shape != (4,) or not np.isfinite([*shift, *quaternion]).all():
        raise ValueError("it is not three finite numbers and a quaternion of four")
    if abs(math.hypot(*quaternion) - 1.0) > 1e-2:
        raise ValueError(f"its quaternion {quaternion.tolist()} has not the length 1")
    if (far := math.hypot(*shift)) > _FAR:
        raise ValueError(f"it is {far:g} m away; are these millimetres?")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), shift
    return T


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where a camera is on a robot: p_parent = T_parent_camera @ p_camera, metres."""

    parent: str  # frame, of the gripper or of the base
    camera: str  # frame_id of the pictures
    T_parent_camera: Matrix


def quaternion(T: Matrix) -> Float[np.ndarray, "4"]:
    """The rotation of T as x y z w, w not negative."""
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True))


def write_hand_eye(path: Path, result: HandEye, parent: str, camera: str) -> None:
    """Write a result to YAML atomically, for `read_mounting`: the fields of a geometry_msgs/TransformStamped, and how
    certain it is.
    """
    (x, y, z), q = result.T_parent_camera[:3, 3].tolist(), quaternion(result.T_parent_camera).tolist()
    content = {
        "header": {"frame_id": parent},
        "child_frame_id": camera,
        "transform": {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": dict(zip("xyzw", q, strict=True)),
        },
        "hand_eye": {
            "eye": result.eye,
            "translation_std_m": result.std[3:].tolist(),
            "rotation_std_rad": result.std[:3].tolist(),  # about the parent's axes
            "rms_px": result.rms,
            "pictures": len(result.misses),
            "T_base_board" if result.eye == "in-hand" else "T_gripper_board": result.T_other_board.tolist(),
        },
    }
    write_whole(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def read_mounting(path: Path) -> Mounting:
    """The camera's place in a file that `write_hand_eye` wrote. Raises FileNotFoundError, or ValueError naming it."""
    try:
        content = parse_yaml(read_text(path))
        parent, camera = content["header"]["frame_id"], content["child_frame_id"]
        T = _of_parts(content["transform"])
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such file; `farside hand-eye` writes one") from None
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path} is no result of `farside hand-eye` ({one_line(error)[:200]}); run it again") from None
    for name in (parent, camera):
        if not isinstance(name, str) or not name:
            raise ValueError(f"{path} names a frame {name!r}; give its name")
    return Mounting(parent, camera, T)
