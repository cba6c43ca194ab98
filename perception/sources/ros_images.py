"""Image and camera_info messages as arrays. Messages are read by their fields, whichever library decoded them."""

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped, UInt8
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from perception.sources.frame import known_counts
from perception.sources.image_files import colour_to_rgb, decoded

POSE_TOPIC = "/camera/color/pose"  # where a Farside recording keeps T_world_camera (geometry_msgs/PoseStamped)
MM = np.float32(1e-3)
# Encoding -> sample type and channels.
COLOURS = {"rgb8": ("u1", 3), "bgr8": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1)}
_ENCODINGS = COLOURS | {"8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1), "32FC1": ("f4", 1)}


def stamp_ns(message: Any) -> int:
    """The header's stamp; 0 where the driver left it empty."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def encoding_of(message: Any) -> str:
    """The encoding of the pixels; of a CompressedImage what its format says before ';', else bgr8 ("jpeg")."""
    if hasattr(message, "encoding"):
        return message.encoding
    first = message.format.split(";")[0].strip()
    return first if first in _ENCODINGS else "bgr8"


def to_rgb(message: Any) -> UInt8[np.ndarray, "h w 3"]:
    """A colour image. Raises `ValueError` if the message does not hold one."""
    image = samples(message)
    if image.dtype != np.uint8:
        raise ValueError(f"colour has {image.dtype} samples; record it with 8 bits a channel")
    straight = hasattr(message, "encoding") and message.encoding.startswith("rgb")
    return np.ascontiguousarray(image[..., :3]) if straight else colour_to_rgb(image)


def to_depth(message: Any) -> Float32[np.ndarray, "h w"]:
    """A depth image in metres (REP 118: integers are millimetres), 0 or NaN where unknown; so is the count 65535."""
    image = _plane(message)
    return known_counts(image) * MM if image.dtype.kind == "u" else image.astype(np.float32)


def to_label(message: Any) -> Int32[np.ndarray, "h w"]:
    """An image of object ids."""
    image = _plane(message)
    if image.dtype.kind != "u":
        raise ValueError(f"label has {image.dtype} samples; record it as mono8 or 16UC1")
    return image.astype(np.int32)


def to_camera(info: Any, rectified: bool) -> Camera:
    """The camera of a CameraInfo, for the raw image, or for the rectified one (then P holds its matrix)."""
    K, D, P = (getattr(info, name if hasattr(info, name) else name.upper()) for name in "kdp")  # ROS 1 wrote K, D, P
    if rectified:
        return Camera(info.width, info.height, np.reshape(P, (3, 4))[:, :3], np.zeros(5))
    if len(D) == 0:  # no distortion, which a fisheye spells with four zeros
        fisheye = info.distortion_model in ("equidistant", "fisheye")
        D, model = (np.zeros(4), "equidistant") if fisheye else (np.zeros(5), "plumb_bob")
        return Camera(info.width, info.height, np.reshape(K, (3, 3)), D, model)
    return Camera(info.width, info.height, np.reshape(K, (3, 3)), D, info.distortion_model)


def to_transform(pose: Any) -> Float[np.ndarray, "4 4"]:
    """T_frame_thing of a PoseStamped: frame is its header's, thing is what has the pose. `ValueError`: no rotation."""
    p, q = pose.pose.position, pose.pose.orientation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = [p.x, p.y, p.z]
    return T


def samples(message: Any) -> Shaped[np.ndarray, "h w *c"]:
    """The samples of an image as they were recorded; a CompressedImage is decoded, to BGR(A) or one channel."""
    data = np.asarray(message.data, dtype=np.uint8)
    encoding = encoding_of(message)
    if not hasattr(message, "encoding"):
        if "compressedDepth" in message.format:
            data = data[12:]  # the transport's header, which only 32FC1 needs
        try:
            if encoding == "32FC1":
                raise ValueError("floats are not read")
            return decoded(data.tobytes())
        except ValueError as error:
            raise ValueError(f"cannot decode {message.format!r} ({error}); record it as PNG, JPEG or raw") from None
    if encoding not in _ENCODINGS:
        raise ValueError(f"encoding {encoding!r} is not read; record one of {', '.join(_ENCODINGS)}")
    sample, channels = _ENCODINGS[encoding]
    dtype = np.dtype(sample).newbyteorder(">" if message.is_bigendian else "<")
    height, width, size = message.height, message.width, message.width * channels * dtype.itemsize
    if message.step < size or data.size < message.step * height:
        raise ValueError(f"{data.size} bytes do not hold {width}x{height} px of {encoding}; record it again")
    rows = np.ascontiguousarray(data[: message.step * height].reshape(height, message.step)[:, :size])
    image = rows.view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return image.reshape((height, width, channels) if channels > 1 else (height, width))


def _plane(message: Any) -> Shaped[np.ndarray, "h w"]:
    image = samples(message)
    if image.ndim != 2:
        raise ValueError(f"image has {image.shape[2]} channels; one is wanted")
    return image
