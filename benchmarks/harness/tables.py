"""Small tables of text: on the terminal, and in Markdown for docs/figures.md; and whether a gate is passed."""

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.harness.intervals import PairedInterval
from benchmarks.harness.rows import Row

PASS, FAIL = "pass", "FAIL"


@dataclass(frozen=True)
class Table:
    """Cells of text under a header; the title says what they are of."""

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]

    def text(self) -> str:
        """For a terminal: columns aligned by spaces."""
        rows = [self.header, *self.lines]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.header))]
        shown = [self.header, ["-" * w for w in widths], *self.lines]
        lines = ("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in shown)
        return "\n".join([self.title, *(f"  {line}" for line in lines)])

    def markdown(self) -> str:
        """For a page: a failed gate in bold."""
        cells = ([cell.replace("|", "\\|").replace(FAIL, f"**{FAIL}**") for cell in row] for row in self.lines)
        head = f"| {' | '.join(self.header)} |\n|{'---|' * len(self.header)}"
        return "\n".join([f"{self.title}:\n", head, *(f"| {' | '.join(row)} |" for row in cells)])


def row_table(rows: Sequence[Row]) -> Table:
    """All rows, one a line."""
    lines = [[r.method, r.condition, r.metric, f"{r.value:.4g}", r.unit, str(r.n)] for r in rows]
    return Table("All figures", ("method", "condition", "metric", "value", "unit", "n"), lines)


def verdict(value: float, least: float = float("-inf"), most: float = float("inf")) -> str:
    """Whether a value lies between the gate's ends; NaN passes nothing."""
    return PASS if least <= value <= most else FAIL


def gated(text: str, value: float, least: float = float("-inf"), most: float = float("inf")) -> str:
    """A figure's text and its verdict."""
    return f"{text}: {verdict(value, least, most)}"


def between(i: PairedInterval, digits: int = 3, sign: str = "") -> str:
    """The ends of an interval."""
    return f"{i.low:{sign}.{digits}f} to {i.high:{sign}.{digits}f}"


def ranged(i: PairedInterval, digits: int = 3, sign: str = "") -> str:
    """A mean and the ends of its interval; one value has none."""
    if i.n == 1:
        return f"{i.mean:{sign}.{digits}f}"
    return f"{i.mean:{sign}.{digits}f} ({between(i, digits, sign)})"
