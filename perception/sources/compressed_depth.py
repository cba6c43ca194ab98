"""Depth as ROS's compressedDepth transport packs it (image_transport_plugins, compressed_depth_image_transport).

A header of 12 bytes, of which two floats a, b make metres of a float image's counts (v > 0: a / (v - b)); then a PNG of
16 bits, or the image's size and its counts by RVL (Wilson, "Fast lossless depth image compression", ISS 2017).
"""

import struct

import numpy as np
from jaxtyping import Float32, Int, Shaped, UInt8, UInt16

from perception.sources.image_files import LARGEST, decoded

_HEADER, _SIZE = 12, 8  # bytes


def unpacked(form: str, data: UInt8[np.ndarray, "n"]) -> Shaped[np.ndarray, "h w"]:
    """Counts of 16 bits (16UC1), or metres, NaN where unknown (32FC1). `form` is the message's format.

    Raises `ValueError` for what is neither.
    """
    content = data[_HEADER:].tobytes()
    if "rvl" in form.lower():
        counts = _rvl(content)
    else:
        counts = decoded(content)
        if counts.dtype == np.float32 or counts.ndim != 2:
            raise ValueError(f"its picture has {counts.dtype} samples and {counts.ndim} dimensions")
    if not form.startswith("32FC1"):
        return counts
    a, b = struct.unpack_from("<2f", data.tobytes(), 4)
    return _metres(counts, a, b)


def _metres(counts: Shaped[np.ndarray, "h w"], a: float, b: float) -> Float32[np.ndarray, "h w"]:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(counts > 0, np.float32(a) / (counts.astype(np.float32) - np.float32(b)), np.float32(np.nan))


def _rvl(content: bytes) -> UInt16[np.ndarray, "h w"]:
    """Runs of zeros and of differences, each number in nibbles: three bits, the lowest first, and one for more."""
    if len(content) < _SIZE:
        raise ValueError("its RVL data is cut short")
    width, height = struct.unpack_from("<2I", content)
    if not 0 < width * height <= LARGEST:
        raise ValueError(f"its RVL data says {width}x{height} px")
    numbers = _numbers(content[_SIZE:])
    counts = np.zeros(width * height, np.int64)
    at, position, previous = 0, 0, 0
    while position < len(counts):
        if at + 2 > len(numbers):
            raise ValueError("its RVL data is cut short")
        position, several = position + int(numbers[at]), int(numbers[at + 1])
        signed = numbers[at + 2 : at + 2 + several]
        if len(signed) < several or position + several > len(counts):
            raise ValueError("its RVL data is cut short")
        run = previous + np.cumsum((signed >> 1) ^ -(signed & 1))
        counts[position : position + several] = run
        previous = int(run[-1]) if several else previous
        at, position = at + 2 + several, position + several
    return counts.astype(np.uint16).reshape(height, width)


def _numbers(content: bytes) -> Int[np.ndarray, "n"]:
    """All the numbers, in order: nibbles from the highest of each little-endian word of 32 bits."""
    words = np.frombuffer(content[: len(content) // 4 * 4], "<u4")
    nibbles = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        return np.zeros(0, np.int64)
    nibbles = nibbles[: ends[-1] + 1]
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(nibbles)) - np.repeat(starts, ends - starts + 1)
    if (ends - starts).max() > 10:  # a count of 16 bits has at most 6 nibbles, a run's length at most 11
        raise ValueError("its RVL data is damaged")
    return np.add.reduceat((nibbles & 7) << (3 * place), starts)
