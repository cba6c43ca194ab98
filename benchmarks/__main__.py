"""The command `farside bench`: run a study of `benchmarks/studies/` (see `harness.study`).

Studies run from a checkout of the repository; they are not installed.
"""

import ast
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import tyro

DESCRIPTION = "Run a study: print its table, draw its picture, and write its rows as JSON."
FIGURES = "Write docs/figures.md from the rows that the studies keep."
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
    found = {**studies(), "figures": FIGURES}
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
    if name == "figures":
        from benchmarks import figures

        figures.main(tyro.cli(figures.Options, args=args[1:], prog="farside bench figures"))
        return 0
    study = importlib.import_module(f"benchmarks.studies.{name}")
    options = tyro.cli(study.Options, args=args[1:], prog=f"farside bench {name}")
    if options.json is not None and options.json.is_dir():
        raise ValueError(f"{options.json} is a folder; give a file for --json")
    options.out.mkdir(parents=True, exist_ok=True)
    from benchmarks.harness.study import report  # after the study's imports: help answers at once

    report(name, study.main(options), options)
    return 0


def _documented(name: str, text: str) -> Callable[[], None]:
    def command() -> None: ...

    command.__name__, command.__doc__ = name, text
    return command


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
