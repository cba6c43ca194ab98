"""Holistic recordings of DepthAI (`Pipeline.enableHolisticRecord`): videos, and the device's calibration."""

import re
from pathlib import Path

import cv2

from calibration.camera import Camera
from perception.sources.oak import camera_of_device_json
from perception.sources.webcam import VideoFile

_VIDEO = re.compile(r".*(CAM_[A-Z])\.(mp4|avi|mkv)")


class HolisticRecording(VideoFile):
    """The colour video in the folder of an unpacked recording: of CAM_A, or else of the first camera.

    There is no depth in such a recording: a device computes it anew from the videos of its two eyes, which needs the
    device. Stamps are the video's. Raises `ValueError`, one line, if video or calibration cannot be read.
    """

    def __init__(self, path: Path, camera: Camera | None = None) -> None:
        videos = {found[1]: file for file in sorted(path.iterdir()) if (found := _VIDEO.fullmatch(file.name))}
        calibrations = sorted(path.glob("*calibration.json"))
        if not videos or not calibrations:
            raise ValueError(
                f"{path} holds no CAM_A.mp4 (.avi, .mkv) with a calibration.json; give an unpacked holistic recording"
            )
        if len(calibrations) > 1:
            raise ValueError(f"{path} holds the recordings of several devices; give a folder with those of one")
        socket, video = next(iter(videos.items())) if "CAM_A" not in videos else ("CAM_A", videos["CAM_A"])
        super().__init__(video, camera)
        if camera is None:
            capture = self._open()
            width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            capture.release()
            self._given = camera_of_device_json(calibrations[0], socket, width, height)
        others = ", ".join(sorted(set(videos) - {socket})) or "no other camera"
        self._note = (
            f"{path}: the video of {socket} is read ({others} beside it), without depth: DepthAI keeps none in a"
            " holistic recording, but computes it on the device again; `farside record oak` keeps it"
        )

    @property
    def notes(self) -> list[str]:
        return [self._note, *super().notes]
