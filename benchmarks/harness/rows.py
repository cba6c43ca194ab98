"""What a measurement hands back: rows that a table shows and `--json` writes.

A measurement NAME is the module `benchmarks/NAME.py`. The first line of its docstring is its help. It has

    def main(out: Path, quick: bool = False, ...) -> list[Row]

`farside bench NAME` calls it: every further keyword of `main` has a type and a default and becomes an option of that
name (`map_steps: int = 300` is `--map-steps`). `quick` asks for the same measurement on a few objects, in a minute.
`main` shows progress on stderr, draws its picture to `out / "NAME.png"` and writes nothing outside `out`, save the file
of results that long ones add to; the command prints the table, writes the JSON and names the picture.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One figure, with everything needed to compare it with another."""

    name: str  # of the measurement, such as "hidden"
    method: str  # what was measured, such as "tempered_smc", "prior alone", "map"
    condition: str  # on what, such as "handle hidden, RGB-D" or "object 11, label given"
    metric: str  # such as "hidden_nll"; an interval's ends are rows of their own ("hidden_nll_q025")
    value: float
    unit: str  # "nats", "mm", "s", "dB"; "" for a fraction or a count
    n: int  # objects (or views, pixels: whatever the value is a mean over)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as a JSON list of objects, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
