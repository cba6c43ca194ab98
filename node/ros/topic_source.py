"""Frames from any ROS 2 camera driver, over the bus: image, depth and camera_info topics, paired by their stamps."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from calibration.camera import Camera
from node.ros.bus import Bus
from perception.sources.frame import Frame
from perception.sources.ros_images import stamp_ns, to_camera, to_depth, to_rgb
from perception.sources.stamp_matcher import Match, StampMatcher

_IMAGE, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))


@dataclass(frozen=True)
class TopicConfig:
    """Where a camera driver publishes. A colour topic whose name ends in /compressed carries CompressedImage."""

    colour: str = "/camera/color/image_raw"
    depth: str | None = "/camera/aligned_depth_to_color/image_raw"  # aligned to colour; None: frames without depth
    info: str = "/camera/color/camera_info"
    rectified: bool = False  # the images are: the camera is that of the info's P, without distortion
    tolerance_ms: float = 10.0  # between the stamps of colour and depth
    silence_s: float = 2.0  # without a frame, after which a note says so
    end_s: float | None = None  # without a frame, after which the source ends; None: never
    waiting: int = 10  # colour images that wait for their depth, at most

    def __post_init__(self) -> None:
        if not (self.tolerance_ms >= 0 and self.silence_s > 0 and self.waiting >= 1):
            raise ValueError("tolerance_ms must not be negative, silence_s be positive, and waiting be 1 or more")


class TopicSource:
    """A live source: iterate over it for the newest frames; those that come while a frame is worked on are left out.

    `notes` says what was missing or wrong, once a kind; `dropped` counts the colour images that found no depth,
    `skipped` the frames that came too fast. It listens until `bus` ends; `close` ends an iteration.
    """

    live = True

    def __init__(self, bus: Bus, config: TopicConfig | None = None) -> None:
        self.config = c = config or TopicConfig()
        self.notes: list[str] = []
        self.dropped = self.skipped = 0
        self._changed = threading.Condition()
        streams = () if c.depth is None else (c.depth,)
        self._matcher: StampMatcher[Any, Any] = StampMatcher(
            streams, round(c.tolerance_ms * 1e6), c.waiting, 2 * c.waiting
        )
        self._matched: tuple[Any, Any] | None = None  # the newest colour and its depth, until there is an info
        self._info: Any = None
        self._heard: set[str] = set()  # topics on which something came since the last frame
        self._newest: Frame | None = None
        self._closed = False
        compressed = c.colour.endswith("/compressed")
        self._names = [bus.subscribe(c.info, _INFO, self._take_info, depth=1)]
        self._names.append(bus.subscribe(c.colour, _COMPRESSED if compressed else _IMAGE, self._take_colour, depth=3))
        if c.depth is not None:
            packed = c.depth.endswith("/compressed") or c.depth.endswith("/compressedDepth")
            self._names.append(bus.subscribe(c.depth, _COMPRESSED if packed else _IMAGE, self._take_depth, depth=3))

    def close(self) -> None:
        """End the iteration, from any thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        heard = noted = time.monotonic()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest is not None or self._closed, timeout=0.1)
                if self._closed:
                    return
                frame, self._newest = self._newest, None
            now = time.monotonic()
            if frame is not None:
                yield frame
                heard = noted = time.monotonic()
            elif self.config.end_s is not None and now - heard > self.config.end_s:
                return
            elif now - noted > self.config.silence_s:
                noted = float("inf")  # said once, until a frame comes
                self._note(self._why_silent(now - heard))

    def _why_silent(self, seconds: float) -> str:
        with self._changed:
            heard = self._heard | ({self.config.info} if self._info is not None else set())
            wanted = (self.config.info, self.config.colour, *filter(None, [self.config.depth]))
            missing = [name for name, topic in zip(self._names, wanted, strict=True) if topic not in heard]
        why = f"nothing came on {', '.join(missing)}" if missing else "no colour image found its depth"
        return f"no frame for {seconds:.1f} s: {why}; is the driver up, on this domain and with these topic names?"

    def _take_info(self, info: Any) -> None:
        with self._changed:
            self._info = info
        self._make_frame()

    def _take_colour(self, message: Any) -> None:
        with self._changed:
            self._heard.add(self.config.colour)
            self._settle(self._matcher.push_lead(stamp_ns(message), message))
        self._make_frame()

    def _take_depth(self, message: Any) -> None:
        depth = self.config.depth
        assert depth is not None
        with self._changed:
            self._heard.add(depth)
            self._settle(self._matcher.push_partner(depth, stamp_ns(message), message))
        self._make_frame()

    def _settle(self, matches: list[Match[Any, Any]]) -> None:
        """Keep the newest pair; count what is left out. The lock is held."""
        depth = self.config.depth
        for match in matches:
            found = None if depth is None else match.partners[depth]
            if depth is None or found is not None:
                self.skipped += self._matched is not None and self._info is not None
                self._matched = match.lead, found
                continue
            self.dropped += 1
            if (gap := match.gaps_ns[depth]) < float("inf"):
                self._note(
                    f"colour images are dropped for want of depth within {self.config.tolerance_ms:g} ms (the nearest"
                    f" was {gap / 1e6:.1f} ms away); synchronise the streams, or raise tolerance_ms"
                )

    def _make_frame(self) -> None:
        """The newest frame from the pair that is complete, if there is one."""
        with self._changed:
            if self._info is None or self._matched is None:
                return
            (colour, depth), self._matched = self._matched, None
            info = self._info
        try:
            frame = self._frame(colour, depth, to_camera(info, self.config.rectified))
        except ValueError as error:
            self._note(f"frames are left out: {error}")
            raise ValueError(f"a frame is left out: {error}") from None  # the bus counts it
        with self._changed:
            self._heard.clear()
            self.skipped += self._newest is not None
            if self._newest is None or frame.stamp_ns > self._newest.stamp_ns:
                self._newest = frame
            self._changed.notify_all()

    def _frame(self, colour: Any, depth: Any, camera: Camera) -> Frame:
        rgb = to_rgb(colour)
        metres = None if depth is None else to_depth(depth)
        return Frame(rgb, metres, camera, stamp_ns=stamp_ns(colour), frame_id=colour.header.frame_id)

    def _note(self, text: str) -> None:
        if text.partition(":")[0] not in {note.partition(":")[0] for note in self.notes}:
            self.notes.append(text)
