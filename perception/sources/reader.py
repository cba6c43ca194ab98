"""Reading frames without ever delaying a camera: the newest for inference, every one for a recording.

A `Reader` pulls from a source in a thread of its own. Slow or stopped consumers do not delay it: frames that a consumer
does not take in time are dropped for that consumer alone, and counted.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TypeVar

from foundation.one_line import one_line
from perception.sources.frame import Frame, Source

_CLOSING_S = 2.0  # limit of a source's end, before its thread is abandoned
_ARRIVALS = 31  # frames over which the rate is taken
Result = TypeVar("Result")


@dataclass(frozen=True)
class ReaderCounts:
    """The counts of a `Reader` so far."""

    received: int  # frames
    rate: float  # Hz, over the last 30 frames; it falls while the source is silent
    dropped: dict[str, int]  # by consumer: "newest" (a newer frame came before it was taken), and each listener's name
    notes: tuple[str, ...]  # of the source
    error: str | None  # that ended the source, one line
    ended: bool  # nothing more will come


class Reader:
    """Pulls frames from a source in a thread, between `with Reader(source) as reader:` and its end.

    An exception of the source ends the reader; `newest` and every listener raise it after the last frame.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._pull, name="farside reader", daemon=True)
        self._newest: Frame | None = None
        self._listeners: list[Listener] = []
        self._received = 0
        self._replaced = 0
        self._arrivals: deque[float] = deque(maxlen=_ARRIVALS)
        self._error: Exception | None = None
        self._closed = False
        self._ended = False
        self._left_behind: tuple[str, ...] = ()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the source and the thread. A source that does not end within two seconds is abandoned, with a note."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self.source.close()
        if self._thread.ident is not None:
            self._thread.join(_CLOSING_S)
            if self._thread.is_alive():
                self._left_behind = (f"the source did not end within {_CLOSING_S:g} s; its thread is left behind",)

    def listen(self, name: str, size: int = 90) -> "Listener":
        """A consumer that gets every frame from now on (from the first, before the `with`); up to `size` may wait.

        Raises `ValueError` if another listener has the name.
        """
        with self._changed:
            if name == "newest" or any(other.name == name for other in self._listeners):
                raise ValueError(f"a listener named {name!r} is there already; give another name")
            listener = Listener(self, name, size)
            self._listeners.append(listener)
        return listener

    def newest(self, timeout: float | None = None) -> Frame | None:
        """The newest frame not returned before, waited for at most `timeout` seconds (None: until the end).

        None if none came or none will come. Raises what the source raised.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self.over, timeout)
            frame, self._newest = self._newest, None
            if frame is None and self._error is not None:
                raise self._error
            return frame

    @property
    def over(self) -> bool:
        """Whether the source has ended."""
        return self._ended or self._closed

    def counts(self) -> ReaderCounts:
        """The counts so far; from any thread."""
        with self._changed:
            rate = 0.0
            if len(self._arrivals) > 1:
                between = (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)
                late = time.monotonic() - self._arrivals[-1]
                rate = 1.0 / max(between, late / 2.0, 1e-9)  # one frame that is a little late is no silence
            return ReaderCounts(
                self._received,
                rate,
                {"newest": self._replaced} | {listener.name: listener.dropped for listener in self._listeners},
                (*self.source.notes, *self._left_behind),
                None if self._error is None else one_line(self._error),
                self.over,
            )

    def _pull(self) -> None:
        try:
            for frame in self.source:
                with self._changed:
                    if self._closed:
                        break
                    self._received += 1
                    self._arrivals.append(time.monotonic())
                    self._replaced += self._newest is not None
                    self._newest = frame
                    for listener in self._listeners:
                        listener._offer(frame)
                    self._changed.notify_all()
        except Exception as error:  # of any kind: the consumers raise it
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()


class Listener:
    """A consumer of every frame of a `Reader`. If too many wait, new ones are dropped, and counted."""

    def __init__(self, reader: Reader, name: str, size: int) -> None:
        if size < 1:
            raise ValueError(f"listener {name!r} keeps {size} frames; give 1 or more")
        self.name = name
        self.dropped = 0
        self._reader = reader
        self._size = size
        self._waiting: deque[Frame] = deque()
        self._closed = False

    def take(self, timeout: float | None = None) -> Frame | None:
        """The next frame, waited for at most `timeout` seconds (None: until the end); None where none came.

        `ended` tells whether more will come. Raises what the source raised, after the last frame.
        """
        reader = self._reader
        with reader._changed:
            reader._changed.wait_for(lambda: bool(self._waiting) or reader.over or self._closed, timeout)
            if self._waiting:
                return self._waiting.popleft()
            if reader._error is not None and not self._closed:
                raise reader._error
            return None

    @property
    def ended(self) -> bool:
        """No frame waits and none will come."""
        return not self._waiting and (self._closed or self._reader.over)

    def __iter__(self) -> Iterator[Frame]:
        """Every frame until the source ends or either side is closed. Raises what the source raised."""
        while (frame := self.take()) is not None:
            yield frame

    def close(self) -> None:
        """Stop listening; waiting frames are dropped."""
        with self._reader._changed:
            self._closed = True
            self._waiting.clear()
            self._reader._changed.notify_all()

    def _offer(self, frame: Frame) -> None:
        """The reader's thread, which holds the lock, brings a frame."""
        if self._closed:
            return
        if len(self._waiting) < self._size:
            self._waiting.append(frame)
        else:
            self.dropped += 1
