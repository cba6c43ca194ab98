"""Camera files: the YAML that ROS's camera_info_manager writes and reads, with the calibration's uncertainty.

Kalibr's chains and the archives of ROS's cameracalibrator are read, too.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibration.camchain import camera_of_chain, is_chain
from calibration.camera import Camera
from calibration.projection import Projection
from foundation.archive import is_archive, members
from foundation.bounded import parse_yaml, read_text
from foundation.whole_file import write_whole

# ROS's reader ignores this key.
_OURS = "farside_calibration"


def write_camera(path: Path, camera: Camera, name: str = "camera", misses: Projection | None = None) -> None:
    """Write a camera to YAML atomically; `read_camera` returns it exactly.

    Keys are those of ROS's camera_calibration_parsers. The standard deviations and the RMS (px) are under a key of our
    own, and so is what `misses` says of the picture, row by row from its upper edge to its lower (`projection.GRID`).
    """
    distortion = camera.distortion
    content: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _matrix(camera.K),
        "distortion_model": camera.model,
        "distortion_coefficients": _matrix(distortion[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([camera.K, np.zeros(3)])),
    }
    ours: dict[str, Any] = {}
    if camera.rms is not None:
        ours["rms"] = float(camera.rms)
    if camera.K_std is not None:
        ours["camera_matrix_std"] = _matrix(camera.K_std)
    if camera.distortion_std is not None:
        ours["distortion_std"] = _matrix(camera.distortion_std[None])
    if misses is not None:
        ours["projection_std"] = _matrix(misses.std)
        if misses.difference is not None:
            ours["halves_difference"] = _matrix(misses.difference)
    if ours:
        content[_OURS] = ours
    write_whole(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def is_camera_file(path: Path) -> bool:
    """Whether the name is a camera file's, with or without #NAME."""
    file = split_name(path)[0]
    return is_archive(file) or file.suffix.lower() in (".yaml", ".yml")


def split_name(path: Path) -> tuple[Path, str | None]:
    """The file and the camera's name of FILE#NAME. A file that exists under the whole name is that file."""
    file, hash_, name = str(path).rpartition("#")
    return (path, None) if not hash_ or not name or "/" in name or path.exists() else (Path(file), name)


def read_camera(path: Path) -> Camera:
    """The camera in a YAML file of ROS's or ours, in Kalibr's camchain.yaml, or in ROS's calibrationdata.tar.gz.

    Of a chain, FILE#cam1 is its camera cam1, and FILE alone cam0. Of an archive, FILE alone is ost.yaml (of one
    camera) or left.yaml, and FILE#right is right.yaml. Raises FileNotFoundError, or ValueError naming file
    and remedy.
    """
    path, name = split_name(path)
    archived = _archived(path, name) if is_archive(path) else None
    try:
        content = parse_yaml(read_text(path) if archived is None else archived.decode())
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such camera file; `farside calibrate` writes one") from None
    except ValueError as error:
        raise ValueError(f"{path} is not YAML ({error}); calibrate again") from None
    if is_chain(content):
        try:
            return camera_of_chain(content, name)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    if name is not None and archived is None:
        raise ValueError(f"{path} is not a chain of cameras (Kalibr's, with cam0, cam1, ...); omit #{name}")
    try:
        if not isinstance(content, Mapping):
            raise ValueError("it has no keys")
        ours = content.get(_OURS) or {}
        K_std, distortion_std, rms = (ours.get(k) for k in ("camera_matrix_std", "distortion_std", "rms"))
        return Camera(
            width=_whole(content, "image_width"),
            height=_whole(content, "image_height"),
            K=_array(content, "camera_matrix"),
            distortion=_array(content, "distortion_coefficients").ravel(),
            model=str(content.get("distortion_model", "plumb_bob")),
            K_std=None if K_std is None else _array(ours, "camera_matrix_std"),
            distortion_std=None if distortion_std is None else _array(ours, "distortion_std").ravel(),
            rms=None if rms is None else float(rms),
        )
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        why = str(error).removesuffix("; calibrate again")
        raise ValueError(f"{path} is no camera file: {why}; calibrate again") from None


def _archived(path: Path, name: str | None) -> bytes:
    wanted = re.compile(rf"{re.escape(name)}\.yaml" if name else r"(ost|left)\.yaml")
    for _, data in members(path, wanted):
        return data
    what = f"{name}.yaml" if name else "ost.yaml or left.yaml"
    raise ValueError(f"{path} holds no {what}; give the archive that ROS's cameracalibrator saved")


def _matrix(values: np.ndarray) -> dict[str, Any]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": [float(v) for v in values.ravel()]}


def _array(content: Mapping, key: str) -> np.ndarray:
    entry = content.get(key)
    if not isinstance(entry, Mapping) or not {"rows", "cols", "data"} <= set(entry):
        raise ValueError(f"{key} is {entry!r}, not rows, cols and data")
    data, size = np.array(entry["data"], dtype=np.float64), (_whole(entry, "rows"), _whole(entry, "cols"))
    if min(size) < 1 or data.size != size[0] * size[1]:
        raise ValueError(f"{key} has {data.size} numbers for {size[0]}x{size[1]}")
    return data.reshape(size)


def _whole(content: Mapping, key: str) -> int:
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{key} is {value!r}, not a whole number")
    return value
