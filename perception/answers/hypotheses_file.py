"""The hypotheses file: one object's `Hypotheses` on disk, and a folder of them.

The file is a NumPy `.npz` without pickles. `header` holds the UTF-8 bytes of a JSON object with `format` and the scalar
fields of `Hypotheses` and of its ObjectFrame by their own names, and with `diagnostics`, an object of numbers by name
(`AnswerDiagnostics`); the arrays `opacity`, `pose`, `weights`, `population`, `seen`, `T_camera_object`, `plane` and,
where it is known, `T_world_camera` are the fields of those names. Equal content gives equal bytes.
"""

import io
import itertools
import json
import re
import zipfile
import zlib
from pathlib import Path

import numpy as np

from foundation.bounded import check_arrays, parse_json
from foundation.whole_file import write_whole
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from probnerf.types import StopReason

FORMAT = "farside-hypotheses-"
VERSION = 2  # 1: poses without z
# What `save` writes: the header's fields by their JSON types, and the arrays by the kinds of their samples.
_HEADER: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("stamp_ns", "object_id", "stage", "seed"), (int,)),
    **dict.fromkeys(("half_extent", "xy_sigma", "log_scale_sigma", "along_sigma"), (int, float)),
    **dict.fromkeys(("sight_sigma", "monte_carlo_error"), (int, float)),
    **dict.fromkeys(("frame_id", "label", "prior_hash", "result"), (str,)),
    **dict.fromkeys(("inside_view", "out_of_model"), (bool,)),
    **dict.fromkeys(("diagnostics", "kinds"), (dict,)),
}
_SAMPLES = {
    **dict.fromkeys(("pose", "weights", "T_camera_object", "plane", "T_world_camera"), "f"),
    "population": "iu",
}
_ARRAYS = ("header", "opacity", "seen", *_SAMPLES)


def hypotheses_path(folder: str | Path, object_id: int) -> Path:
    """Where one object's hypotheses lie in a folder; the folder is joint over all its objects."""
    return Path(folder) / f"object_{object_id}.npz"


def frame_path(folder: str | Path) -> Path:
    """The frame folder that is kept beside a folder's hypotheses: the frame that they were inferred from."""
    return Path(folder) / "frame"


def save(path: str | Path, hypotheses: Hypotheses) -> None:
    """Write the file whole or not at all (a temporary file beside it, then a rename). Raises OSError that names it."""
    path, content = Path(path), content_of(hypotheses)
    try:
        write_whole(path, content)
    except OSError as error:
        if error.strerror is None:  # said already
            raise
        raise OSError(
            f"{path} cannot be written ({error.strerror or error}); make room or give another place"
        ) from None


def content_of(hypotheses: Hypotheses) -> bytes:
    """The file of hypotheses. Equal ones give equal bytes."""
    h = hypotheses
    header = {
        "format": f"{FORMAT}{VERSION}",
        "stamp_ns": int(h.stamp_ns),
        "frame_id": h.frame_id,
        "object_id": int(h.object_id),
        "label": h.label,
        "half_extent": float(h.object_frame.half_extent),
        "xy_sigma": float(h.object_frame.xy_sigma),
        "log_scale_sigma": float(h.object_frame.log_scale_sigma),
        "along_sigma": float(h.object_frame.along_sigma),
        "sight_sigma": float(h.object_frame.sight_sigma),
        "inside_view": bool(h.inside_view),
        "out_of_model": bool(h.out_of_model),
        "stage": int(h.stage),
        "monte_carlo_error": float(h.monte_carlo_error),
        "prior_hash": h.prior_hash,
        "seed": int(h.seed),
        "diagnostics": h.diagnostics.as_mapping(),
        "result": h.result,
        "kinds": {name: float(p) for name, p in h.kinds.items()},
    }
    arrays = {
        "header": np.frombuffer(json.dumps(header, sort_keys=True).encode(), np.uint8),
        "opacity": h.opacity,
        "pose": np.asarray(h.pose, np.float32),
        "weights": np.asarray(h.weights, np.float64),
        "population": np.asarray(h.population, np.int32),
        "seen": np.asarray(h.seen, bool),
        "T_camera_object": np.asarray(h.object_frame.T_camera_object, np.float64),
        "plane": np.asarray(h.object_frame.plane, np.float64),
    }
    if h.T_world_camera is not None:
        arrays["T_world_camera"] = np.asarray(h.T_world_camera, np.float64)
    file = io.BytesIO()
    # Not np.savez_compressed, whose level of compression takes six times as long for a seventh less. Members opened
    # by name carry zip's zero date, so that equal content gives equal bytes.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    return file.getvalue()


def load(path: str | Path) -> Hypotheses:
    """Read a hypotheses file.

    Raises FileNotFoundError, or ValueError with one line for a file of another kind, one cut short or damaged, and one
    written by a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; `farside replay` writes hypotheses files")
    if not zipfile.is_zipfile(path):  # the table of contents stands at a zip file's end
        with path.open("rb") as file:
            cut = file.read(4) == b"PK\x03\x04"
        raise ValueError(
            f"{path} is cut short at byte {path.stat().st_size}; write it again with `farside replay`"
            if cut
            else f"{path} is not a hypotheses file; give one that `farside replay` wrote"
        )
    damaged = f"{path} is damaged ({{}}); write it again with `farside replay`"
    try:
        check_arrays(path, {name.lower() for name in _ARRAYS})
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name in _ARRAYS}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ValueError(damaged.format(error)) from error
    header = _header(path, arrays)
    try:
        return _from_file(header, arrays)
    except KeyError as error:
        raise ValueError(damaged.format(f"it has no field {error}")) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(damaged.format(error)) from error


def load_scene(path: str | Path) -> list[Hypotheses]:
    """A hypotheses file, or all objects' files (object_<id>.npz) in a folder that `farside replay` wrote, by object id.

    Raises as `load`, and where two files of a folder hold the same object, for then it would be counted twice.
    """
    path = Path(path)
    if not path.is_dir():
        return [load(path)]
    files = sorted(file for file in path.glob("object_*.npz") if re.fullmatch(r"object_\d+\.npz", file.name))
    if not files:
        raise FileNotFoundError(f"{path} holds no object_<id>.npz; give a folder that `farside replay` wrote")
    scene = sorted((load(file) for file in files), key=lambda h: h.object_id)
    for h, other in itertools.pairwise(scene):
        if h.object_id == other.object_id:
            raise ValueError(f"{path} holds object {h.object_id} in two files; remove the one that is a copy")
    return scene


def _header(path: Path, arrays: dict[str, np.ndarray]) -> dict:
    """The JSON header, its format checked."""
    try:
        header = parse_json(arrays["header"].tobytes())
        name = header["format"]  # a TypeError where the header is no mapping
        prefix, version = name[: len(FORMAT)], int(name[len(FORMAT) :])
    except (AttributeError, KeyError, TypeError, ValueError):
        prefix, version = "", 0
    if prefix != FORMAT:
        raise ValueError(f"{path} is not a hypotheses file; give one that `farside replay` wrote")
    if version > VERSION:
        raise ValueError(f"{path} has format {name}, newer than this Farside reads ({FORMAT}{VERSION}): update Farside")
    return header


def _check_types(header: dict, arrays: dict[str, np.ndarray]) -> None:
    """Raises ValueError for a field or an array that `save` would not have written so. Absent ones are left alone."""
    for name, samples in _SAMPLES.items():
        if name in arrays and arrays[name].dtype.kind not in samples:
            raise ValueError(f"{name} holds {arrays[name].dtype}")
    for name, kinds in _HEADER.items():
        if name not in header:
            continue
        value = header[name]
        # JSON's true is an int to Python, and its numbers have any length
        if type(value) not in kinds or (isinstance(value, int) and abs(value) >= 2**63):
            raise ValueError(f"{name} is {str(value)[:40]}")


def _from_file(header: dict, arrays: dict[str, np.ndarray]) -> Hypotheses:
    """The inverse of `save`; raises KeyError for a missing field, ValueError for one of another type."""
    _check_types(header, arrays)
    frame = ObjectFrame(
        T_camera_object=arrays["T_camera_object"],
        half_extent=header["half_extent"],
        plane=arrays["plane"],
        xy_sigma=header["xy_sigma"],
        log_scale_sigma=header["log_scale_sigma"],
        along_sigma=header.get("along_sigma", 0.0),  # files before these had depth
        sight_sigma=header.get("sight_sigma", 0.0),
    )
    return Hypotheses(
        stamp_ns=header["stamp_ns"],
        frame_id=header["frame_id"],
        object_id=header["object_id"],
        label=header["label"],
        object_frame=frame,
        T_world_camera=arrays.get("T_world_camera"),
        opacity=arrays["opacity"],
        pose=np.pad(arrays["pose"], ((0, 0), (0, 1))) if header["format"] == f"{FORMAT}1" else arrays["pose"],
        weights=arrays["weights"],
        population=arrays["population"],
        seen=arrays["seen"],
        inside_view=header["inside_view"],
        out_of_model=header["out_of_model"],
        stage=header["stage"],
        monte_carlo_error=header["monte_carlo_error"],
        prior_hash=header["prior_hash"],
        seed=header["seed"],
        diagnostics=AnswerDiagnostics.from_mapping(header["diagnostics"]),
        result=StopReason(header["result"]),
        kinds=header.get("kinds", {}),  # files before these had none
    )
