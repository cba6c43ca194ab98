"""Time spent in the parts of a job."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Stopwatch:
    """Seconds spent on each part of a job. A part within another is counted for itself alone."""

    seconds: dict[str, float] = field(default_factory=dict)
    _open: list[str] = field(default_factory=list)  # parts under way, the innermost last
    _since: float = 0.0  # on time.monotonic()'s clock; up to then all is counted

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Within, time counts for this part."""
        self._count()
        self._open.append(name)
        try:
            yield
        finally:
            self._count()
            self._open.pop()

    def _count(self) -> None:
        now = time.monotonic()
        if self._open:
            name = self._open[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now
