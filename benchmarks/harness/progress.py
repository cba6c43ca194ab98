"""Progress lines on stderr."""

import sys


def say(text: str, end: str = "\n") -> None:
    """Write a progress line to stderr."""
    print(text, end=end, file=sys.stderr, flush=True)
