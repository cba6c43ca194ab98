"""Colour alone, through OpenCV: cameras by number, and video files."""

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from calibration.camera import Camera
from perception.sources.frame import Frame

# FFmpeg prints its complaints itself; read when the first video is opened.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
_GUESSED_FOV = 60.0  # degrees, horizontal
_GUESSED_FOCAL_STD = 0.25  # of the focal length: webcams see 50 to 80 degrees, phones' cameras about as much
_GUESSED_CENTRE_STD = 0.05  # of the width


def guessed_camera(width: int, height: int) -> Camera:
    """A camera for pictures (px) of an unknown lens: 60 degrees across, no distortion, wide deviations."""
    focal = 0.5 * width / np.tan(np.radians(0.5 * _GUESSED_FOV))
    K = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    focal_std, centre_std = _GUESSED_FOCAL_STD * focal, _GUESSED_CENTRE_STD * width
    K_std = np.array([[focal_std, 0.0, centre_std], [0.0, focal_std, centre_std], [0.0, 0.0, 0.0]])
    return Camera(width, height, K, np.zeros(5), K_std=K_std)


class _Pictures:
    """Common part of a camera and a file: the calibration, which must fit the pictures' size, or a guess with a note.

    A calibration at another size is refused and never scaled: a camera may crop its sensor instead of scaling, and the
    picture does not tell which.
    """

    def __init__(self, name: str, camera: Camera | None) -> None:
        self.name = name
        self._given = camera
        self._guess: Camera | None = None
        self._missing: list[str] = []

    @property
    def notes(self) -> list[str]:
        if self._guess is None:
            return self._missing
        focal = self._guess.K[0, 0]
        guess = (
            f"{self.name}: no calibration was given; a field of view of {_GUESSED_FOV:g} degrees (focal length"
            f" {focal:.0f} px, give or take {_GUESSED_FOCAL_STD * focal:.0f}) is a guess; run `farside calibrate`"
        )
        return [guess, *self._missing]

    def _frame(self, stamp_ns: int, bgr: np.ndarray) -> Frame:
        height, width = bgr.shape[:2]
        if self._given is None:
            if self._guess is None or (self._guess.width, self._guess.height) != (width, height):
                self._guess = guessed_camera(width, height)
        elif (self._given.width, self._given.height) != (width, height):
            raise ValueError(
                f"{self.name} gives {width}x{height} px but the calibration is for {self._given.width}x"
                f"{self._given.height} px; give the calibration of this size (a scaled one may be wrong)"
            )
        camera = self._given or self._guess
        assert camera is not None
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB) if bgr.ndim == 3 else cv2.cvtColor(bgr, cv2.COLOR_GRAY2RGB)
        return Frame(rgb, None, camera, stamp_ns=stamp_ns)


class Webcam(_Pictures):
    """The camera /dev/videoN. It is set to the size of its calibration, if there is one.

    A stamp is the time at which the picture reached this computer (UNIX ns); it was exposed some time before. Raises
    `ValueError` for an invalid `number` and `OSError`, one line, if the camera is absent, in use, or lost.
    """

    live = True

    def __init__(self, number: str, camera: Camera | None = None) -> None:
        if not number.isdecimal():
            raise ValueError(f"webcam:{number} names no camera; give its number, such as webcam:0 for /dev/video0")
        super().__init__(f"webcam:{int(number)}", camera)
        self._number = int(number)
        self._closed = threading.Event()
        self._first: cv2.VideoCapture | None = self._open()  # kept for the first iteration: opening takes seconds

    def close(self) -> None:
        self._closed.set()

    def __iter__(self) -> Iterator[Frame]:
        capture, self._first = self._first or self._open(), None
        try:
            while not self._closed.is_set():
                grabbed = capture.grab()  # waits for the next picture; OpenCV gives up after 10 s
                stamp_ns = time.time_ns()
                read, picture = capture.retrieve() if grabbed else (False, None)
                if not read or picture is None:
                    raise OSError(f"{self.name} gives no more pictures; check its cable, then start again")
                yield self._frame(stamp_ns, picture)
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        if sys.platform == "linux" and not Path(f"/dev/video{self._number}").exists():
            there = ", ".join(sorted(f"webcam:{p.name[5:]}" for p in Path("/dev").glob("video*"))) or "none"
            raise OSError(f"{self.name}: there is no /dev/video{self._number} (cameras here: {there}); plug it in")
        with _quiet():
            capture = cv2.VideoCapture(self._number)
        if not capture.isOpened():
            raise OSError(f"{self.name} cannot be opened; close the program that uses it, or give another number")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a queue only makes pictures late
        if self._given is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._given.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._given.height)
        return capture


class VideoFile(_Pictures):
    """A video file; stamps are its media time (ns from its start), and frames come as fast as they are read.

    Raises `FileNotFoundError` or `ValueError`, one line, if it is absent or cannot be decoded.
    """

    live = False

    def __init__(self, path: Path, camera: Camera | None = None) -> None:
        super().__init__(path.name, camera)
        self.path = path
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist; give a video file")
        capture = self._open()
        count, width = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_WIDTH))
        capture.release()
        self._count = count
        if width <= 0:
            raise ValueError(f"{path} holds no picture; give a video file")

    def close(self) -> None:
        """Nothing to do: a file is open only while it is read."""

    def __iter__(self) -> Iterator[Frame]:
        self._missing = []
        capture = self._open()
        frames, stamp_ns = 0, -1
        try:
            while True:
                with _quiet():
                    read, picture = capture.read()
                if not read or picture is None:
                    break
                # A container without times repeats 0; stamps rise.
                stamp_ns = max(stamp_ns + 1, round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
                frames += 1
                yield self._frame(stamp_ns, picture)
        finally:
            capture.release()
        if not frames:
            raise ValueError(f"{self.path}: no picture in it can be decoded; convert it to MP4 or MKV again")
        if frames < self._count:
            self._missing.append(f"{self.name} is cut short or damaged: {frames} of about {self._count} frames read")

    def _open(self) -> cv2.VideoCapture:
        with _quiet():
            capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise ValueError(f"{self.path} cannot be decoded as a video (is it cut short?); convert it to MP4 or MKV")
        return capture


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV's own warnings off the terminal: failures are reported once, by an exception."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
