"""A study's figures as rows, which a table shows and `--json` writes."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from foundation.whole_file import write_whole


@dataclass(frozen=True)
class Row:
    """One figure, with everything needed to compare it with another."""

    name: str  # of the study, such as "hidden"
    method: str  # what was measured, such as "tempered_smc", "prior alone", "map"
    condition: str  # on what, such as "handle hidden, RGB-D" or "object 11, label given"
    metric: str  # such as "hidden_nll"; an interval's ends are rows of their own ("hidden_nll_q025")
    value: float
    unit: str  # "nats", "mm", "s", "dB"; "" for a fraction or a count
    n: int  # objects (or views, pixels: whatever the value is a mean over)


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as a JSON list of objects, whole or not at all."""
    write_json(path, [asdict(row) for row in rows])


def write_json(path: Path, value: object) -> None:
    """Write a JSON file, whole or not at all."""
    write_whole(path, json.dumps(value, indent=1) + "\n")
