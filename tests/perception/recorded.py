"""Frames played through a real DepthAI pipeline on the host: all of OakSource but the node that makes the images."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path

import depthai as dai
import numpy as np

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.oak import Opened

CLOCK_NS = 1_700_000_000_000_000_000  # UNIX time less the pipeline's clock
CAMERA = Camera(64, 48, np.array([[60.0, 0.0, 31.0], [0.0, 61.0, 23.0], [0.0, 0.0, 1.0]]), np.arange(1.0, 9.0) / 100,
                "rational_polynomial")  # fmt: skip

DEVICE_K = [[3000.0, 0.0, 2010.0], [0.0, 3010.0, 1530.0], [0.0, 0.0, 1.0]]


def write_device_json(path: Path) -> Path:
    """A device's calibration file, as the library writes it: CAM_A at 4056x3040 px with 14 coefficients."""
    handler = dai.CalibrationHandler()
    for socket, count in ((dai.CameraBoardSocket.CAM_A, 14), (dai.CameraBoardSocket.CAM_B, 8)):
        handler.setCameraIntrinsics(socket, DEVICE_K, (4056, 3040))
        handler.setDistortionCoefficients(socket, [0.01 * (i + 1) for i in range(count)])
    handler.setCameraIntrinsics(dai.CameraBoardSocket.CAM_C, DEVICE_K, (4056, 3040))
    handler.setDistortionCoefficients(dai.CameraBoardSocket.CAM_C, [0.1] * 4)
    handler.setCameraType(dai.CameraBoardSocket.CAM_C, dai.CameraModel.Fisheye)
    assert handler.eepromToJsonFile(path)
    return path


def some_frames(count: int, camera: Camera = CAMERA, period_ms: int = 33) -> list[Frame]:
    """Frames of noise; depth in whole millimetres with holes, stamps in whole microseconds."""
    rng = np.random.default_rng(0)
    shape = (camera.height, camera.width)
    frames = []
    for i in range(count):
        mm = (rng.integers(1, 65535, shape) * (rng.random(shape) > 0.2)).astype(np.uint16)
        stamp_ns = CLOCK_NS + 7_000_123_000 + i * period_ms * 1_000_000
        rgb = rng.integers(0, 256, (*shape, 3), dtype=np.uint8)
        frames.append(Frame(rgb, mm * np.float32(1e-3), camera, stamp_ns=stamp_ns))
    return frames


class Player(dai.node.ThreadedHostNode):
    """Sends its frames once, then is silent."""

    def __init__(self, images: "RecordedImages", frames: Sequence[Frame]) -> None:
        super().__init__()
        self.images, self.frames = images, frames
        self.colour, self.depth = self.createOutput(), self.createOutput()

    def run(self) -> None:  # an exception here would end the process
        for i, frame in enumerate(self.frames):
            if not self.isRunning():
                return
            if i in self.images.skip:
                continue
            stamp = timedelta(microseconds=(frame.stamp_ns - CLOCK_NS) // 1000)
            mm = np.rint(np.nan_to_num(frame.depth) * 1000.0).astype(np.uint16)
            for output, pixels, kind, shift in (
                (self.colour, frame.rgb, dai.ImgFrame.Type.RGB888i, 0),
                (self.depth, mm, dai.ImgFrame.Type.RAW16, self.images.shift_us),
            ):
                message = dai.ImgFrame()
                message.setFrame(pixels)
                message.setWidth(pixels.shape[1]).setHeight(pixels.shape[0])
                message.setType(kind)
                message.setSequenceNum(i)
                message.setTimestamp(stamp + timedelta(microseconds=shift))
                if self.images.told is not None and output is self.colour:
                    message.setTransformation(self.images.told)
                output.send(message)
            time.sleep(self.images.pause_s)


@dataclass
class RecordedImages:
    """Connection i plays `connections[i]`: frames, or an exception that opening raises."""

    connections: list[list[Frame] | Exception]
    camera: Camera = CAMERA
    shift_us: int = 0  # of depth's stamps
    pause_s: float = 0.002
    skip: tuple[int, ...] = ()  # images that are lost on the way
    told: dai.ImgTransformation | None = None  # what colour images say of themselves
    name: str = "recorded"
    opened: int = 0
    closed: list[int] = field(default_factory=list)

    def open(self) -> Opened:
        played = self.connections[min(self.opened, len(self.connections) - 1)]
        self.opened += 1
        if isinstance(played, Exception):
            raise played
        pipeline = dai.Pipeline(createImplicitDevice=False)
        node = pipeline.create(Player, self, played)
        number = self.opened
        factory = self.told is not None
        return Opened(
            pipeline, node.colour, node.depth, self.camera, factory, CLOCK_NS, lambda: self.closed.append(number)
        )


def numbered(frames: Sequence[Frame], first_ms: int) -> list[Frame]:
    """The same frames, later."""
    return [replace(frame, stamp_ns=frame.stamp_ns + first_ms * 1_000_000) for frame in frames]
