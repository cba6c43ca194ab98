"""Plain colour pictures for calibration: from a folder of images or any source. Their camera need not be known."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8

from calibration.camera_file import split_name
from foundation.archive import is_archive, members
from perception.sources.frame import Frame, Source
from perception.sources.image_files import colour_to_rgb, decoded, read_png
from perception.sources.log_messages import first_messages, open_log
from perception.sources.open_source import VIDEO_SUFFIXES, is_holistic, open_source
from perception.sources.reader import Reader
from perception.sources.ros_images import to_rgb
from perception.sources.topics import colour_topic

_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff", ".webp")
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


@dataclass(frozen=True, eq=False)
class Picture:
    """A colour image, and what to call it in a message."""

    name: str
    rgb: UInt8[np.ndarray, "h w 3"]


def pictures_of(frames: Iterable[Frame]) -> Iterator[Picture]:
    """The pictures of frames, such as a live source gives."""
    for number, frame in enumerate(frames):
        yield Picture(f"frame {number}", frame.rgb)


def open_pictures(source: Path | str, notes: list[str] | None = None) -> tuple[Iterator[Picture], int | None]:
    """The pictures of `source` and their number; None for those of a stream. What a recording lacks goes to `notes`.

    `source` is a folder of images (in the order of their names), one image, a recording with a colour image (its
    camera_info, depth and labels are not read), the calibrationdata.tar.gz of ROS's cameracalibrator (its left-*.png;
    FILE#right: right-*.png), or else what `open_source` opens. A live source gives
    its newest picture each time, until it ends. Raises FileNotFoundError, OSError or ValueError naming the source and
    the remedy.
    """
    path = Path(source)
    archive, camera = split_name(path)
    if is_archive(archive):
        return _archived(archive, camera or "left")
    live = str(source).partition(":")[0] in ("oak", "webcam")
    if live or path.suffix in VIDEO_SUFFIXES or is_holistic(path) or not path.exists():
        opened = open_source(source)
        return _newest(opened) if opened.live else pictures_of(opened), None
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in _ENDINGS)
        recording = (path / "metadata.yaml").exists() or any(p.suffix in (".mcap", ".db3") for p in path.iterdir())
        if not files and not recording:
            raise ValueError(f"{path} holds no image ({', '.join(_ENDINGS)}) and no recording; give a folder that does")
    else:
        files = [path] if path.suffix.lower() in _ENDINGS else []
    if files:
        return (Picture(file.name, _read_image(file)) for file in files), len(files)
    return _logged(path, [] if notes is None else notes), None


def _newest(source: Source) -> Iterator[Picture]:
    with Reader(source) as reader:
        while (frame := reader.newest()) is not None:
            yield Picture(f"frame {reader.counts().received - 1}", frame.rgb)


def _archived(path: Path, camera: str) -> tuple[Iterator[Picture], int]:
    wanted = re.compile(rf"{re.escape(camera)}-\d+\.png")
    count = sum(1 for _ in members(path, wanted))
    if not count:
        raise ValueError(f"{path} holds no {camera}-0000.png; give the archive that ROS's cameracalibrator saved")
    return (Picture(name, _colours(f"{path}: {name}", data)) for name, data in members(path, wanted)), count


def _logged(path: Path, notes: list[str]) -> Iterator[Picture]:
    read, kinds, lacks = open_log(path)
    firsts = first_messages(read, {topic: kind for topic, kind in kinds.items() if kind in _IMAGES})
    try:
        topic, others = colour_topic(path, {name: first.message for name, first in firsts.items()})
    except ValueError as error:
        raise ValueError("; ".join([str(error), *lacks])) from None
    good, broken = 0, list[str]()
    for number, received in enumerate(read({topic})):
        try:
            picture = Picture(f"frame {number}", to_rgb(received.message))
        except ValueError as error:
            broken.append(f"{path}: frame {number} of {topic}: {error}")
            continue
        good += 1
        yield picture
    if broken and not good:
        raise ValueError(broken[0])
    notes += [*(note.partition(" (choose")[0] for note in others), *lacks]  # a calibration has no such option
    if broken:
        notes.append(f"pictures that cannot be read left out: {len(broken)}; the first: {broken[0]}")


def _read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    if path.suffix.lower() == ".png":
        return _eight_bits(str(path), read_png(path))
    return _colours(str(path), path.read_bytes())


def _colours(name: str, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    try:
        image = decoded(data)
    except ValueError as error:
        raise ValueError(f"{name} cannot be decoded ({error}); copy it again, or remove it") from None
    return _eight_bits(name, image)


def _eight_bits(name: str, image: Shaped[np.ndarray, "h w *c"]) -> UInt8[np.ndarray, "h w 3"]:
    if image.dtype == np.uint16:  # depth, or a camera's raw grey
        image = (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"{name} has {image.dtype} samples; save it with 8 bits a channel")
    return colour_to_rgb(image)
