"""The frame folder: colour, depth, label map and meta.json, read and written."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from calibration.camera import Camera
from foundation.bounded import check_size, parse_json, read_text
from foundation.whole_file import write_whole
from perception.sources.frame import LAST_STAMP, SATURATED, Frame, known_counts
from perception.sources.image_files import read_npy, read_picture, read_png
from perception.sources.label_map import read_label_map
from perception.sources.registration import registered
from probnerf.geometry import rigid

DEPTH_UNIT_M = 1e-4  # of the depth.png that is written; 1 mm where that does not reach far enough
# Keys of meta.json, and their shapes, for the camera's K_std, distortion_std and rms.
_DEVIATIONS: dict[str, tuple[int, ...]] = {"camera_matrix_std_px": (3, 3), "distortion_std": (-1,), "rms_px": ()}
COLOURS = ("color.png", "color.jpg", "color.jpeg", "rgb.png", "rgb.jpg", "rgb.jpeg")  # the first one that exists


def is_frame_folder(path: Path) -> bool:
    """Whether a path is meant as a frame folder, whole or not."""
    return any((path / name).exists() for name in ("meta.json", *COLOURS))


def read_frame_folder(path: Path | str) -> Frame:
    """The frame in a folder: colour, meta.json, and depth and a label map where they are.

    Colour is color.png, color.jpg, rgb.png or rgb.jpg. Depth is depth.png (16 bits, 0 or 65535 where unknown) or
    depth.npy (m; integers are counts as in depth.png). The label map is label.png, label.npy or label.npz (see
    `read_label_map`). meta.json gives `camera_matrix_px` (3x3) and, for counts, `depth_unit_m` (m per count), and may
    give `distortion` and `distortion_model` (as `Camera`; none by default), their errors (`camera_matrix_std_px`,
    `distortion_std`, `rms_px`), `stamp_ns` (0), `frame_id` ("camera") and `T_world_camera` (4x4, m). For depth with
    pixels of its own it gives `depth_camera_matrix_px` and, from another place, `T_color_depth` (4x4, m). Other keys
    are ignored. Without depth it is a frame without depth. Raises `FileNotFoundError` or `ValueError` naming the file
    and the remedy.
    """
    path = Path(path)
    counts = None
    if (path / "depth.npy").exists():
        counts = read_npy(path / "depth.npy")
    floats = counts is not None and counts.dtype.kind == "f"
    meta = _read_meta(path / "meta.json", depth=not floats and (counts is not None or (path / "depth.png").exists()))
    unit = meta.get("depth_unit_m")
    rgb = read_picture(next((path / name for name in COLOURS if (path / name).exists()), path / COLOURS[0]))
    height, width = rgb.shape[:2]
    source = path / ("depth.png" if counts is None else "depth.npy")
    if counts is None and unit is not None:
        counts = read_png(source)
        if counts.dtype != np.uint16 or counts.ndim != 2:
            raise ValueError(f"{source} is {counts.dtype}{list(counts.shape)}; save one channel of 16 bits")
    if counts is not None and counts.ndim != 2:
        raise ValueError(f"{source} is {counts.dtype}{list(counts.shape)}; save one value a pixel")
    own = meta["depth_camera_matrix_px"]
    if counts is not None and counts.shape != (height, width) and own is None:
        raise ValueError(
            f"{source} is {counts.shape[1]}x{counts.shape[0]} px but the colour is {width}x{height}; align it to the"
            " colour, or give its own camera in meta.json (depth_camera_matrix_px, T_color_depth)"
        )
    depth = None
    if counts is not None and floats:
        depth = counts.astype(np.float32)
    elif counts is not None:  # Frame turns 0 into NaN
        depth = (known_counts(counts) * np.float64(unit)).astype(np.float32)
    labels = [path / f"label{suffix}" for suffix in (".png", ".npy", ".npz") if (path / f"label{suffix}").exists()]
    label = read_label_map(labels[0], (height, width)) if labels else None
    try:
        optics = [meta[key] for key in ("camera_matrix_px", "distortion", "distortion_model", *_DEVIATIONS)]
        camera = Camera(width, height, *optics)
        if depth is not None and own is not None:
            depth_camera = Camera(depth.shape[1], depth.shape[0], own, np.zeros(5))
            depth = registered(depth, depth_camera, camera, meta["T_color_depth"])
    except ValueError as error:
        raise ValueError(f"{path / 'meta.json'}: {error}") from None
    known = {name: meta[name] for name in ("stamp_ns", "frame_id", "T_world_camera")}
    try:
        return Frame(rgb, depth, camera, label=label, **known)
    except ValueError as error:  # such as millimetres that depth_unit_m takes for metres
        raise ValueError(f"{path}: {error}; check depth_unit_m in meta.json") from None


def write_frame_folder(path: Path | str, frame: Frame) -> None:
    """Write a frame as the folder that `read_frame_folder` reads, over an earlier one.

    Everything is read back exactly except depth: it is rounded to 0.1 mm (1 mm if some is beyond 6.5 m), and limited to
    65.5 m. meta.json is removed first and written last, so that an unfinished folder is not read.
    Raises `ValueError` for ids that a label.png cannot hold.
    """
    path = Path(path)
    if frame.label is not None and not 0 <= frame.label.min() <= frame.label.max() <= 65535:
        raise ValueError(f"object id {int(frame.label.max())} does not fit label.png; use 0 to 65535")
    depth = unit = None
    if frame.depth is not None:
        metres = np.nan_to_num(frame.depth.astype(np.float64))
        unit = DEPTH_UNIT_M if np.rint(metres.max() / DEPTH_UNIT_M) < SATURATED else 10 * DEPTH_UNIT_M
        depth = np.minimum(np.rint(metres / unit), SATURATED - 1).astype(np.uint16)
    images = {
        "color.png": frame.rgb[..., ::-1],
        "depth.png": depth,
        "label.png": None if frame.label is None else frame.label.astype(np.uint16),
    }
    meta = {
        "camera_matrix_px": frame.camera.K.tolist(),
        "distortion": frame.camera.distortion.tolist(),
        "distortion_model": frame.camera.model,
        "stamp_ns": int(frame.stamp_ns),
        "frame_id": frame.frame_id,
    }
    deviations = (frame.camera.K_std, frame.camera.distortion_std, frame.camera.rms)
    for key, value in zip(_DEVIATIONS, deviations, strict=True):
        if value is not None:
            meta[key] = np.asarray(value, np.float64).tolist()
    if unit is not None:
        meta["depth_unit_m"] = unit
    if frame.T_world_camera is not None:
        meta["T_world_camera"] = np.asarray(frame.T_world_camera, np.float64).tolist()
    path.mkdir(parents=True, exist_ok=True)
    for name in ("meta.json", *images, *COLOURS, "depth.npy", "label.npy", "label.npz"):
        (path / name).unlink(missing_ok=True)
    for name, image in images.items():
        if image is not None:
            write_whole(path / name, cv2.imencode(".png", image)[1].tobytes())
    write_whole(path / "meta.json", json.dumps(meta, indent=1))


def _read_meta(path: Path, depth: bool) -> dict[str, Any]:
    """meta.json, its keys checked, and what it may omit filled in; depth_unit_m where there is `depth`."""
    try:
        meta = parse_json(read_text(path))
        check_size(meta)
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} is missing; it gives camera_matrix_px and depth_unit_m") from None
    except ValueError as error:
        raise ValueError(f"{path} is not JSON ({error}); write it again") from None
    for key in ("camera_matrix_px", "depth_unit_m"):
        if not isinstance(meta, dict) or (key not in meta and (depth or key != "depth_unit_m")):
            raise ValueError(f"{path} has no {key}; add it (3x3 in px, and metres per count of depth.png)")
    unit = meta.get("depth_unit_m")
    number = isinstance(unit, int | float) and not isinstance(unit, bool)
    if "depth_unit_m" in meta and not (number and 1e-6 <= unit <= 1):
        raise ValueError(f"{path}: depth_unit_m is {unit!r}; give metres per count, such as 0.001")
    optional = {"distortion": [0.0] * 5, "distortion_model": "plumb_bob", "stamp_ns": 0, "frame_id": "camera"}
    meta = {
        **optional,
        **dict.fromkeys(("T_world_camera", "T_color_depth", "depth_camera_matrix_px", *_DEVIATIONS)),
        **meta,
    }
    for key, default in optional.items():
        if isinstance(meta[key], bool) or not isinstance(meta[key], type(default)):
            raise ValueError(f"{path}: {key} is {meta[key]!r}; give something like {default!r}, or omit it")
    if any("\ud800" <= letter <= "\udfff" for letter in meta["frame_id"]):  # JSON may hold halves of letters
        raise ValueError(f"{path}: frame_id is {meta['frame_id'][:60]!a}; give whole letters")
    if not 0 <= meta["stamp_ns"] < LAST_STAMP:
        raise ValueError(f"{path}: stamp_ns is {meta['stamp_ns']}; give nanoseconds from 0 to {LAST_STAMP}, or omit it")
    meta["camera_matrix_px"] = _numbers(path, "camera_matrix_px", meta["camera_matrix_px"], (3, 3))
    meta["distortion"] = _numbers(path, "distortion", meta["distortion"], (len(meta["distortion"]),))
    for key, shape in _DEVIATIONS.items():
        if meta[key] is not None:
            values = _numbers(path, key, meta[key], shape if shape != (-1,) else meta["distortion"].shape)
            meta[key] = values if shape else float(values)
    if meta["depth_camera_matrix_px"] is not None:
        own = meta["depth_camera_matrix_px"]
        meta["depth_camera_matrix_px"] = _numbers(path, "depth_camera_matrix_px", own, (3, 3))
    for key in ("T_world_camera", "T_color_depth"):
        if (T := meta[key]) is not None:
            meta[key] = _numbers(path, key, T, (4, 4))
            if not np.allclose(meta[key][3], [0, 0, 0, 1]):
                raise ValueError(f"{path}: {key} has last row {T[3]}; it must be 0 0 0 1 (is it transposed?)")
            if not rigid(meta[key]):
                raise ValueError(f"{path}: {key} {T} is no rotation with a translation (m) beside it")
    return meta


def _numbers(path: Path, key: str, value: object, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = f"{' rows of '.join(map(str, shape))} finite numbers" if shape else "a finite number"
        raise ValueError(f"{path}: {key} {value!r} is not {wanted}")
    return array
