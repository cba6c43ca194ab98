"""Means over objects with their 95% intervals, as rows; progress lines."""

import sys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from benchmarks.rows import Row
from probnerf.metrics import PairedInterval, paired_interval


def interval(values: Float[ArrayLike, "n"]) -> PairedInterval:
    """Mean and 95% Student-t interval over objects; NaN (an empty stratum) is left out."""
    values = np.asarray(values, np.float64)
    return paired_interval(values, np.zeros_like(values))


def mean_rows(
    name: str, method: str, condition: str, metric: str, values: Float[ArrayLike, "n"], unit: str
) -> list[Row]:
    """A mean over objects and, as rows of their own, its 95% interval's ends."""
    i = interval(values)
    ends = ((metric, i.mean), (f"{metric}_q025", i.low), (f"{metric}_q975", i.high))
    return [Row(name, method, condition, label, float(value), unit, i.n) for label, value in ends]


def say(text: str, end: str = "\n") -> None:
    """A line on stderr, where a measurement's progress goes."""
    print(text, end=end, file=sys.stderr, flush=True)


def table(title: str, header: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    """A small table of text on stderr, columns aligned."""
    widths = [max(len(str(line[i])) for line in (header, *lines)) for i in range(len(header))]
    say(f"\n{title}")
    for line in (header, ["-" * w for w in widths], *lines):
        say("  " + "  ".join(str(cell).ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip())
