"""Results of a long measurement, one JSON line each, appended as they come: it can be cut and taken up again."""

import json
import os
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent.parent / "results"  # one file a study
Line = dict[str, Any]
KEY = ("prior", "method", "settings", "condition", "object", "seed")  # what makes a result the same one


def key(line: Line) -> tuple[str, ...]:
    """A line's identity, whatever the order of its settings."""
    return tuple(json.dumps(line[name], sort_keys=True) for name in KEY)


def digest(told: object, quick: bool = False) -> str:
    """Settings in twelve characters; those of a quick run (a base rate of fewer objects) are others."""
    return sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:12] + "-quick" * quick


def read_lines(path: Path) -> list[Line]:
    """All lines; a last one that was cut short is taken off the file. Raises ValueError for any other damage."""
    if not path.is_file():
        return []
    parts = path.read_bytes().split(b"\n")
    whole, rest = parts[:-1], parts[-1]
    lines: list[Line] = []
    for number, part in enumerate(whole, start=1):
        try:
            lines.append(json.loads(part))
            key(lines[-1])
        except (ValueError, KeyError, TypeError):
            if number < len(whole) or rest:
                raise ValueError(f"{path}: line {number} is damaged; remove it, and its result is made again") from None
            lines, rest = lines[: number - 1], part
    if rest:
        os.truncate(path, sum(len(part) + 1 for part in whole[: len(lines)]))
    return lines


def refuse_cut(result: str) -> None:
    """Raises KeyboardInterrupt where one ended an answer, which the sampler keeps for itself: it is no measurement."""
    if result == "interrupted":
        raise KeyboardInterrupt


def append_line(path: Path, line: Line) -> None:
    """Append one line and wait until it is on disk; not one whose `result` was cut (`refuse_cut`)."""
    refuse_cut(line.get("result", ""))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as file:
        file.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def newest(lines: Iterable[Line], prior: str, seed: int) -> list[Line]:
    """Lines of one prior and seed, and of each method those whose settings are the last ones in the file.

    Of a result that a cut made twice, the last one.
    """
    chosen = list({key(line): line for line in lines if line["prior"] == prior and line["seed"] == seed}.values())
    settings = {line["method"]: line["settings"] for line in chosen}
    return [line for line in chosen if line["settings"] == settings[line["method"]]]
