"""Frame, the one type that every source gives, and the protocol of a source."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from calibration.camera import Camera


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
    """Frames in time order, once or more, and notes about what was missing (final when the iteration has ended).

    Of a `live` source the frames come when the camera takes them, and go on until `close`, from whatever thread, ends
    the iteration under way and lets the device go; then it is over. A source that is not live need not be closed.
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
        """Nothing to let go."""

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)
