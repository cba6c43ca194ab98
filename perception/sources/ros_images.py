"""Image messages as arrays. Messages are read by their fields, whichever library decoded them."""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped, UInt8
from scipy.spatial.transform import Rotation

from perception.sources.compressed_depth import unpacked
from perception.sources.frame import known_counts
from perception.sources.image_files import colour_to_rgb, decoded

POSE_TOPIC = "/camera/color/pose"  # where a Farside recording keeps T_world_camera (geometry_msgs/PoseStamped)
MM = np.float32(1e-3)
# Encoding -> sample type and channels.
_STRAIGHT = {
    **{"rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1)},
    **{"8UC3": ("u1", 3), "8UC4": ("u1", 4)},  # in OpenCV's order
    **{"rgb16": ("u2", 3), "bgr16": ("u2", 3), "rgba16": ("u2", 4), "bgra16": ("u2", 4)},
}
_BAYER = {f"bayer_{p}{bits}": (f"u{bits // 8}", 1) for p in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)}
_YUV = {  # by OpenCV's codes
    **dict.fromkeys(("yuv422", "uyvy"), cv2.COLOR_YUV2RGB_UYVY),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), cv2.COLOR_YUV2RGB_YUYV),
    "nv12": cv2.COLOR_YUV2RGB_NV12,
    "nv21": cv2.COLOR_YUV2RGB_NV21,
}
COLOURS = _STRAIGHT | _BAYER | {name: ("u1", 1 if name.startswith("nv") else 2) for name in _YUV}
_ENCODINGS = COLOURS | {"8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1), "32FC1": ("f4", 1)}
_ENCODINGS |= {"32SC1": ("i4", 1)}  # labels
_SPELT = {name.lower(): name for name in _ENCODINGS}  # drivers write BGR8, YUYV and NV12, too


def stamp_ns(message: Any) -> int:
    """The header's stamp; 0 where the driver left it empty."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def encoding_of(message: Any) -> str:
    """The encoding of the pixels, as ROS spells it; of a CompressedImage what its format says before ';', else 16UC1
    for compressedDepth, else what its PNG says, else bgr8 ("jpeg").
    """
    if hasattr(message, "encoding"):
        return _SPELT.get(message.encoding.lower(), message.encoding)
    first = message.format.split(";")[0].strip().lower()
    if first in _SPELT:
        return _SPELT[first]
    if "compressedDepth" in message.format:
        return "16UC1"
    start = bytes(message.data[:26])
    if start.startswith(b"\x89PNG") and len(start) == 26 and start[25] == 0:  # a PNG of one channel
        return "16UC1" if start[24] == 16 else "mono8"
    return "bgr8"


def to_rgb(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    """A colour image. Raises `ValueError` if the message does not hold one."""
    encoding = encoding_of(message) if hasattr(message, "encoding") else ""
    image = _whole(message) if encoding.startswith("nv") else samples(message)
    if image.dtype == np.uint16 and (encoding in COLOURS or image.ndim == 3):
        image = (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"colour has {image.dtype} samples; record it with 8 bits a channel")
    if not encoding and image.ndim == 2 and not message.format.endswith("mono8"):
        encoding = encoding_of(message)  # of a mosaic that was packed as it is
    if encoding in _BAYER:
        return cv2.cvtColor(image, getattr(cv2, f"COLOR_BAYER_{encoding[6:10].upper()}2RGB"))
    if encoding in _YUV and (image.shape[1] % 2 or (encoding.startswith("nv") and message.height % 2)):
        raise ValueError(f"{message.width}x{message.height} px of {encoding} have no pairs; record an even size")
    if encoding in _YUV:
        return cv2.cvtColor(image, _YUV[encoding])
    return np.ascontiguousarray(image[..., :3]) if encoding.startswith("rgb") else colour_to_rgb(image)


def to_depth(message: Any) -> Float32[np.ndarray, "h w"]:
    """A depth image in metres (REP 118: integers are millimetres), 0 or NaN where unknown; so is the count 65535."""
    image = _plane(message)
    if image.dtype == np.uint8:
        raise ValueError("depth has 8 bits a pixel; record it as 16UC1 or 32FC1, or packed as a PNG of 16 bits")
    return known_counts(image) * MM if image.dtype.kind == "u" else image.astype(np.float32)


def to_label(message: Any) -> Int32[np.ndarray, "h w"]:
    """An image of object ids."""
    image = _plane(message)
    if image.dtype.kind not in "ui":
        raise ValueError(f"label has {image.dtype} samples; record it as mono8 or 16UC1")
    return image.astype(np.int32)


def to_transform(pose: Any) -> Float[np.ndarray, "4 4"]:
    """T_frame_thing of a PoseStamped: frame is its header's, thing is what has the pose. `ValueError`: no rotation."""
    p, q = pose.pose.position, pose.pose.orientation
    if not np.isfinite([p.x, p.y, p.z, q.x, q.y, q.z, q.w]).all():
        raise ValueError("its pose is not finite")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = [p.x, p.y, p.z]
    return T


def samples(message: Any) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of an image as they were recorded; a CompressedImage is decoded, to BGR(A) or one channel.

    Of nv12 and nv21 they are the brightness alone.
    """
    if hasattr(message, "encoding"):
        return _whole(message)[: message.height]
    data = np.asarray(message.data, dtype=np.uint8)
    try:
        return unpacked(message.format, data) if "compressedDepth" in message.format else decoded(data.tobytes())
    except ValueError as error:
        raise ValueError(f"cannot decode {message.format!r} ({error}); record it as PNG, JPEG or raw") from None


def _whole(message: Any) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of a raw image; of nv12 and nv21 with the rows of colour, half as many, below."""
    data, encoding = np.asarray(message.data, dtype=np.uint8), encoding_of(message)
    if encoding not in _ENCODINGS:
        raise ValueError(f"encoding {encoding!r} is not read; record rgb8, bgr8, bayer, yuv422, nv12, 16UC1 or 32FC1")
    sample, channels = _ENCODINGS[encoding]
    dtype = np.dtype(sample).newbyteorder(">" if message.is_bigendian else "<")
    height, width, size = message.height, message.width, message.width * channels * dtype.itemsize
    height += height // 2 * encoding.startswith("nv")
    step = size if message.step == 0 and data.size == size * height else message.step  # 0: rows without padding
    if step < size or data.size < step * height:
        what = f"{data.size} bytes in rows of {step} do not hold {width}x{height} px of {encoding}"
        raise ValueError(f"{what}; record it again, or mend the driver's step")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :size])
    image = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return image.reshape((height, width, channels) if channels > 1 else (height, width))


def _plane(message: Any) -> Shaped[np.ndarray, "h w"]:
    image = samples(message)
    if image.ndim != 2:
        raise ValueError(f"image has {image.shape[2]} channels; one is wanted")
    return image
