"""The command `farside bench`: run a study, print its table, draw its picture, and write its rows as JSON.

A study NAME is the module `benchmarks/studies/NAME.py`. The first line of its docstring is its help. It has

    def main(out: Path, quick: bool = False, ...) -> list[Row]

Every further keyword of `main` has a type and a default and becomes an option of that name. `quick` asks for the same
study on a few objects, in a minute. Studies run from a checkout of the repository; they are not installed.
"""

import ast
import importlib
import inspect
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro
from rich.console import Console
from rich.table import Table
from tyro.conf import arg

from benchmarks.harness.rows import Row, write_rows

DESCRIPTION = "Run a study: print its table, draw its picture, and write its rows as JSON."
STUDIES = Path(__file__).resolve().parent / "studies"


def studies() -> dict[str, str]:
    """The studies by name, with the first line of each one's docstring; no study is imported."""
    found = {}
    for path in sorted(STUDIES.glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or path.stem).splitlines()[0]
    return found


def main(args: Sequence[str]) -> int:
    """Run one study with its options and return 0. Raises what the study raises."""
    found = studies()
    if not args or args[0] not in found:
        tyro.extras.subcommand_cli_from_dict(
            {name: _documented(name, text) for name, text in found.items()},
            prog="farside bench",
            description=DESCRIPTION,
            args=args or ["--help"],
            sort_subcommands=False,
        )
        return 0
    name = args[0]
    study = importlib.import_module(f"benchmarks.studies.{name}").main
    options = tyro.cli(_with_json(study), args=args[1:], prog=f"farside bench {name}")
    json = options.pop("json")
    if json is not None and json.is_dir():
        raise ValueError(f"{json} is a folder; give a file for --json")
    options["out"].mkdir(parents=True, exist_ok=True)
    _show(name, study(**options), options["out"], json)
    return 0


def _show(name: str, rows: Sequence[Row], out: Path, json: Path | None) -> None:
    console = Console()
    table = Table(title=name)
    for heading in ("method", "condition", "metric", "value", "unit", "n"):
        table.add_column(heading, justify="right" if heading in ("value", "n") else "left")
    for row in rows:
        table.add_row(row.method, row.condition, row.metric, f"{row.value:.4g}", row.unit, str(row.n))
    console.print(table, highlight=False)
    if json is not None:
        write_rows(json, rows)
        console.print(str(json), highlight=False, soft_wrap=True)
    picture = out / f"{name}.png"
    if picture.is_file():
        console.print(str(picture), highlight=False, soft_wrap=True)


def _with_json(study: Callable) -> Callable[..., dict[str, Any]]:
    """A function of a study's options and of `json` that returns them as a dict."""

    def collect(**options: object) -> dict[str, Any]:
        return options

    hints = get_type_hints(study)
    hints["out"] = Annotated[Path, arg(metavar="DIR", help="Folder for the picture.")]
    hints["quick"] = Annotated[bool, tyro.conf.FlagCreatePairsOff, arg(help="Only a few objects, in a minute.")]
    parameters = []
    for p in inspect.signature(study).parameters.values():
        default = Path("out/bench") if p.name == "out" else p.default
        parameters.append(p.replace(kind=p.KEYWORD_ONLY, default=default, annotation=hints[p.name]))
    json = Annotated[
        Path | None, arg(metavar="FILE", help="Write the rows as JSON.", help_behavior_hint="(default: no)")
    ]
    parameters.append(inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=json))
    collect.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    collect.__annotations__ = {p.name: p.annotation for p in parameters}
    collect.__doc__ = study.__doc__
    return collect


def _documented(name: str, text: str) -> Callable[[], None]:
    def command() -> None: ...

    command.__name__, command.__doc__ = name, text
    return command


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
