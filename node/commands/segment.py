"""`farside segment`: the objects of a frame, drawn and numbered, before anything is inferred."""

import cv2
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table
from rich.text import Text

from foundation.whole_file import check_folder, write_whole
from node.commands.frame import read_frame, segments_of
from node.commands.options import Segmenting
from node.figures.segments_picture import draw_segments
from perception.observation.segmentation import Segment, backproject
from perception.observation.support_plane import heights, horizontal
from perception.observation.visible_extent import whole_extent
from perception.sources.frame import Frame

LARGEST_ID = 65535  # that a PNG of 16 bits holds


def segment_frame(options: Segmenting, out: Console, err: Console) -> None:
    """Draw, number and list the objects of one frame, and write their label map. Raises as `segment`."""
    check_folder(options.folder)
    frame = read_frame(options, err)
    found = segments_of(options, frame, err)
    largest = max(segment.id for segment in found)
    if largest > LARGEST_ID:
        raise ValueError(f"object id {largest} does not fit label.png; use 1 to {LARGEST_ID}")
    table = Table.grid(padding=(0, 2))
    points = None if frame.depth is None else backproject(frame)
    for segment in found:
        pixels = f"{int(segment.mask.sum())} px"
        table.add_row(Text(f"object {segment.id}", "bold"), pixels, *_seen(segment, frame, points))
    out.print(table, highlight=False)
    label = np.zeros(frame.rgb.shape[:2], np.uint16)
    for segment in found:
        label[segment.mask] = segment.id
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {"segments.png": draw_segments(frame, found, points)[..., ::-1], "label.png": label}
    for name, picture in pictures.items():
        write_whole(folder / name, cv2.imencode(".png", picture)[1].tobytes())
        out.print(f"  {folder / name}", highlight=False, soft_wrap=True)


def _seen(segment: Segment, frame: Frame, points: Float[np.ndarray, "h w 3"] | None) -> tuple[str, ...]:
    """Size and distance of what is seen of an object, in words; nothing without depth."""
    if points is None or frame.depth is None:
        return ()
    cloud = points[segment.mask & np.isfinite(frame.depth)]
    height = float(np.percentile(heights(cloud, segment.plane), 98))
    side = whole_extent(cloud[:: max(len(cloud) // 2000, 1)] @ horizontal(segment.plane).T)[1]
    distance = float(np.median(np.linalg.norm(cloud, axis=1)))
    return f"seen: {100 * side:.0f} cm wide, {100 * height:.0f} cm high", f"{distance:.2f} m away"
