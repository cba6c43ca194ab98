"""Where frames come from: the Frame itself, the frame folder, and the choice between folder and log."""

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped, UInt8

from calibration.camera import Camera

# The recording that ships with the project, read when no source is named.
SHIPPED_LOG = Path(__file__).parent / "shipped.mcap"
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture with its camera. Colour, depth and label share pixels. Raises `ValueError` where they do not."""

    stamp_ns: int
    frame_id: str
    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"] | None  # m along z, NaN where unknown
    label: Int32[np.ndarray, "h w"] | None  # object id per pixel, 0 for none
    camera: Camera
    T_world_camera: Float[np.ndarray, "4 4"] | None = None

    def __post_init__(self) -> None:
        rgb = np.asarray(self.rgb)
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ValueError(f"colour is {rgb.dtype}{list(rgb.shape)}; uint8[height, width, 3] wanted")
        height, width = rgb.shape[:2]
        if (self.camera.width, self.camera.height) != (width, height):
            raise ValueError(
                f"the camera is calibrated at {self.camera.width}x{self.camera.height} px but colour is"
                f" {width}x{height} px; use the calibration of this image size"
            )
        for name, dtype in (("depth", np.float32), ("label", np.int32)):
            plane = getattr(self, name)
            if plane is None:
                continue
            if plane.shape != (height, width):
                size = "x".join(map(str, plane.shape[::-1]))
                raise ValueError(f"{name} is {size} px but colour is {width}x{height}; align {name} to colour")
            object.__setattr__(self, name, np.asarray(plane, dtype=dtype))
        if self.depth is not None:  # a sensor's zero or infinity is no distance
            with np.errstate(invalid="ignore"):
                valid = np.isfinite(self.depth) & (self.depth > 0)
            object.__setattr__(self, "depth", np.where(valid, self.depth, np.float32(np.nan)))


class Source(Protocol):
    """Frames in time order, once or more, and notes about what was missing (final when the iteration has ended)."""

    @property
    def notes(self) -> list[str]: ...

    def __iter__(self) -> Iterator[Frame]: ...


@dataclass(frozen=True)
class StillSource:
    """Frames that are already in memory."""

    frames: tuple[Frame, ...]
    notes: list[str] = field(default_factory=list)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


def open_source(path: Path | str | None) -> Source:
    """The source at `path`: a frame folder (it holds color.png), else a log; None is the log shipped with the project.

    Raises `FileNotFoundError` or `ValueError` with one line that names the file and the remedy.
    """
    path = SHIPPED_LOG if path is None else Path(path)
    if (path / "color.png").exists() or (path / "meta.json").exists():
        return StillSource((read_frame_folder(path),))
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist; give a frame folder (color.png, depth.png, meta.json)"
            " or a recording (.mcap, .bag, ROS 2 bag folder)"
        )
    from perception.log import Log  # here, because log.py makes Frames; and a folder needs no log libraries

    return Log(path)


def read_frame_folder(path: Path | str) -> Frame:
    """The frame in a folder: color.png, depth.png (16 bit, 0 for unknown), meta.json, and label.png where there is one.

    meta.json gives `camera_matrix_px` (3x3) and `depth_unit_m` (m per count); whatever else it holds is not read.
    The stamp is 0: a folder has no time. Raises `FileNotFoundError` or `ValueError` naming the file and the remedy.
    """
    path = Path(path)
    K, unit = _read_meta(path / "meta.json")
    colour = read_png(path / "color.png")
    if colour.dtype != np.uint8:
        raise ValueError(f"{path / 'color.png'} has {colour.dtype} samples; save it with 8 bits a channel")
    rgb = colour_to_rgb(colour)
    height, width = rgb.shape[:2]
    counts = read_png(path / "depth.png")
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise ValueError(f"{path / 'depth.png'} is {counts.dtype}{list(counts.shape)}; save one channel of 16 bits")
    label = read_png(path / "label.png") if (path / "label.png").exists() else None
    if label is not None and label.ndim != 2:
        raise ValueError(f"{path / 'label.png'} has {label.shape[2]} channels; save one channel of object ids")
    for name, image in (("depth.png", counts), ("label.png", label)):
        if image is not None and image.shape != (height, width):
            raise ValueError(
                f"{path / name} is {image.shape[1]}x{image.shape[0]} px but color.png is {width}x{height};"
                f" align {name} to color.png"
            )
    depth = (counts * np.float64(unit)).astype(np.float32)  # Frame turns 0 into NaN
    try:
        camera = Camera(width, height, K, np.zeros(5))
    except ValueError as error:
        raise ValueError(f"{path / 'meta.json'}: {error}") from None
    return Frame(0, "camera", rgb, depth, None if label is None else label.astype(np.int32), camera)


def read_png(path: Path) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a PNG, colours in OpenCV's order BGR(A). Raises where the file is absent, cut short or damaged."""
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} is missing; a frame folder holds color.png, depth.png and meta.json") from None
    if not data.startswith(_PNG_MAGIC):
        raise ValueError(f"{path} is not a PNG; save it again as PNG")
    # OpenCV fills what is missing with zeros and only prints a warning, so the chunks are checked first.
    at, kind = len(_PNG_MAGIC), b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + size
        if end > len(data):
            raise ValueError(f"{path} is cut short at byte {len(data)}; copy it again")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ValueError(f"{path} is damaged near byte {at}; copy it again")
        at = end
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{path} cannot be decoded; save it again as PNG")
    return image


def colour_to_rgb(image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    """RGB from what OpenCV decodes: grey, BGR or BGRA."""
    if image.ndim == 2 or image.shape[2] == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(image[:, :, 2::-1])


def _read_meta(path: Path) -> tuple[Float[np.ndarray, "3 3"], float]:
    """camera_matrix_px and depth_unit_m."""
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} is missing; it gives camera_matrix_px and depth_unit_m") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not JSON ({error}); write it again") from None
    for key in ("camera_matrix_px", "depth_unit_m"):
        if not isinstance(meta, dict) or key not in meta:
            raise ValueError(f"{path} has no {key}; add it (3x3 in px, and metres per count of depth.png)")
    unit = meta["depth_unit_m"]
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit <= 1:
        raise ValueError(f"{path}: depth_unit_m is {unit!r}; give metres per count, such as 0.001")
    try:
        return np.array(meta["camera_matrix_px"], dtype=np.float64), float(unit)
    except (TypeError, ValueError):
        raise ValueError(f"{path}: camera_matrix_px {meta['camera_matrix_px']!r} is not 3 rows of 3 numbers") from None
