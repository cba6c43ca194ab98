"""Frame, the type that every source yields, and the protocol of a source."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped, UInt8

from calibration.camera import Camera
from probnerf.geometry import rigid

SATURATED = 65535  # depth count of 16 bits
LAST_STAMP = 2**31 * 10**9  # ns; ROS counts its seconds in 32 bits

_FARTHEST_MEDIAN = 200.0  # m
_FARTHEST = 1e7  # m, of a camera from the world's origin (UTM's northings end there)


@dataclass(frozen=True, eq=False, init=False)
class Frame:
    """One picture with its camera. Colour, depth and label share pixels.

    `camera` may be given as its 3x3 matrix K (px; pixel centres at whole numbers), for a lens without distortion.
    Raises `ValueError` if sizes, types, the stamp or the pose do not fit.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"] | None  # m along z, NaN where unknown
    camera: Camera
    label: Int32[np.ndarray, "h w"] | None  # object id per pixel, 0 for none
    stamp_ns: int  # since the epoch
    frame_id: str  # of the camera's optical frame: x right, y down, z forward
    T_world_camera: Float[np.ndarray, "4 4"] | None  # p_world = T_world_camera @ p_camera, metres

    def __init__(
        self,
        rgb: UInt8[np.ndarray, "h w 3"],
        depth: Shaped[np.ndarray, "h w"] | None,
        camera: Camera | Float[np.ndarray, "3 3"],
        label: Shaped[np.ndarray, "h w"] | None = None,
        stamp_ns: int = 0,
        frame_id: str = "camera",
        T_world_camera: Float[np.ndarray, "4 4"] | None = None,
    ) -> None:
        rgb = np.asarray(rgb)
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ValueError(f"colour is {rgb.dtype}{list(rgb.shape)}; uint8[height, width, 3] wanted")
        height, width = rgb.shape[:2]
        if not isinstance(camera, Camera):
            camera = Camera(width, height, camera, np.zeros(5))
        if (camera.width, camera.height) != (width, height):
            raise ValueError(
                f"the camera is calibrated at {camera.width}x{camera.height} px but colour is"
                f" {width}x{height} px; use the calibration of this image size"
            )
        if not 0 <= stamp_ns < LAST_STAMP:
            raise ValueError(
                f"the stamp is {stamp_ns} ns; give nanoseconds since 1970, from 0 to {LAST_STAMP}: set the clock that"
                " stamps the images"
            )
        if T_world_camera is not None and not (
            np.shape(T_world_camera) == (4, 4) and rigid(T_world_camera) and np.abs(T_world_camera).max() <= _FARTHEST
        ):
            raise ValueError(f"T_world_camera {T_world_camera} is no rotation with a translation (m) beside it")
        if depth is not None:  # a sensor's zero or infinity is no distance
            depth = _plane("depth", depth, np.float32, rgb)
            _check_metres(depth)
            with np.errstate(invalid="ignore"):
                depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
            depth.flags.writeable = False  # what is computed from a frame is kept for it
        if label is not None:
            label = _plane("label", label, np.int32, rgb)
        values = (rgb, depth, camera, label, stamp_ns, frame_id, T_world_camera)
        for field_, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, field_.name, value)


def known_counts(counts: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "h w"]:
    """Depth counts with 0 in place of 65535, which in 16 bits is not a distance.

    Some drivers write it for unknown depth (time-of-flight cameras, saturated pixels). For others it is the largest
    count, which stands for anything farther.
    """
    return np.where(counts == SATURATED, counts.dtype.type(0), counts)


def _check_metres(depth: Float32[np.ndarray, "h w"]) -> None:
    """Raises `ValueError` for depth that cannot be metres: millimetres are the usual mistake."""
    few = depth[::8, ::8]
    few = few[np.isfinite(few) & (few > 0)]
    if len(few) and (median := float(np.median(few))) > _FARTHEST_MEDIAN:
        raise ValueError(f"depth has a median of {median:.0f}; give metres (millimetres divided by 1000)")


def _plane(name: str, values: Shaped[np.ndarray, "h w"], dtype: type, rgb: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    """One value a pixel of `rgb`. Raises `ValueError` for another size."""
    plane: np.ndarray = np.asarray(values, dtype=dtype)
    if plane.shape != rgb.shape[:2]:
        size = "x".join(map(str, plane.shape[::-1]))
        raise ValueError(f"{name} is {size} px but colour is {rgb.shape[1]}x{rgb.shape[0]}; align {name} to colour")
    return plane


class Source(Protocol):
    """Frames in time order, once or more, and notes about what was missing (final when the iteration has ended).

    A `live` source yields frames as the camera takes them. `close`, from any thread, ends the iteration and releases
    the device; the source cannot be used afterwards. A source that is not live need not be closed.
    """

    @property
    def live(self) -> bool: ...

    @property
    def notes(self) -> list[str]: ...

    def close(self) -> None: ...

    def __iter__(self) -> Iterator[Frame]: ...


@dataclass(frozen=True)
class StillSource:
    """Frames that are already in memory."""

    frames: tuple[Frame, ...]
    notes: list[str] = field(default_factory=list)
    live = False

    def close(self) -> None:
        """Nothing to release."""

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)
