"""Counts of messages by fate, and a limit of their rate."""

import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress

MOST_WORDS = 500  # characters of a line that may quote what came; no control characters, which a terminal would obey


class MessageCounts:
    """Counts of messages by topic or service and fate: sent, received, dropped, too_large, too_fast, malformed, failed,
    refused, other_type.
    The first fault of each kind that has words is reported in a line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._lock = say, threading.Lock()
        self._counts: dict[str, Counter[str]] = {}
        self._told: set[tuple[str, str]] = set()

    def add(self, name: str, fate: str, trouble: str = "", count: int = 1) -> None:
        """Count a fate; `trouble` is reported if it is the first of its kind."""
        with self._lock:
            counter = self._counts.setdefault(name, Counter())
            counter[fate] += count
            first = bool(trouble) and (name, fate) not in self._told
            if first:
                self._told.add((name, fate))
        if first:
            with suppress(Exception):  # what listens goes on if nobody can be told any more
                self._say(f"{name}: {plainly(trouble)} (further ones are only counted)")

    def of(self, name: str) -> dict[str, int]:
        """The counts of one full name."""
        with self._lock:
            return dict(self._counts.get(name, {}))

    def all(self) -> dict[str, dict[str, int]]:
        """The counts by full name."""
        with self._lock:
            return {name: dict(counter) for name, counter in self._counts.items()}


def plainly(trouble: str) -> str:
    """Words that may quote a stranger's, safe to print and to answer with."""
    short = trouble if len(trouble) <= MOST_WORDS else f"{trouble[:MOST_WORDS]} ..."
    return "".join(c if c.isprintable() else "\ufffd" for c in short)


class Rate:
    """At most `hz` events per second, in bursts of at most a second's worth."""

    def __init__(self, hz: float) -> None:
        self._hz, self._left, self._last, self._lock = hz, max(1.0, hz), time.monotonic(), threading.Lock()

    def allows(self) -> bool:
        """Whether one more may happen now; it counts as happened."""
        with self._lock:
            now = time.monotonic()
            self._left = min(max(1.0, self._hz), self._left + (now - self._last) * self._hz)
            self._last = now
            if self._left < 1.0:
                return False
            self._left -= 1.0
            return True
