"""Cameras of a chain that Kalibr calibrated (its camchain.yaml)."""

import re
from collections.abc import Mapping

import numpy as np

from calibration.camera import Camera

_CAMERA = re.compile(r"cam\d+")
# Kalibr's lens names, ours, and how many coefficients Kalibr writes. Its coefficients are in OpenCV's order.
_LENSES = {"radtan": ("plumb_bob", 4), "equidistant": ("equidistant", 4), "none": ("plumb_bob", 0)}


def is_chain(content: object) -> bool:
    """Whether a YAML file's content is a chain: its keys are cam0, cam1, ..."""
    return isinstance(content, Mapping) and any(isinstance(key, str) and _CAMERA.fullmatch(key) for key in content)


def camera_of_chain(content: Mapping, name: str | None = None) -> Camera:
    """The camera `name` of a chain; None: cam0. Its poses (T_cn_cnm1 to the camera before, T_cam_imu) are not read.

    Raises ValueError naming the entry and the remedy; also where the projection is none of ours. Format:
    https://github.com/ethz-asl/kalibr/wiki/yaml-formats
    """
    name = name or "cam0"
    names = [key for key in content if isinstance(key, str) and _CAMERA.fullmatch(key)]
    if name not in names:
        raise ValueError(f"it has no camera {name}; append #NAME to the file, with one of {', '.join(names)[:100]}")
    camera = content[name]
    if not isinstance(camera, Mapping):
        raise ValueError(f"{name} has no keys; write it again with kalibr_calibrate_cameras")
    kind, lens = camera.get("camera_model"), camera.get("distortion_model")
    if kind != "pinhole" or not isinstance(lens, str) or lens not in _LENSES:
        raise ValueError(
            f"{name} has camera_model {str(kind)[:40]!r} and distortion_model {str(lens)[:40]!r}, which cannot be used;"
            " calibrate with Kalibr's --models pinhole-radtan or pinhole-equi, or with `farside calibrate`"
        )
    model, count = _LENSES[lens]
    fx, fy, cx, cy = _numbers(camera, name, "intrinsics", 4)
    distortion = _numbers(camera, name, "distortion_coeffs", count) if count else np.zeros(4)
    width, height = _numbers(camera, name, "resolution", 2)
    if not (width % 1 == 0 and height % 1 == 0):
        raise ValueError(f"{name}: resolution is {camera['resolution']!r}; give the width and height in whole px")
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(int(width), int(height), K, distortion, model)


def _numbers(camera: Mapping, name: str, key: str, count: int) -> np.ndarray:
    values = camera.get(key)
    try:
        found = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError(f"{name}: {key} is {str(values)[:80]}, not {count} finite numbers; write the chain again")
    return found
