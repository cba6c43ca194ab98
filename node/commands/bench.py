"""Measurements: found in the checkout's `benchmarks/`, which is not installed, and run (see `benchmarks/rows.py`)."""

import ast
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


def names() -> dict[str, str]:
    """The measurements by name and the first line of what each says of itself.

    Raises FileNotFoundError where there is no checkout.
    """
    if not (FOLDER / "rows.py").is_file():
        raise FileNotFoundError(f"{FOLDER} does not exist: measurements run from a checkout of the repository")
    found = {}
    for path in sorted(FOLDER.glob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body):
            found[path.stem] = (ast.get_docstring(tree) or path.stem).splitlines()[0]
    return found


def load_benchmark(name: str) -> Callable[..., Sequence[Any]]:
    """The `main` of a measurement."""
    if str(FOLDER.parent) not in sys.path:
        sys.path.insert(0, str(FOLDER.parent))
    return importlib.import_module(f"{FOLDER.name}.{name}").main


def run(name: str, main: Callable[..., Sequence[Any]], options: dict[str, Any], out: Console, err: Console) -> None:
    """Run a measurement, print its rows as a table, write them where `json` says, and name the picture."""
    from benchmarks.rows import write_rows

    json = options.pop("json")
    if json is not None and json.is_dir():
        raise ValueError(f"{json} is a folder; give a file for --json")
    options["out"].mkdir(parents=True, exist_ok=True)
    rows = main(**options)
    table = Table(title=name)
    for heading in ("method", "condition", "metric", "value", "unit", "n"):
        table.add_column(heading, justify="right" if heading in ("value", "n") else "left")
    for row in rows:
        table.add_row(row.method, row.condition, row.metric, f"{row.value:.4g}", row.unit, str(row.n))
    out.print(table, highlight=False)
    if json is not None:
        write_rows(json, rows)
        out.print(str(json), highlight=False, soft_wrap=True)
    picture = options["out"] / f"{name}.png"
    if picture.is_file():
        out.print(str(picture), highlight=False, soft_wrap=True)
