"""OAK cameras through DepthAI v3: colour with depth aligned to it, in pairs of one moment, and the factory calibration.

Stamps are UNIX ns: DepthAI maps the camera's hardware clock to this computer's steady clock (and keeps both in step),
and the steady clock's offset from UNIX time is measured once per connection, so that setting the clock does not change
stamps. DepthAI gives stamps in whole microseconds.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from calibration.camera import Camera
from foundation.one_line import one_line
from perception.sources.frame import Frame, known_counts
from perception.sources.settings import OakConfig
from perception.sources.time_limit import within

os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # it would end the process where Python raises OSError
os.environ.setdefault("DEPTHAI_LEVEL", "error")  # read by the import: a missing USB bus is said once, by an exception
import depthai as dai

_COLOUR, _LEFT, _RIGHT = dai.CameraBoardSocket.CAM_A, dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
_STEREO_SIZE = (640, 400)  # px, of both eyes; depth is resampled to the colour image
_SYNC_ATTEMPTS = 10  # pairs that Sync tries before it returns images that are too far apart
_QUEUE = 30  # pairs that wait here before the oldest is dropped
_POLL = timedelta(milliseconds=100)
_OPENING_S, _CLOSING_S = 30.0, 3.0  # timeouts for a device that hangs
_METRES = np.float32(1e-3)  # depth counts are millimetres


@dataclass(frozen=True, eq=False)
class Opened:
    """A pipeline, not started, with what makes its images."""

    pipeline: dai.Pipeline
    colour: dai.Node.Output  # ImgFrames of 8 bit colour
    depth: dai.Node.Output  # ImgFrames, RAW16: mm, aligned to colour, 0 where unknown
    camera: Camera  # of the colour images
    factory: bool  # the camera is the factory's calibration, scaled
    clock_ns: int  # UNIX time less the clock of the ImgFrames' stamps
    close: Callable[[], None]  # what the pipeline does not close itself


class Images(Protocol):
    """The maker of the images: a device, or recorded frames on the host. Everything behind it is the same."""

    @property
    def name(self) -> str: ...

    def open(self) -> Opened: ...  # OSError where another try may help, ValueError where none does


class OakSource:
    """The frames of an OAK camera, as long as it delivers them.

    A camera that is lost (unplugged, crashed, or silent for `silence_s`) is searched for until it is back; `notes`
    counts the losses. Raises `OSError` if it never gave a frame, `ValueError` if calibration and image do not fit.
    """

    live = True

    def __init__(self, images: Images, config: OakConfig | None = None) -> None:
        self._images = images
        self._config = config or OakConfig()
        self._closed = threading.Event()
        self._received = self._lost = self._missing = self._apart = 0
        self._away = False
        self._least_gap_ms = np.inf  # of the pairs that were too far apart
        self._why = ""  # it was lost
        self._camera_note = ""

    @property
    def notes(self) -> list[str]:
        name, notes = self._images.name, []
        if self._lost:
            times = "once" if self._lost == 1 else f"{self._lost} times"
            notes.append(f"{name}: lost {times}, {'away' if self._away else 'back'} now; last: {self._why}")
        if self._missing:
            notes.append(f"{name}: {self._missing} frames lost between camera and here (gaps in their numbers)")
        if self._apart:
            notes.append(f"{name}: {self._apart} pairs left out: {self._apart_text()}")
        return notes + ([self._camera_note] if self._camera_note else [])

    def close(self) -> None:
        self._closed.set()

    def __iter__(self) -> Iterator[Frame]:
        wait = self._config.retry_s
        while not self._closed.is_set():
            before = self._received
            try:
                yield from self._connected()
            except OSError as error:
                if not self._received:  # it never worked: the user must act
                    raise
                if self._received > before:  # else it is still disconnected
                    self._lost += 1
                    self._away, self._why, wait = True, str(error), self._config.retry_s
            self._closed.wait(wait)
            wait = min(2.0 * wait, self._config.longest_retry_s)

    def _connected(self) -> Iterator[Frame]:
        """The frames of one connection. Raises `OSError` when it is lost."""
        slow = f"{self._images.name} does not open; plug it in again"
        opened, queue = within(_OPENING_S, self._start, slow, late=lambda started: _close(started[0]))
        previous = None
        heard = time.monotonic()
        try:
            while not self._closed.is_set():
                try:
                    group = queue.get(_POLL)
                except (RuntimeError, dai.MessageQueue.QueueException) as error:
                    raise OSError(f"{self._images.name} was lost ({one_line(error)})") from None
                frame = None
                if isinstance(group, dai.MessageGroup):
                    frame, previous = self._frame(group, opened, previous)
                if frame is not None:
                    self._received += 1
                    self._away = False
                    yield frame
                    heard = time.monotonic()  # the time that the reader took is not the camera's
                elif not opened.pipeline.isRunning():
                    raise OSError(f"{self._images.name} stopped (unplugged?); check the cable")
                elif time.monotonic() - heard > self._config.silence_s:
                    # A node's error is only logged and the pipeline stays up: silence is all there is to notice.
                    apart = f" ({self._apart_text()})" if self._apart else ""
                    raise OSError(f"{self._images.name} gave no frame for {self._config.silence_s:g} s{apart}")
        finally:
            _close(opened)

    def _start(self) -> tuple[Opened, dai.MessageQueue]:
        opened = self._images.open()
        try:
            sync = opened.pipeline.create(dai.node.Sync)
            sync.setRunOnHost(True)
            sync.setSyncThreshold(timedelta(milliseconds=self._config.tolerance_ms))
            sync.setSyncAttempts(_SYNC_ATTEMPTS)
            opened.colour.link(sync.inputs["colour"])
            opened.depth.link(sync.inputs["depth"])
            queue = sync.out.createOutputQueue(maxSize=_QUEUE, blocking=False)
            opened.pipeline.start()
        except RuntimeError as error:
            _close(opened)
            raise OSError(f"{self._images.name} does not start ({one_line(error)}); plug it in again") from None
        return opened, queue

    def _frame(self, group: dai.MessageGroup, opened: Opened, previous: int | None) -> tuple[Frame | None, int]:
        """The frame of a pair (None: too far apart), and its number; `previous` is the number of the pair before."""
        colour, depth = group["colour"], group["depth"]
        assert isinstance(colour, dai.ImgFrame) and isinstance(depth, dai.ImgFrame)
        number = colour.getSequenceNum()
        gap_ms = abs(depth.getTimestamp() - colour.getTimestamp()) / timedelta(milliseconds=1)
        if gap_ms > self._config.tolerance_ms:
            self._apart += 1
            self._least_gap_ms = min(self._least_gap_ms, gap_ms)
            return None, number
        self._missing += max(0, number - previous - 1) if previous is not None else 0
        stamp_ns = opened.clock_ns + colour.getTimestamp() // timedelta(microseconds=1) * 1000
        rgb = cv2.cvtColor(colour.getCvFrame(), cv2.COLOR_BGR2RGB)
        try:
            camera = self._agreed(opened.camera, colour) if opened.factory else opened.camera
            z = known_counts(depth.getFrame().astype(np.uint16, copy=False)) * _METRES
            return Frame(rgb, z, camera, stamp_ns=stamp_ns, frame_id="oak_rgb_camera_optical_frame"), number
        except ValueError as error:
            raise ValueError(f"{self._images.name}: {error}") from None

    def _agreed(self, camera: Camera, colour: dai.ImgFrame) -> Camera:
        """The calibration, with the image's own camera matrix if that differs.

        It differs if the device crops its sensor before scaling: the factory calibration does not include the crop.
        """
        transformation = colour.getTransformation()
        K = np.array(transformation.getIntrinsicMatrix())
        if tuple(transformation.getSize()) != (camera.width, camera.height) or K[0, 0] <= 1.0:
            return camera  # no information
        if np.abs(K - camera.K).max() <= 0.01 * camera.width:
            return camera
        self._camera_note = (
            f"{self._images.name}: by what the images say their focal length is {K[0, 0]:.1f} px, by the factory"
            f" calibration {camera.K[0, 0]:.1f}; the former is used"
        )
        return replace(camera, K=K)

    def _apart_text(self) -> str:
        allowed = self._config.tolerance_ms
        return f"colour and depth at least {self._least_gap_ms:.1f} ms apart, {allowed:g} are allowed"


class DeviceImages:
    """The images of a device: colour, undistorted if wanted, and stereo depth aligned to it."""

    def __init__(self, device_id: str = "", camera: Camera | None = None, config: OakConfig | None = None) -> None:
        self.name = f"oak:{device_id}" if device_id else "oak"
        self._id = device_id
        self._camera = camera
        self._config = config or OakConfig()

    def find(self) -> dai.DeviceInfo:
        """The device, in half a second. Raises `OSError` if it is not there."""
        found = dai.Device.getAllAvailableDevices()
        for info in found:
            if self._id in ("", info.deviceId, info.name):
                return info
        there = ", ".join(f"oak:{info.deviceId or info.name}" for info in found)
        if there:
            raise OSError(f"{self.name} is not there; there are {there}")
        raise OSError(
            f"{self.name}: no OAK camera was found; plug it in, and on Linux allow USB vendor 03e7 by a udev rule"
        )

    def open(self) -> Opened:
        """Start the camera's pipeline. Raises OSError in one line if there is none, or it cannot be opened."""
        config, info = self._config, self.find()
        size = (config.width, config.height)
        try:
            device = dai.Device(info)
        except RuntimeError as error:
            raise OSError(f"{self.name} cannot be opened ({one_line(error)}); is another program using it?") from None
        try:
            device.setMaxReconnectionAttempts(0)  # OakSource reconnects, and counts
            camera = self._camera or _factory_camera(
                device.readCalibration(), _COLOUR, *size, self.name, config.undistort
            )
            pipeline = dai.Pipeline(device)
            colour = pipeline.create(dai.node.Camera).build(_COLOUR)
            picture = colour.requestOutput(
                size, dai.ImgFrame.Type.RGB888i, fps=config.fps, enableUndistortion=config.undistort
            )
            stereo = pipeline.create(dai.node.StereoDepth)
            set_up(stereo, config)
            for socket, eye in ((_LEFT, stereo.left), (_RIGHT, stereo.right)):
                camera_node = pipeline.create(dai.node.Camera).build(socket)
                camera_node.requestOutput(_STEREO_SIZE, fps=config.fps).link(eye)
            depth = stereo.depth
            if device.getPlatform() == dai.Platform.RVC4:  # its stereo does not align
                align = pipeline.create(dai.node.ImageAlign)
                stereo.depth.link(align.input)
                picture.link(align.inputAlignTo)
                depth = align.outputAligned
            else:
                picture.link(stereo.inputAlignTo)
            clock_ns = time.time_ns() - time.monotonic_ns()  # DepthAI's stamps have the steady clock
            return Opened(pipeline, picture, depth, camera, self._camera is None, clock_ns, device.close)
        except RuntimeError as error:
            device.close()
            raise OSError(f"{self.name} cannot be set up ({one_line(error)}); is it a camera with depth?") from None
        except BaseException:
            device.close()
            raise


def set_up(stereo: dai.node.StereoDepth, config: OakConfig) -> None:
    """Give the node that computes depth its preset and the least confidence."""
    if config.preset is None:
        stereo.setLeftRightCheck(True)
        stereo.setSubpixel(True)
    else:
        stereo.setDefaultProfilePreset(dai.node.StereoDepth.PresetMode.__members__[config.preset])
        # some presets halve the depth image, which then is not that of the colour image
        stereo.initialConfig.postProcessing.decimationFilter.decimationFactor = 1
    if config.confidence is not None:
        stereo.initialConfig.setConfidenceThreshold(config.confidence)


def open_oak(device_id: str = "", camera: Camera | None = None, config: OakConfig | None = None) -> OakSource:
    """The OAK camera `device_id` (its id, USB path or address; empty: the first that is found).

    `camera`, for the images as streamed, replaces the factory calibration; the images are then requested in its size.
    Raises `OSError`, one line, after about half a second if no device is found.
    """
    config = config or OakConfig()
    if camera is not None:
        config = replace(config, width=camera.width, height=camera.height)
    images = DeviceImages(device_id, camera, config)
    images.find()
    return OakSource(images, config)


def camera_of_device_json(path: Path | str, socket: str = "CAM_A", width: int = 640, height: int = 480) -> Camera:
    """The camera at `socket` of a device's calibration JSON, at an image size (px) that the device scales and crops to.

    It is the one of the image as the lens makes it, with all the coefficients that the device has. Raises
    `FileNotFoundError` or `ValueError` naming the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the calibration JSON of an OAK camera")
    sockets = dai.CameraBoardSocket.__members__
    if socket not in sockets:
        raise ValueError(f"{path}: socket {socket!r} is unknown; give one of {', '.join(sorted(sockets))}")
    try:
        calibration = dai.CalibrationHandler(path.absolute())
    except RuntimeError as error:
        raise ValueError(f"{path} is no calibration of an OAK camera ({one_line(error)}); save it again") from None
    return _factory_camera(calibration, sockets[socket], width, height, str(path))


def _factory_camera(
    calibration: dai.CalibrationHandler,
    socket: dai.CameraBoardSocket,
    width: int,
    height: int,
    name: str,
    undistorted: bool = False,
) -> Camera:
    try:
        K = np.array(calibration.getCameraIntrinsics(socket, width, height))
        lens = calibration.getDistortionModel(socket)
        distortion = np.array(calibration.getDistortionCoefficients(socket))
    except RuntimeError as error:
        raise ValueError(f"{name} has no calibration of {socket.name} ({one_line(error)}); calibrate it") from None
    if undistorted:
        distortion = np.zeros(5)
    elif lens != dai.CameraModel.Perspective:
        raise ValueError(f"{name}: {socket.name} has a {lens.name} lens; a perspective one is wanted")
    try:
        return Camera(width, height, K, distortion, "plumb_bob" if distortion.size < 8 else "rational_polynomial")
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _close(opened: Opened) -> None:
    """Always: a pipeline that is dropped while it runs waits for its nodes with Python's lock held."""

    def close() -> None:
        opened.pipeline.stop()
        opened.pipeline.wait()
        opened.close()

    try:
        within(_CLOSING_S, close, "")
    except (OSError, RuntimeError):  # a disconnected device need not answer
        pass
