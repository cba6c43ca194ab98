"""Images and arrays as files: PNG, JPEG, .npy and .npz, checked before they are decoded."""

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from foundation.bounded import check_arrays
from foundation.one_line import one_line
from probnerf.environment import MOST_PIXELS

_PNG_MAGIC, _JPEG_MAGIC = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
LARGEST = MOST_PIXELS  # and values of an array
_LARGEST_FILE = 1 << 29  # bytes


def read_png(path: Path) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a PNG, colours in OpenCV's order BGR(A). Raises where the file is absent, cut short or damaged."""
    data = _bytes(path)
    if not data.startswith(_PNG_MAGIC):
        raise ValueError(f"{path} is not a PNG; save it again as PNG")
    # OpenCV fills missing data with zeros and only prints a warning, so the chunks are checked first.
    at, kind = len(_PNG_MAGIC), b""
    while kind != b"IEND":
        size = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + size
        if end > len(data):
            raise ValueError(f"{path} is cut short at byte {len(data)}; copy it again")
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise ValueError(f"{path} is damaged near byte {at}; copy it again")
        at = end
    return _decoded(path, data, "PNG")


def read_picture(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The colours (RGB) of a PNG or JPEG. Raises as `read_png`."""
    data = _bytes(path)
    if data.startswith(_JPEG_MAGIC):
        if not _is_whole_jpeg(data):
            raise ValueError(f"{path} is cut short at byte {len(data)}; copy it again")
        image = _decoded(path, data, "JPEG")
    else:
        image = read_png(path)
    if image.dtype != np.uint8:
        raise ValueError(f"{path} has {image.dtype} samples; save it with 8 bits a channel")
    return colour_to_rgb(image)


def colour_to_rgb(image: UInt8[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    """RGB from what OpenCV decodes: grey, BGR or BGRA."""
    if image.ndim == 2 or image.shape[2] == 1:
        return np.repeat(image.reshape(*image.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(image[:, :, 2::-1])


def read_npy(path: Path) -> Shaped[np.ndarray, "..."]:
    """The array in a .npy file. Raises `ValueError` for one that is damaged, too large, or holds Python objects."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing")
    try:
        with np.errstate(over="ignore"):
            values = np.load(path, allow_pickle=False, mmap_mode="r")
    except Exception as error:  # NumPy parses the header as Python, which has many ways to fail
        raise ValueError(f"{path} is not a whole .npy file ({one_line(error)[:200]}); save it again") from None
    return _plain(str(path), values)


def read_npz(path: Path, names: Sequence[str]) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Those arrays of a .npz file whose names are among `names`, whatever their case. Raises as `read_npy`."""
    wanted = {name.lower() for name in names}
    try:
        try:
            check_arrays(path, wanted, 8 * LARGEST)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; give one frame") from None
        with np.load(path, allow_pickle=False) as arrays:
            chosen = [name for name in arrays.files if name.lower() in wanted]
            return {name.lower(): _plain(f"{path}: {name}", _loaded(path, arrays, name)) for name in chosen}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, SyntaxError) as error:
        if isinstance(error, FileNotFoundError):
            raise FileNotFoundError(f"{path} is missing") from None
        raise ValueError(f"{path} is not a whole .npz file ({' '.join(str(error).split())}); save it again") from None


def _loaded(path: Path, arrays: Mapping[str, np.ndarray], name: str) -> Shaped[np.ndarray, "..."]:
    try:
        return arrays[name]
    except ValueError as error:
        raise ValueError(f"{path}: {name} cannot be read ({one_line(error)[:200]}); save numbers") from None


def _plain(name: str, values: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    if values.size > LARGEST:
        raise ValueError(f"{name} has {values.size} values; give one frame")
    if values.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {values.dtype}; save numbers")
    return np.array(values)


def _bytes(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_FILE + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} is missing; a frame folder holds color.png, depth.png and meta.json") from None
    if len(data) > _LARGEST_FILE:
        raise ValueError(f"{path} has more than {_LARGEST_FILE >> 20} MB; give one picture")
    return data


def _decoded(path: Path, data: bytes, kind: str) -> Shaped[np.ndarray, "h w *c"]:
    try:
        return decoded(data)
    except ValueError as error:
        raise ValueError(f"{path} cannot be decoded ({error}); save it again as {kind}") from None


def decoded(data: bytes) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a picture in any of OpenCV's formats, colours as BGR(A). Raises `ValueError` if there is none.

    Of a PNG, size and data are looked at first, and the end of a JPEG: OpenCV takes missing pixels for black or grey.
    """
    if data.startswith(_PNG_MAGIC):
        _check_png(data)
    if data.startswith(_JPEG_MAGIC) and not _is_whole_jpeg(data):
        raise ValueError(f"it is cut short at byte {len(data)}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error as error:
        if "IO_MAX_IMAGE" in error.err:
            raise ValueError(f"it says that it is larger than {LARGEST} pixels") from None
        raise ValueError(f"OpenCV: {error.err}") from None
    if image is None:
        raise ValueError("it is no picture, or damaged")
    return image


def _is_whole_jpeg(data: bytes) -> bool:
    return b"\xff\xd9" in data.rstrip(b"\0")[-64:]  # its last marker; drivers pad their buffers


def _check_png(data: bytes) -> None:
    """Raises `ValueError` for a PNG that is too large, or has not as many pixels as it says."""
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    bits, colours, interlaced = data[24:25], data[25:26], data[28:29]
    if width * height > LARGEST:
        raise ValueError(f"it is {width}x{height} px; give at most {LARGEST} pixels")
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colours[0]) if colours else None
    if not channels or interlaced != b"\0":  # an interlaced one's rows are counted otherwise
        return
    wanted = height * (1 + (width * channels * bits[0] + 7) // 8)
    at, inflate, have = len(_PNG_MAGIC), zlib.decompressobj(), 0
    while at + 12 <= len(data):
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if kind == b"IDAT":
            try:
                have += len(inflate.decompress(data[at + 8 : at + 8 + size], wanted + 1))
            except zlib.error:
                break
        at += 12 + size
    if have < wanted:
        raise ValueError(f"its pixels end after {have} of {wanted} bytes")
