"""Images and arrays as files: PNG, JPEG, .npy and .npz, checked before they are decoded."""

import io
import re
import warnings
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from jaxtyping import Shaped, UInt8
from PIL import Image

from foundation.bounded import check_arrays
from foundation.one_line import one_line
from foundation.png import PNG_MAGIC, check_png
from probnerf.environment import MOST_PIXELS

_JPEG_MAGIC = b"\xff\xd8\xff"
LARGEST = MOST_PIXELS  # and values of an array
_LARGEST_FILE = 1 << 29  # bytes
_TOO_LARGE = f"it says that it is larger than {LARGEST} pixels"
_MOST_SCANS = 100  # of a progressive JPEG, each of which takes as long as a picture
_FILLING = 16  # bytes between the parts of a JPEG; webcams leave up to ten


def read_png(path: Path) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a PNG, colours in OpenCV's order BGR(A). Raises where the file is absent, cut short or damaged."""
    data = _bytes(path)
    if not data.startswith(PNG_MAGIC):
        raise ValueError(f"{path} is not a PNG; save it again as PNG")
    return _decoded(path, data, "PNG")


def read_picture(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The colours (RGB) of a PNG or JPEG. Raises as `read_png`."""
    data = _bytes(path)
    if data.startswith(_JPEG_MAGIC):
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
        raise ValueError(f"{path} cannot be decoded ({error}); copy it again, or save it again as {kind}") from None


def decoded(data: bytes) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a picture in any of OpenCV's formats, colours as BGR(A). Raises `ValueError` if there is none.

    Size, checksums and data are looked at here: OpenCV allocates what a header says, takes missing pixels for black or
    grey, and what follows a damaged byte for pixels.
    """
    if data.startswith(_JPEG_MAGIC):
        image = _decoded_jpeg(data)
        if image is not None:
            return image
    elif data.startswith(PNG_MAGIC):
        check_png(data, LARGEST)
    else:
        _check_size(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error as error:
        if "IO_MAX_IMAGE" in error.err:
            raise ValueError(_TOO_LARGE) from None
        raise ValueError(f"OpenCV: {error.err}") from None
    if image is None:
        raise ValueError("it is no picture, or damaged")
    return image


def _decoded_jpeg(data: bytes) -> UInt8[np.ndarray, "h w *c"] | None:
    """The pixels of a JPEG, BGR or grey; None for four colours. Raises `ValueError` for one that is cut or damaged.

    About half of single wrong bits leave data that fit still: they change one block, or shift what follows unseen.
    """
    if b"\xff\xd9" not in data.rstrip(b"\0")[-64:]:  # its last marker; drivers pad their buffers
        raise ValueError(f"it is cut short at byte {len(data)}")
    try:
        height, width, colours, _ = simplejpeg.decode_jpeg_header(data)
        if height * width > LARGEST:
            raise ValueError(_TOO_LARGE)
        if data.count(b"\xff\xda") > _MOST_SCANS:
            raise ValueError(f"it has more than {_MOST_SCANS} scans")
        if colours not in ("Gray", "YCbCr", "RGB"):
            return None
        space = "GRAY" if colours == "Gray" else "BGR"
        try:
            image = simplejpeg.decode_jpeg(data, space)
        except ValueError as error:
            found = re.search(r"(\d+) extraneous bytes before marker 0xd\d", str(error))
            if not found or (int(found[1]) > _FILLING and not _is_filled(data, int(found[1]))):
                raise ValueError(f"it is damaged: {error}") from None
            image = simplejpeg.decode_jpeg(data, space, strict=False)
    except RuntimeError as error:
        raise ValueError(one_line(error)) from None
    return image[..., 0] if space == "GRAY" else image


def _is_filled(data: bytes, count: int) -> bool:
    """Whether one byte is repeated so often before the end of a JPEG, as cameras do whose pictures have one size."""
    end = data.rindex(b"\xff\xd9")
    return len(set(data[end - count : end])) == 1


def _check_size(data: bytes) -> None:
    """Raises `ValueError` for a picture that says it is too large. One that Pillow does not know is left to OpenCV."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as picture:
                width, height = picture.size
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ValueError(_TOO_LARGE) from None
    except Exception:  # whatever a plugin raises
        return
    if width * height > LARGEST:
        raise ValueError(_TOO_LARGE)
