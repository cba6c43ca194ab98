"""The choice of a source by its name."""

from dataclasses import replace
from pathlib import Path

from calibration.camera import Camera
from perception.sources.frame import Source, StillSource
from perception.sources.frame_arrays import read_frame_arrays
from perception.sources.frame_folder import is_frame_folder, read_frame_folder
from perception.sources.settings import SHIPPED_LOG, OakConfig
from perception.sources.topic_names import TopicNames

TAR_SUFFIXES = (".tar", ".tar.gz", ".tgz")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v")
# What a source may be, for messages.
SOURCES = (
    "oak, oak:ID, webcam:N, a video file (.mp4, .avi, .mkv), a frame folder (color.png, depth.png, meta.json),"
    " a frame in one file (.npz: rgb, depth, K) or a recording (.mcap, .bag, ROS 2 bag folder)"
)


def is_holistic(path: Path) -> bool:
    """Whether a folder holds an unpacked holistic recording of DepthAI."""
    return (
        path.is_dir()
        and any(path.glob("*calibration.json"))
        and any(video.suffix in VIDEO_SUFFIXES for video in path.glob("*CAM_?.*"))
    )


def open_source(
    path: Path | str | None,
    camera: Camera | None = None,
    topics: TopicNames | None = None,
    oak: OakConfig | None = None,
) -> Source:
    """The source that `path` names; None is the log shipped with the project.

    `oak` or `oak:ID` is an OAK camera, used as `oak` says, `webcam:N` the camera /dev/videoN; else a video file (by its
    suffix), a frame folder (it holds color.png), a DepthAI recording (a folder with videos and calibration.json), a
    .npz file with a frame, or a log. For a file of such a name write ./oak. `camera` is
    the calibration for a webcam or a video file, or replaces that of an OAK camera, a log or a frame folder. It must
    have the size of the images. `topics` replace the topics that `Log` finds in a log.

    Raises `FileNotFoundError`, `OSError` or `ValueError` with one line that names file or device and the remedy.
    """
    kind, _, which = str(path).partition(":")
    if kind == "oak":
        from perception.sources.oak import open_oak  # here, because depthai takes a second to import

        return open_oak(which, camera, oak)
    if kind == "webcam":
        from perception.sources.webcam import Webcam  # here, because webcam.py makes Frames

        return Webcam(which, camera)
    path = SHIPPED_LOG if path is None else Path(path)
    is_folder = is_frame_folder(path)
    if not is_folder and not path.exists():
        raise FileNotFoundError(f"{path} does not exist; give {SOURCES}")
    if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
        from perception.sources.webcam import VideoFile

        return VideoFile(path, camera)
    if path.name.endswith(TAR_SUFFIXES):
        raise ValueError(f"{path} is an archive; unpack it into a folder (tar -xf) and give that")
    if is_holistic(path):
        from perception.sources.holistic import HolisticRecording  # here, because depthai takes a second to import

        return HolisticRecording(path, camera)
    if is_folder or path.suffix.lower() == ".npz":
        frame = read_frame_folder(path) if is_folder else read_frame_arrays(path)
        try:
            return StillSource((frame if camera is None else replace(frame, camera=camera),))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    from perception.sources.recording import (
        Log,  # here, because a folder needs no log libraries
    )

    return Log(path, camera=camera, names=topics)
