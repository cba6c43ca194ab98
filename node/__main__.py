"""The command `farside`: options in, one clear line out where something is wrong with them.

A command's code is imported when it runs, so that help and mistyped options answer at once.
"""

import inspect
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import tyro
from rich.console import Console
from tyro.conf import Positional, arg

DESCRIPTION = """Farside: from one partial RGB-D view of an object, several whole, weighted shapes, and the probability
that any space the camera cannot see is occupied. Lengths are in metres. With --debug an error shows its traceback."""


@dataclass(frozen=True)
class Replay:
    """Infer whole-shape hypotheses for the objects in one recorded view; write a file and a picture for each."""

    source: Annotated[
        Positional[Path | None],
        arg(metavar="[SOURCE]", help_behavior_hint="(default: the recording that ships with the project)"),
    ] = None
    """Frame folder (color.png, depth.png, meta.json) or recording (.mcap, .db3, .bag, ROS 2 bag folder)."""
    object: Annotated[int | None, arg(metavar="ID", help_behavior_hint="(default: all)")] = None
    """The one object to infer: its id in the label map or, without one, 1, 2, ... from the largest."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: out/<name of the source>)")] = None
    """Folder for object_<id>.npz and object_<id>.png."""
    budget: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: 50; with --stages: no limit)")
    ] = None
    """Time for the whole job, shared by its objects."""
    stages: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: until it has converged)")] = None
    """Stop the sampler after N stages. Without a budget, the same input, seed and N give the same file."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""
    method: Annotated[
        Literal["tempered_smc", "annealed_hmc"] | None,
        arg(metavar="{tempered_smc,annealed_hmc}", help_behavior_hint="(default: tempered_smc)"),
    ] = None
    """Sampler: weighted tempered populations, or the annealed chains of the ProbNeRF paper."""
    frame: Annotated[int, arg(metavar="K")] = 0
    """Which frame of a recording, from 0; -1 is the last."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped tabletop prior)")] = (
        None
    )
    """Weights of another prior (.safetensors, as `farside train` writes them)."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """YAML file with these options and all others by name, such as launch/replay.yaml; options given here win."""


@dataclass(frozen=True)
class Query:
    """Ask how likely a box or some points are free, jointly over all hypotheses (and objects, if FILE is a folder)."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Hypotheses file (object_<id>.npz), or the folder that `farside replay` wrote."""
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="(this or --points)"),
    ] = None
    """Two opposite corners of an axis-aligned box, metres."""
    points: Annotated[Path | None, arg(metavar="FILE.xyz", help_behavior_hint="(this or --box)")] = None
    """Text file of points, one a line: x y z in metres."""
    frame: Literal["object", "camera", "world"] = "object"
    """Frame of the question. object: z up, x to the camera, the plane under the origin; camera: x right, y down."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class View:
    """Describe a hypotheses file, or a folder of them, and draw its picture anew."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Hypotheses file (object_<id>.npz), or the folder that `farside replay` wrote."""
    out: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: <FILE>_view.png)")] = None
    """Where the picture goes."""


BENCH = "Run a measurement: print its table, draw its picture, and write its figures as JSON."
TRAIN = "Train a prior on procedural tabletop objects; resumes by itself after it was stopped."
SUMMARIES = {
    "replay": str(Replay.__doc__),
    "query": str(Query.__doc__),
    "view": str(View.__doc__),
    "train": TRAIN,
    "bench": BENCH,
}


def _replay(args: Sequence[str]) -> int:
    options = tyro.cli(Replay, args=args, prog="farside replay")
    from node.config import load_config
    from node.pipeline import ReplayConfig, replay

    config = ReplayConfig()
    if options.config is not None:  # the file's values become the defaults, and the options are read again
        config = load_config(options.config, ReplayConfig)
        given = {f.name: getattr(config, f.name) for f in fields(Replay) if f.name != "config"}
        options = tyro.cli(Replay, args=args, prog="farside replay", default=Replay(**given))
    values = {f.name: getattr(options, f.name) for f in fields(Replay) if f.name != "config"}
    return 0 if replay(replace(config, **values), Console(), Console(stderr=True)) else 130


def _query(args: Sequence[str]) -> int:
    options = tyro.cli(Query, args=args, prog="farside query")
    if (options.box is None) == (options.points is None):
        raise ValueError("a query needs either --box X0 Y0 Z0 X1 Y1 Z1 or --points FILE.xyz")
    from node.answer import answer
    from perception.query import Box, read_points

    box, points = options.box, options.points
    region = Box(box[:3], box[3:]) if box is not None else read_points(points)  # type: ignore[arg-type]
    answer(options.file, region, options.frame, options.json, Console())
    return 0


def _view(args: Sequence[str]) -> int:
    options = tyro.cli(View, args=args, prog="farside view")
    from node.pipeline import view

    view(options.file, options.out, Console())
    return 0


def _train(args: Sequence[str]) -> int:
    from node.training import Training, train

    options = tyro.cli(
        Training, args=args, prog="farside train", description=TRAIN, config=(tyro.conf.OmitArgPrefixes,)
    )
    return 0 if train(options, Console(), Console(stderr=True)) else 130


def _bench(args: Sequence[str]) -> int:
    from node.bench import load_benchmark, names, run

    found = names()
    if not args or args[0] not in found:
        tyro.extras.subcommand_cli_from_dict(
            {name: _documented(name, text) for name, text in found.items()},
            prog="farside bench",
            description=BENCH,
            args=args,
            sort_subcommands=False,
        )
        return 0
    main = load_benchmark(args[0])
    options = tyro.cli(_with_json(main), args=args[1:], prog=f"farside bench {args[0]}")
    run(args[0], main, options, Console(), Console(stderr=True))
    return 0


def _with_json(main: Callable) -> Callable[..., dict]:
    """A function of a measurement's options and of `json` that gives them back as a dict."""

    def collect(**options: object) -> dict:
        return options

    hints = get_type_hints(main)
    hints["out"] = Annotated[Path, arg(metavar="DIR", help="Folder for the picture.")]
    hints["quick"] = Annotated[bool, tyro.conf.FlagCreatePairsOff, arg(help="Only a few objects, in a minute.")]
    parameters = []
    for p in inspect.signature(main).parameters.values():
        default = Path("out/bench") if p.name == "out" else p.default
        parameters.append(p.replace(kind=p.KEYWORD_ONLY, default=default, annotation=hints[p.name]))
    json = Annotated[
        Path | None, arg(metavar="FILE", help="Write the rows as JSON.", help_behavior_hint="(default: no)")
    ]
    parameters.append(inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=json))
    collect.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    collect.__annotations__ = {p.name: p.annotation for p in parameters}
    collect.__doc__ = main.__doc__
    return collect


def _documented(name: str, text: str) -> Callable[[], None]:
    def command() -> None: ...

    command.__name__, command.__doc__ = name, text
    return command


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "replay": _replay,
    "query": _query,
    "view": _view,
    "train": _train,
    "bench": _bench,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 1 for an error of the input, 130 after Ctrl-C.

    Mistyped options end the process with code 2, help with 0 (`SystemExit`).
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = [a for a in given if a != "--debug"]
    # Compiled programs outlive the process. JAX reads these when it is first imported.
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "farside"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # One device per core, to share particles out; a power of two divides their number.
    os.environ.setdefault("JAX_NUM_CPU_DEVICES", str(1 << min((os.cpu_count() or 1).bit_length() - 1, 4)))
    if not args or args[0] not in COMMANDS:
        stubs = {name: _documented(name, text) for name, text in SUMMARIES.items()}
        tyro.extras.subcommand_cli_from_dict(
            stubs, prog="farside", description=DESCRIPTION, args=args or ["--help"], sort_subcommands=False
        )
        return 0
    try:
        return COMMANDS[args[0]](args[1:])
    except (ValueError, OSError, FloatingPointError) as error:
        if "--debug" in given:
            raise
        print(f"farside: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        if "--debug" in given:
            raise
        print("farside: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
