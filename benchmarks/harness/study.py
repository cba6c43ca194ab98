"""What a study is: options, a summary, and the report of it.

A study NAME is the module `benchmarks/studies/NAME.py`. Its docstring says what is measured, and how. It has

    @dataclass(frozen=True)
    class Options(StudyOptions):        # or ResumedOptions, or PriorOptions
        "One sentence: the help."
    def main(options: Options) -> Summary

and, where its rows are kept in a file, `summary(lines, options)`, which docs/figures.md is made with.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table as RichTable
from tyro.conf import arg

from benchmarks.harness.machine import machine, revision
from benchmarks.harness.progress import say
from benchmarks.harness.results import FOLDER, Results
from benchmarks.harness.rows import Row, write_json, write_rows
from benchmarks.harness.tables import Table, row_table


@dataclass(frozen=True)
class StudyOptions:
    """Options of every study."""

    out: Annotated[Path, arg(metavar="DIR")] = Path("out/bench")
    """Folder for the picture."""
    quick: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only a few objects, in a minute."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: no)")] = None
    """Write the rows as JSON."""


@dataclass(frozen=True)
class TableOptions(StudyOptions):
    """Options of a study that keeps no rows of single objects."""

    keep: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the tables in benchmarks/results/, for docs/figures.md."""


@dataclass(frozen=True)
class PriorTableOptions(TableOptions):
    """Options of such a study of the whole path from frame to answer."""

    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped ones)")] = None
    """Weights to use."""
    seed: int = 0
    """Of the samplers."""


@dataclass(frozen=True)
class ResumedOptions(StudyOptions):
    """Options of a study whose rows are appended to a file, object by object; what is there is not made again."""

    results: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: that of the checkout)")] = None
    """File that rows are appended to, and read from."""
    only_chart: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show what the file holds, and measure nothing."""


@dataclass(frozen=True)
class PriorOptions(ResumedOptions):
    """Options of a resumed study of the whole path from frame to answer."""

    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped ones)")] = None
    """Weights to use."""
    seed: int = 0
    """Of the samplers."""


@dataclass(frozen=True, eq=False)
class Summary:
    """What a study found."""

    rows: list[Row]
    tables: Sequence[Table] = ()
    picture: Callable[[], Figure] | None = field(default=None, repr=False)


def results_of(name: str, options: ResumedOptions) -> Results:
    """The study's file; that of a quick run lies beside its picture."""
    default = options.out / f"{name}.jsonl" if options.quick else FOLDER / f"{name}.jsonl"
    return Results(options.results or default)


def resumed(
    results: Results, options: ResumedOptions, measure: Callable[[], None], summed: Callable[[], Summary | None]
) -> Summary:
    """Measure what the file lacks (not with `only_chart`) and sum up what it has.

    Raises ValueError where it has none of what was asked for.
    """
    if not options.only_chart:
        results.fill(measure)
    found = summed()
    if found is None:
        raise ValueError(f"{results.path} has no results of this prior and these options; omit --only-chart")
    return found


def selected(text: str, known: Sequence[str], what: str) -> list[str]:
    """The names that an option asks for, separated by semicolons; all that are known where it asks for none.

    Raises ValueError for a name that is not known.
    """
    names = [part.strip() for part in text.split(";") if part.strip()] or list(known)
    if unknown := set(names) - set(known):
        raise ValueError(f"no {what} {sorted(unknown)}; there are: {'; '.join(known)}")
    return names


def report(name: str, summary: Summary, options: StudyOptions) -> None:
    """Show the tables and rows, save the picture, and write what the options ask for."""
    for table in summary.tables:
        say(f"\n{table.text()}")
    console, shown = Console(), RichTable(title=name)
    every = row_table(summary.rows)
    for heading in every.header:
        shown.add_column(heading, justify="right" if heading in ("value", "n") else "left")
    for line in every.lines:
        shown.add_row(*line)
    console.print(shown, highlight=False)
    paths = []
    if options.json is not None:
        write_rows(options.json, summary.rows)
        paths.append(options.json)
    if summary.picture is not None:
        paths.append(options.out / f"{name}.png")
        summary.picture().savefig(paths[-1])
    if isinstance(options, TableOptions) and options.keep:
        paths.append(FOLDER / f"{name}.tables.json")
        tables = [asdict(table) for table in summary.tables or [every]]
        write_json(paths[-1], {"revision": revision(), "machine": machine(), "tables": tables})
    for path in paths:
        console.print(str(path), highlight=False, soft_wrap=True)


def kept_tables(name: str) -> tuple[str, str, list[Table]] | None:
    """Revision, machine and tables that `--keep` wrote; None where there are none."""
    path = FOLDER / f"{name}.tables.json"
    if not path.is_file():
        return None
    kept = json.loads(path.read_text(encoding="utf-8"))
    return kept["revision"], kept["machine"], [Table(**table) for table in kept["tables"]]
