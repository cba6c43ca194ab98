"""Means over objects and paired differences, with their 95% intervals, as rows."""

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
    unit: str = "nats",
) -> list[Row]:
    """The mean of paired differences a - b and, as rows of their own, the ends of its 95% interval."""
    return _rows(name, method, condition, metric, paired_interval(a, b), unit)


def _rows(name: str, method: str, condition: str, metric: str, i: PairedInterval, unit: str) -> list[Row]:
    ends = ((metric, i.mean), (f"{metric}_q025", i.low), (f"{metric}_q975", i.high))
    return [Row(name, method, condition, label, float(value), unit, i.n) for label, value in ends]
