"""The command `farside`: parses options, runs a command, and prints an error as one line.

A command's code is imported when it runs, so that help and mistyped options answer at once.
"""

import os
import signal
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn, TypeVar

import tyro
from rich.console import Console

from node.commands.batch_options import BatchConfig
from node.commands.calibration_options import Calibrate, HandEyeOptions
from node.commands.options import (
    Capture,
    LiveConfig,
    Query,
    Record,
    ReplayConfig,
    Segmenting,
    View,
    options_of,
)
from node.commands.training_options import NetworkTraining, Training
from probnerf.environment import prepare

Config = TypeVar("Config", ReplayConfig, Segmenting, LiveConfig, BatchConfig)

_LONGEST = 800  # characters of an error
DESCRIPTION = """Farside: from one partial RGB-D view of an object, several whole, weighted shapes, and the probability
that any space the camera cannot see is occupied. Lengths are in metres. --version prints the version; with --debug an
error shows its traceback."""

BENCH = "Run a study: print its table, draw its picture, and write its rows as JSON. Needs a checkout."
SUMMARIES = {
    "replay": str(ReplayConfig.__doc__),
    "segment": str(Segmenting.__doc__),
    "live": str(LiveConfig.__doc__),
    "batch": str(BatchConfig.__doc__).split("\n")[0],
    "record": str(Record.__doc__),
    "query": str(Query.__doc__),
    "view": str(View.__doc__),
    "calibrate": str(Calibrate.__doc__).split("\n")[0],
    "hand-eye": str(HandEyeOptions.__doc__).split("\n")[0],
    "capture": str(Capture.__doc__),
    "train": str(Training.__doc__),
    "train-network": str(NetworkTraining.__doc__),
    "bench": BENCH,
}


def _console(stderr: bool = False) -> Console:
    """One that prints names of files and topics as they are: `[/x]` and `:x:` are no markup there."""
    return Console(stderr=stderr, markup=False, emoji=False)


def _configured(kind: type[Config], prog: str, args: Sequence[str]) -> Config:
    """A command's configuration: its options over the values of the file that --config names, over the defaults."""
    finder = ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path, nargs="?")
    path = finder.parse_known_args(args)[0].config
    config = kind()
    if path is not None:
        from node.commands.config_file import load_config

        config = load_config(path, kind)
    hidden = not {"--help", "-h"}.isdisjoint(args)
    options = options_of(kind, hidden)
    args = ["--help" if a == "--help-all" else a for a in args]
    given = tyro.cli(options, args=args, prog=prog, default=options(**vars(config)))
    return kind(**{f.name: getattr(given, f.name) for f in fields(kind)})


def _replay(args: Sequence[str]) -> int:
    config = _configured(ReplayConfig, "farside replay", args)
    from node.commands.replay import replay

    run = replay
    if config.schedule:
        from node.commands.replay_schedule import follow as run
    return 0 if run(config, _console(), _console(stderr=True)) else 130


def _segment(args: Sequence[str]) -> int:
    config = _configured(Segmenting, "farside segment", args)
    from node.commands.segment import segment_frame

    segment_frame(config, _console(), _console(stderr=True))
    return 0


def _live(args: Sequence[str]) -> int:
    config = _configured(LiveConfig, "farside live", args)
    from node.commands.live import live

    live(config, _console(), _console(stderr=True))
    return 0


def _batch(args: Sequence[str]) -> int:
    config = _configured(BatchConfig, "farside batch", args)
    from node.commands.batch import batch

    return batch(config, _console(), _console(stderr=True))


def _record(args: Sequence[str]) -> int:
    options = tyro.cli(Record, args=args, prog="farside record")
    from node.commands.record import record

    record(options, _console(), _console(stderr=True))
    return 0


def _query(args: Sequence[str]) -> int:
    options = tyro.cli(Query, args=args, prog="farside query")
    box, points, mesh = options.box, options.points, options.mesh
    if sum(option is not None for option in (box, points, mesh)) != 1:
        raise ValueError("a query needs one of --box X0 Y0 Z0 X1 Y1 Z1, --points FILE.xyz and --mesh FILE.obj")
    from node.figures.query_answer import answer
    from perception.answers.hypotheses_file import load_scene
    from perception.answers.regions import Box, Region, read_mesh, read_points

    scene = load_scene(options.file)
    region: Region
    if box is not None:
        region = Box(box[:3], box[3:])
    elif points is not None:
        region = read_points(points)
    else:
        assert mesh is not None
        region = read_mesh(mesh, 0.5 * min(h.voxel_m for h in scene))
    answer(scene, region, options.frame, options.risk, options.json, _console())
    return 0


def _view(args: Sequence[str]) -> int:
    options = tyro.cli(View, args=args, prog="farside view")
    if (options.file is None) == (options.live is None):
        raise ValueError("give either FILE, hypotheses to look at, or --live ENDPOINT of a node that runs")
    if options.live is not None:
        if options.out is not None:
            raise ValueError("--out draws a file's picture; omit it with --live")
        from node.commands.view_live import watch

        watch(options.live, options.node, options.port, options.token, _console(), _console(stderr=True))
        return 0
    from node.commands.view import draw, open_page

    assert options.file is not None
    if options.out is None:
        open_page(options.file, options.port, options.token, _console(), _console(stderr=True))
    else:
        draw(options.file, options.out, _console(), _console(stderr=True))
    return 0


def _calibrate(args: Sequence[str]) -> int:
    options = tyro.cli(Calibrate, args=args, prog="farside calibrate")
    if sum(option is not None for option in (options.source, options.from_, options.print_target)) != 1:
        raise ValueError("give one of SOURCE (pictures of a board), --from SOURCE and --print-target FILE.pdf")
    from node.commands.calibrate import calibrate_camera, copy_camera, print_target

    if options.print_target is not None:
        print_target(options.print_target, options.board, options.paper, _console())
    elif options.from_ is not None:
        copy_camera(options, options.from_, _console())
    else:
        calibrate_camera(options, _console(), _console(stderr=True))
    return 0


def _hand_eye(args: Sequence[str]) -> int:
    options = tyro.cli(HandEyeOptions, args=args, prog="farside hand-eye")
    from node.commands.hand_eye import locate_camera

    locate_camera(options, _console(), _console(stderr=True))
    return 0


def _capture(args: Sequence[str]) -> int:
    options = tyro.cli(Capture, args=args, prog="farside capture")
    from node.commands.capture import capture

    return 0 if capture(options, _console(), _console(stderr=True)) else 130


def _train(args: Sequence[str]) -> int:
    options = tyro.cli(Training, args=args, prog="farside train")
    from node.commands.train import train

    return 0 if train(options, _console(), _console(stderr=True)) else 130


def _train_network(args: Sequence[str]) -> int:
    options = tyro.cli(NetworkTraining, args=args, prog="farside train-network")
    from node.commands.train_network import train_network

    return 0 if train_network(options, _console(), _console(stderr=True)) else 130


def _bench(args: Sequence[str]) -> int:
    from node.commands.bench import bench

    return bench(args)


def _documented(name: str, text: str) -> Callable[[], None]:
    def command() -> None: ...

    command.__name__, command.__doc__ = name, text
    return command


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {
    "replay": _replay,
    "segment": _segment,
    "live": _live,
    "batch": _batch,
    "record": _record,
    "query": _query,
    "view": _view,
    "calibrate": _calibrate,
    "hand-eye": _hand_eye,
    "capture": _capture,
    "train": _train,
    "train-network": _train_network,
    "bench": _bench,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, 1 for an error of the input, 130 after Ctrl-C, 3 where parts of a
    batch failed.

    Mistyped options end the process with code 2, help with 0 (`SystemExit`). Without `argv` it is the program, and ends
    the process with the code.
    """
    if argv is None:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # a service's stop is a Ctrl-C
        _end(main(sys.argv[1:]))
    arguments = list(argv)
    args = [a for a in arguments if a != "--debug"]
    prepare()
    if args == ["--version"]:
        print(f"farside {version('farside')}")
        return 0
    if not args or args[0] not in COMMANDS:
        stubs = {name: _documented(name, text) for name, text in SUMMARIES.items()}
        tyro.extras.subcommand_cli_from_dict(
            stubs, prog="farside", description=DESCRIPTION, args=args or ["--help"], sort_subcommands=False
        )
        return 0
    try:
        return COMMANDS[args[0]](args[1:])
    except (ValueError, OSError, FloatingPointError) as error:
        if "--debug" in arguments:
            raise
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None and message.startswith("[Errno"):
            message = f"{error.filename}: {error.strerror}; check this path, and that it may be read or written"
        print(f"farside: error: {_short(' '.join(message.split()))}", file=sys.stderr)
        return 1
    except Exception as error:  # a fault of this program, or input that no reader expected
        if "--debug" in arguments:
            raise
        what = "not enough memory" if isinstance(error, MemoryError) else f"{type(error).__name__}: {error}"
        asked = _short(" ".join([args[0], *(a for a in args[1:] if os.path.exists(a))]))
        what = _short(" ".join(what.split()))
        print(f"farside: error: {asked}: {what}; check these files, or see more with --debug", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        if "--debug" in arguments:
            raise
        print("farside: interrupted", file=sys.stderr)
        _UNFINISHED.append(error)
        return 130


def _short(line: str) -> str:
    """Its start and end, as a file may hold a name of any length."""
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


# A Ctrl-C while jaxlib compiles leaves objects in its frames whose destruction may crash the process. Keep them.
_UNFINISHED: list[KeyboardInterrupt] = []


def _end(code: int) -> NoReturn:
    """End the process at once. After a Ctrl-C during compilation, jaxlib crashes in the interpreter's shutdown."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the reader is gone
            stream.flush()
    os._exit(code)


if __name__ == "__main__":
    main()
