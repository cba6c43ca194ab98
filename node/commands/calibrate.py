"""The command `farside calibrate`: pictures in, a camera file, a short table and a picture out."""

from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from calibration.boards import DEFAULT_BOARD, Board, parse_board
from calibration.calibrate import CalibrateConfig, Calibration, calibrate, distinct, motion
from calibration.camera import Camera
from calibration.camera_file import is_camera_file, read_camera, write_camera
from calibration.coverage import Coverage, coverage, next_views
from calibration.fit import BoardView
from calibration.print_board import Paper, write_target
from calibration.projection import Projection, projection
from foundation.whole_file import check_folder
from node.commands.calibration_options import Calibrate
from node.figures.calibration_figure import draw_calibration
from perception.sources.open_source import open_source
from perception.sources.pictures import Picture, open_pictures

_MOST_NAMED = 8  # views left out that are listed one by one
_ADVISE_AFTER = 5  # kept views of a stream between two hints for the next view


@dataclass
class Found:
    """What a search for the board has found so far."""

    size: tuple[int, int] | None = None  # width and height of the pictures, px
    views: list[BoardView] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)  # pictures without the board
    alike: int = 0  # views of a stream that were passed over, as they add nothing


def calibrate_camera(options: Calibrate, out: Console, err: Console) -> None:
    """Calibrate from `options.source`; write the camera file and its picture. Raises ValueError, one line, before that.

    Nothing is written where the focal length is not determined.
    """
    assert options.source is not None
    board = parse_board(options.board or DEFAULT_BOARD)
    check_output(options.out)
    if options.every < 1:
        raise ValueError(f"--every is {options.every}; give 1 or more")
    notes: list[str] = []
    pictures, total = open_pictures(options.source, notes)
    config = CalibrateConfig()
    found = find_views(pictures, board, err, total, options, config)
    for note in notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    assert found.size is not None
    size, unseen = found.size, found.unseen
    views, same = distinct(found.views, size, config)
    alike = found.alike + len(same)
    result = calibrate(views, size, options.model, config)
    seen = coverage(result.views, size)
    if result.trouble is not None:
        report(result, seen, None, alike, unseen, out)
        raise ValueError(f"{options.source}: nothing is saved: {result.trouble}")
    picture = options.out.with_name(f"{options.out.stem}_views.png")
    misses = projection(result)
    draw_calibration(picture, result, seen, misses)
    write_camera(options.out, result.camera, options.name, misses)
    report(result, seen, misses, alike, unseen, out)
    for written in (options.out, picture):
        out.print(f"  {written}", highlight=False, soft_wrap=True)


def check_output(path: Path) -> None:
    """Refuse a camera file's name before the work is done. Raises ValueError."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise ValueError(f"--out is {path}; give a name that ends in .yaml")
    if path.is_dir():
        raise ValueError(f"--out is {path}, a folder; give a file")
    check_folder(path.parent)


def find_views(
    pictures: Iterable[Picture],
    board: Board,
    err: Console,
    total: int | None,
    options: Calibrate,
    config: CalibrateConfig,
) -> Found:
    """Views of the board. From a stream (`total` is None) only views that differ; they are printed, with hints.

    Ctrl-C or a lost camera ends the search; the views found until then are returned. Raises ValueError if pictures
    differ in size, or if none shows the board.
    """
    source, found, first = options.source, Found(), ""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task("looking for the board", total=total)
        try:
            for number, picture in enumerate(pictures):
                height, width = picture.rgb.shape[:2]
                if found.size is None:
                    found.size, first = (width, height), picture.name
                if found.size != (width, height):
                    size = "x".join(map(str, found.size))
                    raise ValueError(
                        f"{source}: {picture.name} is {width}x{height} px but {first} is {size} px;"
                        " calibrate each size of picture by itself"
                    )
                if number % options.every == 0:
                    _look(picture, board, found, err, options, config if total is None else None)
                text = f"{number + 1} pictures, the board is in {len(found.views)}"
                if total is None:
                    text = f"{number + 1} pictures, {len(found.views)} views kept; Ctrl-C ends"
                progress.update(task, description=text, completed=number + 1)
        except KeyboardInterrupt:
            err.print(f"stopped; going on with the {len(found.views)} views so far", highlight=False)
        except OSError as error:
            if not found.views:
                raise
            err.print(f"{error}; going on with the {len(found.views)} views so far", highlight=False, soft_wrap=True)
        finally:
            if isinstance(pictures, Generator):
                pictures.close()  # lets a camera go
    if found.size is None:
        raise ValueError(f"{source} gave no picture; record it again")
    if not found.views:
        raise ValueError(
            f"{source}: the board {board} is in none of {len(found.unseen)} pictures; check --board (a chessboard is"
            " named by its inner corners, and must be seen whole), focus and light"
        )
    return found


def _look(
    picture: Picture, board: Board, found: Found, err: Console, options: Calibrate, stream: CalibrateConfig | None
) -> None:
    """Look for the board in one picture. Of a stream, keep and print only a view that differs from the others."""
    corners = board.find(picture.rgb)
    if corners is None:
        found.unseen.append(picture.name)
        return
    view = BoardView(picture.name, *corners)
    if stream is not None:
        assert found.size is not None
        least = stream.stream_motion * float(np.hypot(*found.size))
        if any(motion(view, other) < least for other in found.views):
            found.alike += 1
            return
        err.print(f"view {len(found.views) + 1}: {view.name}, {len(view.points)} corners", highlight=False)
    found.views.append(view)
    if stream is not None and len(found.views) % _ADVISE_AFTER == 0:
        err.print(_advice(found, options, stream), style="yellow", highlight=False, soft_wrap=True)


def _advice(found: Found, options: Calibrate, config: CalibrateConfig) -> str:
    """What the views cover so far, and which view to take next."""
    assert found.size is not None
    try:
        result = calibrate(distinct(found.views, found.size, config)[0], found.size, options.model, config)
    except ValueError as error:
        return str(error)
    seen = coverage(result.views, found.size)
    advice = [*next_views(seen), *filter(None, [result.trouble]), "none is needed; Ctrl-C ends"]
    return f"{seen}; next view: {advice[0]}"


def report(
    result: Calibration, seen: Coverage, misses: Projection | None, alike: int, unseen: list[str], out: Console
) -> None:
    """The short table of a calibration, the views left out and why, and the view to take next."""
    camera = result.camera
    assert camera.K_std is not None and camera.distortion_std is not None and camera.rms is not None
    K, std = camera.K, camera.K_std
    counts = [f"{len(result.views)} used"]
    counts += [f"{n} {what}" for n, what in ((alike, "too alike"), (len(unseen), "without the board")) if n]
    counts += [f"{len(result.dropped)} left out"] if result.dropped else []
    errors = np.array([v.rms for v in result.views])
    rows = {
        "picture": f"{camera.width}x{camera.height} px, {camera.model}",
        "views": ", ".join(counts),
        "RMS": f"{camera.rms:.3f} px; views {errors.min():.3f} to {errors.max():.3f}",
        "fx, fy": f"{_pm(K[0, 0], std[0, 0])}, {_pm(K[1, 1], std[1, 1])} px",
        "cx, cy": f"{_pm(K[0, 2], std[0, 2])}, {_pm(K[1, 2], std[1, 2])} px",
        "distortion": ", ".join(
            _pm(value, s, 4) for value, s in zip(camera.distortion, camera.distortion_std, strict=True)
        ),
        "board": f"bent by {1000 * result.bend.depth(np.concatenate([v.view.points for v in result.views])):.1f} mm",
        "coverage": str(seen),
    }
    if misses is not None:
        rows["projection"] = f"± {misses.words(misses.std)}"
        apart = misses.difference
        rows["halves"] = "too few views" if apart is None else f"differ by {misses.words(apart)}"
    table = Table.grid(padding=(0, 2))
    for name, value in rows.items():
        table.add_row(f"  {name}", value)
    out.print("camera", style="bold", highlight=False)
    out.print(table, highlight=False)
    for name, why in result.dropped[:_MOST_NAMED]:
        out.print(f"  {name} is left out: {why}", style="yellow", highlight=False, soft_wrap=True)
    advice = next_views(seen)
    if advice:
        out.print(f"  next view: {advice[0]}", style="yellow", highlight=False, soft_wrap=True)


def _pm(value: float, std: float, digits: int = 2) -> str:
    return f"{value:.{digits}f} ± {std:.{digits}f}" if std < 1e6 else f"{value:.{digits}f} (not determined)"


def copy_camera(options: Calibrate, source: Path, out: Console) -> None:
    """Write the camera that a recording, a frame folder, a camera file or an OAK camera's calibration states.

    Raises ValueError, one line.
    """
    check_output(options.out)
    if is_camera_file(source):
        camera = read_camera(source)
    elif source.suffix.lower() == ".json":
        from perception.sources.oak import camera_of_device_json  # here, because depthai takes a second to import

        camera = camera_of_device_json(source, options.socket, *options.size)
    else:
        camera = _first_camera(source)
    write_camera(options.out, camera, options.name)
    out.print(f"  {options.out}", highlight=False, soft_wrap=True)


def _first_camera(source: Path) -> Camera:
    frame = next(iter(open_source(source)), None)
    if frame is None:
        raise ValueError(f"{source} has no frame; record it again")
    return frame.camera


def print_target(path: Path, board: str | None, paper: Paper, out: Console) -> None:
    """Write a page with the board, and print how to print it to scale."""
    named = parse_board(board or DEFAULT_BOARD)
    write_target(path, named, paper)
    out.print(f"  {path}", highlight=False, soft_wrap=True)
    text = f"print it on {paper} at 100%, glue it to a flat plate, and calibrate with --board {named}"
    out.print(f"  {text}", highlight=False, soft_wrap=True)
