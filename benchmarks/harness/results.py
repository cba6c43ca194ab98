"""The rows of a study, appended to its file as they come: a run can be stopped at any time and goes on where it ended.

A file has one JSON value a line. An object describes a run: what all of its rows have in common, and the names of
their columns. A list is a row: the run's name and the columns' values. Files of two machines can be joined by `cat`.
"""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from benchmarks.harness.machine import machine, revision
from benchmarks.harness.progress import say
from probnerf.types import StopReason

FOLDER = Path(__file__).resolve().parent.parent / "results"  # one file a study
Line = dict[str, Any]  # a row with all that it has in common with its run
KEY = ("prior", "method", "settings", "condition", "object", "seed")  # rows that agree in these are the same result
COMMON = ("prior", "method", "settings", "seed", "revision", "machine")  # stored once a run


def key(line: Line) -> tuple[str, ...]:
    """A row's identity, whatever the order of its settings."""
    return tuple(json.dumps(line[name], sort_keys=True) for name in KEY)


def digest(settings: object, quick: bool = False) -> str:
    """Settings in twelve characters; those of a quick run (a base rate of fewer objects) are others."""
    return sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:12] + "-quick" * quick


def encoded(line: Line) -> tuple[str, str]:
    """A row as two lines of its file: the run's description, and the row."""
    columns = [name for name in line if name not in COMMON]
    run = {**{name: line[name] for name in COMMON}, "columns": columns}
    name = sha256(json.dumps(run, sort_keys=True).encode()).hexdigest()[:8]
    return _compact({"run": name, **run}), _compact([name, *(line[column] for column in columns)])


def _decoded(run: Line, row: list) -> Line:
    return {**{name: run[name] for name in COMMON}, **dict(zip(run["columns"], row[1:], strict=True))}


def _compact(value: object) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=False)


def read_lines(path: Path) -> list[Line]:
    """All rows; a last line that was cut short is taken off the file. Raises ValueError for any other damage."""
    if not path.is_file():
        return []
    parts = path.read_bytes().split(b"\n")
    whole, rest = parts[:-1], parts[-1]
    runs: dict[str, Line] = {}
    lines: list[Line] = []
    for number, part in enumerate(whole, start=1):
        try:
            value = json.loads(part)
            if isinstance(value, dict):
                runs[value.pop("run")] = value
                continue
            lines.append(_decoded(runs[value[0]], value))
            key(lines[-1])
        except (ValueError, KeyError, TypeError, IndexError):
            raise ValueError(f"{path}: line {number} is damaged; remove it, and its result is made again") from None
    if rest:
        os.truncate(path, path.stat().st_size - len(rest))
    return lines


def refuse_cut(result: str) -> None:
    """Raises KeyboardInterrupt where one ended an answer, which the sampler keeps for itself: it is no measurement."""
    if result == StopReason.INTERRUPTED:
        raise KeyboardInterrupt


def newest(lines: Iterable[Line], prior: str, seed: int | None = None) -> list[Line]:
    """Rows of one prior (and seed), and of each method those whose settings are the last ones in the file.

    Of a result that was made twice, the last one.
    """
    same = [line for line in lines if line["prior"] == prior and seed in (None, line["seed"])]
    chosen = list({key(line): line for line in same}.values())
    settings = {line["method"]: line["settings"] for line in chosen}
    return [line for line in chosen if line["settings"] == settings[line["method"]]]


@dataclass(eq=False)
class Results:
    """A study's file: all of its rows, in their order."""

    path: Path

    def __post_init__(self) -> None:
        self.lines = read_lines(self.path)
        self._known = {key(line) for line in self.lines}
        self._runs = {encoded(line)[0] for line in self.lines}

    def __contains__(self, line: Line) -> bool:
        """Whether the file has a row of this identity."""
        return key(line) in self._known

    def add(self, line: Line) -> Line:
        """Append a row, with the revision and the machine, and wait until it is on disk.

        Raises KeyboardInterrupt for an answer that was cut (`refuse_cut`): it is not kept.
        """
        refuse_cut(line.get("result", ""))
        line = {"revision": revision(), "machine": machine(), **line}
        run, row = encoded(line)
        line = _decoded(json.loads(run), json.loads(row))  # as it will be read
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            file.write("".join(f"{part}\n" for part in (run, row)[run in self._runs :]).encode())
            file.flush()
            os.fsync(file.fileno())
        self.lines.append(line)
        self._known.add(key(line))
        self._runs.add(run)
        return line

    def fill(self, measure: Callable[[], None]) -> None:
        """Add what the file lacks; Ctrl-C ends it, and what is done is kept."""
        try:
            measure()
        except KeyboardInterrupt:
            say(f"stopped; {self.path} keeps what is done")


def objects_of(lines: Sequence[Line]) -> list[Any]:
    """The objects of these rows, in order and each once."""
    return list(dict.fromkeys(line["object"] for line in lines))
