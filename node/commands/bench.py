"""`farside bench`: runs the command `python -m benchmarks` of the checkout, which is not installed."""

import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

import node

CHECKOUT = Path(node.__file__).resolve().parent.parent


def bench(args: Sequence[str]) -> int:
    """Run the studies' command with these arguments and return its exit code. Errors of a study are raised.

    Raises FileNotFoundError outside a checkout.
    """
    path = CHECKOUT / "benchmarks" / "__main__.py"
    if not path.is_file():
        raise FileNotFoundError("farside bench runs from a checkout of the repository: an installed package lacks it")
    if str(CHECKOUT) not in sys.path:
        sys.path.insert(0, str(CHECKOUT))
    return runpy.run_path(str(path))["main"](args)
