"""A module's command, `python -m benchmarks...`: what is wrong with its input is said in one line, as by `farside`."""

from collections.abc import Callable
from typing import Any

import tyro

from benchmarks.harness.progress import say
from foundation.one_line import one_line


def command(main: Callable[[Any], object], options: type) -> None:
    """Run `main` with the command line's options, and say what it returns.

    Raises SystemExit with one line for a ValueError or a file that is not there.
    """
    try:
        found = main(tyro.cli(options))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
    if found is not None:
        say(str(found))
