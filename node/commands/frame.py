"""The frame that a command's options name, and its objects."""

from dataclasses import replace

from rich.console import Console

from calibration.camera_file import read_camera
from node.commands.options import FrameOptions
from perception.observation.segmentation import Segments, segment
from perception.sources.frame import Frame
from perception.sources.label_map import read_label_map
from perception.sources.playback import frame_at
from perception.sources.settings import SHIPPED_LOG


def read_frame(options: FrameOptions, err: Console) -> Frame:
    """The frame, with the masks from outside, without its depth where it is to be ignored. Its notes go to `err`.

    Raises `FileNotFoundError` or `ValueError` naming the file and the remedy.
    """
    camera = None if options.camera is None else read_camera(options.camera)
    frame, notes = frame_at(options.source, options.frame, options.start_s, options.end_s, camera, options.topics)
    for note in notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if options.masks is not None:
        frame = replace(frame, label=read_label_map(options.masks, frame.rgb.shape[:2]))
    return replace(frame, depth=None) if options.colour_only else frame


def segments_of(options: FrameOptions, frame: Frame, err: Console) -> Segments:
    """The objects of that frame; what is left out is named on `err`. Raises `ValueError` naming the source."""
    try:
        found = segment(frame, options.object, options.segmentation)
    except ValueError as error:
        raise ValueError(f"{options.source or SHIPPED_LOG}: {error}") from None
    for it in found.left_out:
        err.print(f"object {it.id} is left out: {it.reason}", highlight=False, soft_wrap=True)
    if found.doubt:
        err.print(f"warning: {found.doubt}", highlight=False, soft_wrap=True)
    return found
