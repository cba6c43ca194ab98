"""Progress lines and small text tables on stderr."""

import sys
from collections.abc import Sequence


def say(text: str, end: str = "\n") -> None:
    """Write a progress line to stderr."""
    print(text, end=end, file=sys.stderr, flush=True)


def table(title: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """Write a small text table to stderr, columns aligned."""
    widths = [max(len(str(line[i])) for line in (header, *lines)) for i in range(len(header))]
    say(f"\n{title}")
    for line in (header, ["-" * w for w in widths], *lines):
        say("  " + "  ".join(str(cell).ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip())
