"""Which topics of a recording are its colour, depth, label and camera_info.

They are chosen by message type, by whole parts of their names (`/cam/image_rect_color` has the parts cam, image, rect
and color), by the frame_id of their first message and by the content of the first depth image. Notes name topics that
are not chosen although they might be meant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from perception.sources.ros_images import COLOURS, encoding_of, samples, to_depth, to_label
from perception.sources.topic_names import NO_DEPTH_PARTS, TopicNames, name_parts

_COLOUR_PARTS = {"color", "colour", "rgb"}
_LABEL_PARTS = {"label", "labels", "segmentation"}
_NO_PICTURE_PARTS = {"confidence", "uncertainty", "mask", "disparity", "depth"}
_INFRARED_PARTS = {"ir", "infra", "infrared", "thermal"}
_LABEL_ENCODINGS = ("mono8", "8UC1", "mono16", "16UC1", "32SC1")
_TRANSPORTS = {"compressed", "compressedDepth"}
_USUAL = {"image", "image_raw", "image_color", "image_rect", "image_rect_color"}
_NEAREST_M, _FARTHEST_M = 0.01, 50.0  # between which the median of a depth image of things on a table lies


@dataclass(frozen=True)
class Chosen:
    """Topics of one camera."""

    colour: str
    depth: str | None
    label: str | None
    info: str | None
    notes: tuple[str, ...]


def frame_of(message: Any) -> str:
    """The frame_id, without the leading slash of ROS 1; empty where the driver gives none."""
    return message.header.frame_id.lstrip("/")


def other_camera(info: Any, colour: Any) -> str | None:
    """Words for a camera_info of another camera than the image's; None if frame_id does not differ."""
    a, b = frame_of(info), frame_of(colour)
    return f"is of frame {a!r} but colour is of frame {b!r}, so it is another camera's" if a and b and a != b else None


def not_aligned(depth: Any, colour: Any) -> str | None:
    """Words for depth of another camera than colour's; None if frame_id does not differ."""
    a, b = frame_of(depth), frame_of(colour)
    return f"is of frame {a!r} but colour is of frame {b!r}, so it is not aligned" if a and b and a != b else None


def doubt(depth: Float32[np.ndarray, "h w"]) -> str | None:
    """The reason why an image cannot be depth in metres (0 or NaN where unknown); None if there is no such reason."""
    values = depth[np.isfinite(depth) & (depth != 0)]
    if not values.size:
        return None
    if (share := float((values < 0).mean())) > 0.01:
        return f"{100 * share:.0f}% of its values are negative"
    median = float(np.median(values))
    if not _NEAREST_M <= median <= _FARTHEST_M:
        return f"its median is {median:.3g} m, where {_NEAREST_M:g} to {_FARTHEST_M:g} m are expected"
    return None


def colour_topic(path: Path, firsts: Mapping[str, Any], name: str | None = None) -> tuple[str, list[str]]:
    """The colour among topics, each with its first image, and notes. Raises ValueError if there is none.

    `name` is the requested topic.
    """
    encodings = {t: encoding_of(message) for t, message in firsts.items()}
    found = [t for t, e in encodings.items() if (e in COLOURS and t == name) or _is_picture(t, e)]
    if not found or (name is not None and name not in found):
        seen = ", ".join(f"{t} ({encoding_of(message)})" for t, message in firsts.items()) or "none"
        what = "no colour image" if name is None else f"no colour image on {name}"
        raise ValueError(
            f"{path} has {what} (images: {seen}); record one as rgb8, bgr8, mono8, bayer, yuv422, nv12 or JPEG"
        )
    if name is not None:
        return name, []

    depths, _ = _named_depth(path, firsts)

    def rank(topic: str) -> tuple[bool, ...]:  # infrared is mono8 too; what this node passed on is a copy
        image, own = firsts[topic], "farside" in topic.split("/")
        paired = any(_is_of(firsts[d], image, _kinship(d, topic)) for d in depths)
        usual = _segments(topic)[-1] in _USUAL  # a driver's, not somebody's overlay
        return encoding_of(image) != "mono8", not own, paired, bool(_COLOUR_PARTS & name_parts(topic)), usual

    best = max(found, key=lambda t: (*rank(t), hasattr(firsts[t], "encoding")))  # a raw picture needs no decoding
    others = [t for t in found if rank(t)[:2] == rank(best)[:2] and _segments(t) != _segments(best)]
    notes = [f"{path.name}: colour is also on {', '.join(others)}; {best} is taken (choose with --colour-topic)"]
    return best, notes if others else []


def _is_of(depth: Any, colour: Any, kinship: int) -> bool:
    """Whether a depth image may be that of a colour image: of its frame_id, or without one of its namespace."""
    a, b = frame_of(depth), frame_of(colour)
    return a == b if a and b else kinship > 0


def choose(path: Path, images: Mapping[str, Any], infos: Mapping[str, Any], names: TopicNames) -> Chosen:
    """The topics of one camera among those of a recording, each given with its first message.

    Raises ValueError, with the topic and the remedy, if there is no colour, or if depth or camera_info is another
    camera's.
    """
    colour, notes = colour_topic(path, images, names.colour)
    depth, about_depth = _depth_topic(path, images, colour, names.depth)
    label, about_labels = _label_topic(path, images, colour)
    notes = [*notes, *about_depth, *about_labels]
    return Chosen(colour, depth, label, _info_topic(path, infos, images, colour), tuple(notes))


def _label_topic(path: Path, images: Mapping[str, Any], colour: str) -> tuple[str | None, list[str]]:
    """The label map of colour's camera and size, and notes on others that may be meant."""
    fitting, notes = [], []
    for topic, message in images.items():
        if not _LABEL_PARTS & name_parts(topic) or encoding_of(message) not in _LABEL_ENCODINGS:
            continue
        if not_aligned(message, images[colour]) is None:
            why = _no_labels(message, images[colour])
            notes += [f"{path.name}: {topic} is not taken for labels: {why}"] if why else []
            fitting += [] if why else [topic]
    return max(fitting, key=lambda t: _kinship(t, colour), default=None), notes


def _no_labels(message: Any, colour: Any) -> str | None:
    """The reason why an image is no label map of a colour image."""
    if "jp" in getattr(message, "format", ""):
        return "JPEG changes ids; record it as mono8, 16UC1 or PNG"
    try:
        size, wanted = to_label(message).shape, samples(colour).shape[:2]
    except ValueError as error:
        return str(error)
    return None if size == wanted else f"it is {size[1]}x{size[0]} px, colour {wanted[1]}x{wanted[0]}"


def _is_picture(topic: str, encoding: str) -> bool:
    """Whether a topic's name and encoding allow colour. Of what has colours for certain, only its own name counts."""
    if encoding not in COLOURS or topic.endswith("/compressedDepth"):
        return False
    whole = name_parts(topic)
    if encoding == "mono8":
        return not (_LABEL_PARTS | _NO_PICTURE_PARTS) & whole or bool(_COLOUR_PARTS & whole)
    own = name_parts(_segments(topic)[-1])
    return not (_LABEL_PARTS | _NO_PICTURE_PARTS) & own


def _depth_topic(path: Path, images: Mapping[str, Any], colour: str, name: str | None) -> tuple[str | None, list[str]]:
    if name is not None:
        if name not in images:
            raise ValueError(f"{path} has no image on {name}; its images are on {', '.join(images)}")
        found, notes = [name], list[str]()
    else:
        found, notes = _named_depth(path, images)
    size = _size(path, colour, images[colour])
    sizes = dict[str, str]()
    for t in found:
        try:
            sizes[t] = _size(path, t, images[t])
        except ValueError as error:
            if t == name or len(found) == 1:
                raise
            notes.append(f"{t} is not taken for depth: {error}")
    found = list(sizes)
    fitting = [t for t in found if sizes[t] == size]
    if found and not fitting:
        raise ValueError(
            f"{path}: depth on {found[0]} is {sizes[found[0]]} px but colour on {colour} is {size}; record the depth"
            " that is aligned to colour"
        )
    apart = {t: why for t in fitting if (why := not_aligned(images[t], images[colour]))}
    aligned = [t for t in fitting if t not in apart or t == name]
    if fitting and not aligned:
        raise ValueError(
            f"{path}: depth on {fitting[0]} {apart[fitting[0]]}; record the depth that is aligned to {colour}, or,"
            f" if it is, give --depth-topic {fitting[0]}"
        )
    doubts = {t: why for t in aligned if (why := _doubt(path, t, images[t]))}
    remedy = "record metres as 32FC1 or millimetres as 16UC1"
    if name in doubts:
        raise ValueError(f"{path}: {name} is no depth: {doubts[name]}; {remedy}, or give another --depth-topic")
    notes += [f"{path.name}: {t} is not taken for depth: {why}; {remedy}" for t, why in doubts.items()]
    if name in apart:
        notes.append(f"{path.name}: depth {apart[name]} by frame_id; taken as aligned, since it was given")
    taken = [t for t in aligned if t not in doubts]
    best = max(taken, key=lambda t: ("aligned" in name_parts(t), _kinship(t, colour)), default=None)
    if best is None:
        notes.append(f"{path.name} has no depth image; its frames carry colour alone")
    return best, notes


def _named_depth(path: Path, images: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """The topics whose name or transport says depth, and notes on those that might be."""
    found, unnamed, unread = [], [], []
    for topic, message in images.items():
        parts, encoding = name_parts(topic), encoding_of(message)
        if parts & (_LABEL_PARTS | NO_DEPTH_PARTS):
            continue
        if encoding not in ("16UC1", "mono16", "32FC1"):
            if "depth" in parts and not _is_picture(topic, encoding):
                unread.append(f"{topic} ({getattr(message, 'format', encoding)!r})")
            continue
        own = name_parts(" ".join(_segments(topic)[-2:]))  # a depth camera's other images have its name, too
        if own & _INFRARED_PARTS and "depth" not in own:
            continue
        if "depth" in parts or "compressedDepth" in getattr(message, "format", ""):
            found.append(topic)
        elif encoding != "mono16" and not parts & _INFRARED_PARTS:
            unnamed.append(f"{topic} ({encoding})")
    notes = []
    if unread:
        what = f"{path.name}: {', '.join(unread)} is not read as depth"
        notes.append(f"{what}; record millimetres as 16UC1 or metres as 32FC1")
    if unnamed:
        note = f"{path.name}: {', '.join(unnamed)} may be depth, but no part of the name says depth, so it is not used"
        notes.append(f"{note}; if it is, choose it with --depth-topic")
    return found, [] if found else notes


def _info_topic(path: Path, infos: Mapping[str, Any], images: Mapping[str, Any], colour: str) -> str | None:
    """The camera_info of the colour's camera: of its frame_id where both have one, and rather of its namespace."""
    image = images[colour]
    same = [t for t in infos if other_camera(infos[t], image) is None]
    remedy = f"record the camera_info of {colour}, or give a camera file (--camera)"
    if infos and not same:
        topic = max(infos, key=lambda t: _kinship(t, colour))
        raise ValueError(f"{path}: camera_info on {topic} {other_camera(infos[topic], image)} ({colour}); {remedy}")

    def rank(topic: str) -> tuple[bool, bool, int]:
        exact = bool(frame_of(image)) and frame_of(infos[topic]) == frame_of(image)
        return exact, _segments(topic)[:-1] == _segments(colour)[:-1], _kinship(topic, colour)

    best = max(same, key=rank, default=None)
    if best is not None and len(infos) > 1 and not any(rank(best)):
        raise ValueError(
            f"{path}: neither frame_id nor namespace tells which camera_info ({', '.join(same)}) is that of {colour};"
            f" {remedy}"
        )
    return best


def _segments(topic: str) -> list[str]:
    parts = topic.strip("/").split("/")
    return parts[:-1] if parts[-1] in _TRANSPORTS else parts


def _kinship(topic: str, other: str) -> int:
    """How many leading parts of their paths two topics share, their own names left out."""
    count = 0
    for a, b in zip(_segments(topic)[:-1], _segments(other)[:-1], strict=False):
        if a != b:
            break
        count += 1
    return count


def _size(path: Path, topic: str, message: Any) -> str:
    try:
        return "{1}x{0}".format(*samples(message).shape)
    except ValueError as error:
        raise ValueError(f"{path}: {topic}: {error}") from None


def _doubt(path: Path, topic: str, message: Any) -> str | None:
    try:
        return doubt(to_depth(message))
    except ValueError as error:
        raise ValueError(f"{path}: {topic}: {error}") from None
