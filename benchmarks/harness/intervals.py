"""Means over objects and paired differences, with their 95% intervals, as rows."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from benchmarks.harness.rows import Row


@dataclass(frozen=True)
class PairedInterval:
    """Mean of paired differences a - b with its 95% interval (Student's t) over n pairs."""

    mean: float
    low: float
    high: float
    n: int


def paired_interval(a: Float[ArrayLike, "n"], b: Float[ArrayLike, "n"]) -> PairedInterval:
    """Mean and 95% Student-t interval of a - b over objects; a pair in which either is NaN is left out of n."""
    difference = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    difference = difference[~np.isnan(difference)]
    n = len(difference)
    mean = float(np.mean(difference)) if n else float("nan")
    if n < 2:
        return PairedInterval(mean, float("-inf"), float("inf"), n)
    half = float(stdtrit(n - 1, 0.975) * difference.std(ddof=1) / np.sqrt(n))
    return PairedInterval(mean, mean - half, mean + half, n)


def interval(values: Float[ArrayLike, "n"]) -> PairedInterval:
    """Mean and 95% Student-t interval over objects; NaN (an empty stratum) is left out."""
    values = np.asarray(values, np.float64)
    return paired_interval(values, np.zeros_like(values))


def mean_rows(
    name: str, method: str, condition: str, metric: str, values: Float[ArrayLike, "n"], unit: str
) -> list[Row]:
    """A mean over objects and, as rows of their own, the ends of its 95% interval."""
    return _rows(name, method, condition, metric, interval(values), unit)


def gap_rows(
    name: str,
    method: str,
    condition: str,
    metric: str,
    a: Float[ArrayLike, "n"],
    b: Float[ArrayLike, "n"],
    *,
    unit: str = "nats",
) -> list[Row]:
    """The mean of paired differences a - b and, as rows of their own, the ends of its 95% interval."""
    return _rows(name, method, condition, metric, paired_interval(a, b), unit)


def _rows(name: str, method: str, condition: str, metric: str, i: PairedInterval, unit: str) -> list[Row]:
    ends = ((metric, i.mean), (f"{metric}_q025", i.low), (f"{metric}_q975", i.high))
    return [Row(name, method, condition, label, float(value), unit, i.n) for label, value in ends]


class Figures:
    """Rows by condition, method and metric; NaN where there is none."""

    def __init__(self, rows: Iterable[Row]) -> None:
        self._rows = {(row.condition, row.method, row.metric): row for row in rows}

    def __call__(self, condition: str, method: str, metric: str) -> float:
        """A figure's value."""
        row = self._rows.get((condition, method, metric))
        return float("nan") if row is None else row.value

    def __contains__(self, figure: tuple[str, str, str]) -> bool:
        """Whether there is a row of this condition, method and metric."""
        return figure in self._rows

    def count(self, condition: str, method: str, metric: str) -> int:
        """How many objects a figure is of; 0 where there is none."""
        row = self._rows.get((condition, method, metric))
        return 0 if row is None else row.n

    def interval(self, condition: str, method: str, metric: str) -> PairedInterval:
        """A figure with the ends of its interval."""
        mean, low, high = (self(condition, method, f"{metric}{end}") for end in ("", "_q025", "_q975"))
        return PairedInterval(mean, low, high, self.count(condition, method, metric))

    def methods(self, condition: str) -> list[str]:
        """Those with figures of a condition, in order."""
        return list(dict.fromkeys(method for c, method, _ in self._rows if c == condition))

    def conditions(self) -> list[str]:
        """In order."""
        return list(dict.fromkeys(condition for condition, _, _ in self._rows))
