"""What changed between two revisions: a study's kept rows beside those of before, object by object.

Rows are paired where condition, method, object and seed are the same; an object's seeds count as one. Of each file the
rows of one prior are read, that of its last row unless another is named, with each method's newest settings. A
difference is after less before, with its 95% interval (Student's t over objects). Only numbers that both have are
compared: scores, counts and seconds alike; lower is not always better, and machines round differently.
"""

import subprocess
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float

from benchmarks.harness.intervals import gap_rows, paired_interval
from benchmarks.harness.results import FOLDER, KEY, Line, newest, read_lines
from benchmarks.harness.rows import Row
from benchmarks.harness.study import StudyOptions, Summary
from benchmarks.harness.tables import Table, ranged

_ROOT = FOLDER.parent.parent
_Group = tuple[str, str, str]  # condition, method, column
_Pairs = Float[np.ndarray, "2 n"]  # before and after


@dataclass(frozen=True)
class Options(StudyOptions):
    """Differences of two revisions' rows, paired."""

    study: str = "calibration"
    """Whose rows: those of benchmarks/results/STUDY.jsonl."""
    before: str = "HEAD~1"
    """A file of older rows, or a revision of this repository."""
    columns: str = ""
    """Only these columns, separated by semicolons."""
    prior_before: str = ""
    """Beginning of the prior's identity in the older rows; that of the last one by default."""
    prior: str = ""
    """The same of the rows of today."""


def main(options: Options) -> Summary:
    """Read both, and sum up. Raises ValueError where there is no such file, revision or column, or no pair."""
    path = FOLDER / f"{options.study}.jsonl"
    if not path.is_file():
        there = ", ".join(sorted(p.stem for p in FOLDER.glob("*.jsonl")))
        raise ValueError(f"{path} does not exist; rows are kept of {there}")
    after, before = of_prior(read_lines(path), options.prior), of_prior(_older(options, path), options.prior_before)
    found = differences(before, after, [name.strip() for name in options.columns.split(";") if name.strip()])
    if not found:
        raise ValueError(f"no row of {path} has a partner with numbers of these columns in {options.before}")
    rows: list[Row] = []
    lines = []
    for (condition, method, column), (old, new) in found.items():
        for name, value in (("before", old.mean()), ("after", new.mean())):
            rows.append(Row("paired", method, condition, f"{column}, {name}", float(value), "", len(old)))
        rows += gap_rows("paired", method, condition, f"{column}, difference", new, old, unit="")
        gap = ranged(paired_interval(new, old), sign="+")
        lines.append([condition, method, column, str(len(old)), f"{old.mean():.3f}", f"{new.mean():.3f}", gap])
    header = ("condition", "method", "column", "n", "before", "after", "difference (95%)")
    return Summary(rows, [Table(f"{options.study}: rows of today beside those of {options.before}", header, lines)])


def _older(options: Options, path: Path) -> list[Line]:
    if Path(options.before).is_file():
        return read_lines(Path(options.before))
    name = f"benchmarks/results/{path.name}"
    shown = subprocess.run(["git", "show", f"{options.before}:{name}"], cwd=_ROOT, capture_output=True, check=False)
    if shown.returncode:
        why = shown.stderr.decode(errors="replace").strip().splitlines()[-1]
        raise ValueError(f"{options.before} is no file, and as a revision: {why}")
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(shown.stdout)
        return read_lines(copy)


def of_prior(lines: Sequence[Line], prior: str) -> list[Line]:
    """The newest rows of the last prior in the file whose identity begins so."""
    named = [str(line["prior"]) for line in lines if str(line["prior"]).startswith(prior)]
    return newest(lines, named[-1]) if named else []


def differences(before: Iterable[Line], after: Iterable[Line], columns: Sequence[str] = ()) -> dict[_Group, _Pairs]:
    """The values before and after, of each object that both have, by group."""
    older, newer = _values(before, columns), _values(after, columns)
    found: dict[_Group, _Pairs] = {}
    for group, values in newer.items():
        objects: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for (name, seed), value in values.items():
            if (name, seed) in older.get(group, {}):
                objects[name].append((older[group][name, seed], value))
        if objects:
            found[group] = np.array([np.mean(each, axis=0) for each in objects.values()]).T
    return found


def _values(lines: Iterable[Line], columns: Sequence[str]) -> dict[_Group, dict[tuple[str, int], float]]:
    """Numbers by group, and by object and seed; of yes and no, 1 and 0."""
    found: dict[_Group, dict[tuple[str, int], float]] = defaultdict(dict)
    for line in lines:
        for column, value in line.items():
            if isinstance(value, int | float) and column not in KEY and (not columns or column in columns):
                group = (str(line["condition"]), str(line["method"]), column)
                found[group][str(line["object"]), line["seed"]] = float(value)
    return found
