"""Playback of a recording: a part of it, at its own pace or as fast as it can be read."""

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from calibration.camera import Camera
from perception.sources.frame import Frame, Source
from perception.sources.open_source import open_source
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from perception.sources.topic_names import TopicNames


class Playback:
    """The frames of a log from `start_s` to `end_s` (None: its end), seconds after its first frame, as a Source.

    With `pace` 1 frames come at the intervals of their stamps, with 2 twice as fast, with 0 as fast as they are read. A
    frame requested late comes at once: a consumer of the newest frame must drop the others. Raises ValueError for an
    invalid range or pace, and in iteration, with the log's actual range, if the range has no frame.
    """

    def __init__(self, log: Log, pace: float = 1.0, start_s: float = 0.0, end_s: float | None = None) -> None:
        self.log, self.pace = log, pace
        self.start_s, self.end_s = start_s, math.inf if end_s is None else end_s
        if not (math.isfinite(pace) and pace >= 0):
            raise ValueError(f"{log.path}: pace is {pace:g}; give 1 for the recording's own, or 0 for the fastest")
        if not 0 <= self.start_s <= self.end_s:
            until = "on" if end_s is None else f"to {end_s:g} s"
            raise ValueError(
                f"{log.path}: from {start_s:g} s {until} is not a range; give seconds after its first frame"
            )

        self._closed = threading.Event()

    @property
    def live(self) -> bool:
        """Whether frames come at a pace: then they do not wait for their reader."""
        return self.pace > 0

    def close(self) -> None:
        """End the present iteration."""
        self._closed.set()

    @property
    def notes(self) -> list[str]:
        """What was missing in the log."""
        return self.log.notes

    def __iter__(self) -> Iterator[Frame]:
        begun: float | None = None
        for frame in self.log.frames(self.start_s, self.end_s):
            if begun is None:
                begun, first_ns = time.monotonic(), frame.stamp_ns
            if self.pace > 0:
                due = begun + (frame.stamp_ns - first_ns) / 1e9 / self.pace
                self._closed.wait(max(0.0, due - time.monotonic()))
            if self._closed.is_set():
                return
            yield frame


def open_playback(
    path: Path | str | None,
    pace: float = 0.0,
    start_s: float = 0.0,
    end_s: float | None = None,
    camera: Camera | None = None,
    topics: TopicNames | None = None,
) -> Source:
    """The source at `path`, with `camera` and `topics` in place of its own (see `open_source`); a log as `Playback`.

    Raises ValueError if a range is given for a source that is not a log, and what `open_source` raises.
    """
    source = open_source(path, camera, topics)
    if isinstance(source, Log):
        return Playback(source, pace, start_s, end_s)
    if start_s or end_s is not None:
        raise ValueError(f"{path or SHIPPED_LOG} is no recording; omit --from and --to")
    return source


def frame_at(
    source: Path | str | None,
    index: int,
    start_s: float = 0.0,
    end_s: float | None = None,
    camera: Camera | None = None,
    topics: TopicNames | None = None,
) -> tuple[Frame, list[str]]:
    """Frame `index` (-1: the last) of a source, or of a recording's range, and the source's notes until there.

    Raises ValueError if there is no such frame, and what `open_playback` raises.
    """
    opened = open_playback(source, start_s=start_s, end_s=end_s, camera=camera, topics=topics)
    frame, count = None, 0
    for count, frame in enumerate(opened, start=1):  # noqa: B007
        if count == index + 1:
            break
    name = source or SHIPPED_LOG
    if frame is None:
        raise ValueError(" ".join([f"{name} has no frame; record it again", *(f"({note})" for note in opened.notes)]))
    if index not in (-1, count - 1):
        within = " in this range" if start_s or end_s is not None else ""
        raise ValueError(f"{name} has {count} frames{within}, no number {index}; give 0 to {count - 1}")
    return frame, list(opened.notes)
