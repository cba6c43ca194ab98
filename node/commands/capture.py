"""Capturing an object on a turntable: turn, wait, take a posed view, write it. Views survive a stop."""

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from calibration.boards import Board, parse_board
from calibration.turntable import Turntable
from calibration.turntable_pose import PlateNotFoundError, PlatePose, locate_plate, plate_axis, turned
from foundation.whole_file import write_whole
from node.commands.options import Capture
from perception.observation.turntable_views import (
    PlateMaskConfig,
    Square,
    bounds_by_carving,
    bounds_by_depth,
    cube_of,
    mask_by_depth,
    mask_by_picture,
    square,
)
from perception.sources.frame import Frame, Source
from perception.sources.image_files import read_picture
from perception.sources.open_source import open_source
from probnerf.training.srn_dataset import read_instance, write_intrinsics, write_view

_MOST_STALE = 2000  # frames passed over until one is newer than the turn
_SMALLEST = 0.0005  # share of a picture that an object fills at least


@dataclass
class Session:
    """Content of capture.json in an instance's folder: the settings, which a resumed run shares, and the results."""

    folder: Path
    board: str
    views: int
    side: int = 0  # px
    focal: float = 0.0  # px
    low: list[float] = field(default_factory=list)  # m, plate frame: the object's bounds measured by depth
    high: list[float] = field(default_factory=list)

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / "capture.json"

    def save(self) -> None:
        """Write the file atomically."""
        content = {key: value for key, value in vars(self).items() if key != "folder"}
        write_whole(self.path, json.dumps(content, indent=1) + "\n")

    def missing(self) -> list[int]:
        """Views that are not captured yet, in order."""
        return [i for i in range(self.views) if not all(path.is_file() for path in self.files(i))]

    def files(self, index: int) -> tuple[Path, Path]:
        """Picture and pose of a view."""
        return self.folder / "rgb" / f"{index:06d}.png", self.folder / "pose" / f"{index:06d}.txt"

    def grow(self, bounds: Float[np.ndarray, "2 3"]) -> None:
        """Take one view's bounds in."""
        self.low = np.minimum(bounds[0], self.low or np.inf).tolist()
        self.high = np.maximum(bounds[1], self.high or -np.inf).tolist()


def open_session(options: Capture) -> Session:
    """A fresh folder, or the one of a capture that was stopped. Raises ValueError if it holds something else."""
    if options.views < 1:
        raise ValueError(f"--views is {options.views}; give 1 or more")
    if not re.fullmatch(r"[\w-][\w.-]*", options.instance):
        raise ValueError(f"--instance {options.instance!r} is no folder name; use letters, digits, - and _")
    session = Session(options.out / options.instance, options.board, options.views)
    if not session.path.exists():
        if session.folder.exists() and any(session.folder.iterdir()):
            raise ValueError(f"{session.folder} holds files that are no capture's; give another --instance or --out")
        return session
    try:
        content = json.loads(session.path.read_text(encoding="utf-8"))
        found = Session(session.folder, **content)
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError) as error:
        raise ValueError(f"{session.path} is damaged ({error}); delete {session.folder} and capture again") from None
    for name in ("board", "views"):
        if getattr(found, name) != getattr(session, name):
            raise ValueError(
                f"{session.folder} was captured with --{name} {getattr(found, name)}, not {getattr(session, name)};"
                " give the same, or another --instance"
            )
    return found


class FreshFrames:
    """Frames of a source that were taken after the call of `take`. Older frames from a queue are skipped.

    Stamps are compared with the time elapsed here since the first frame, so the two clocks need not agree.
    """

    def __init__(self, source: Source, clock: Callable[[], int] = time.monotonic_ns):
        self._frames: Iterator[Frame] = iter(source)
        self._clock = clock
        self._first = self._next()
        self._begun = clock()

    def take(self) -> Frame:
        """The next frame no older than this call."""
        wanted = self._first.stamp_ns + self._clock() - self._begun
        for _ in range(_MOST_STALE):
            frame = self._next()
            if frame.stamp_ns >= wanted:
                return frame
        raise ValueError(
            f"the source's frames do not get newer: {_MOST_STALE} were older than the turn; check its clock"
        )

    def _next(self) -> Frame:
        frame = next(self._frames, None)
        if frame is None:
            raise OSError("the source has no more frames; give one that does not end, such as a live camera")
        return frame


def capture(options: Capture, out: Console, err: Console) -> bool:
    """Capture the views of `options.views` that are missing. Returns False after Ctrl-C; the views taken are complete.

    Raises ValueError or OSError with one line. Views taken until then are kept; the same command continues.
    """
    board, session = parse_board(options.board), open_session(options)
    if board.kind != "charuco":
        raise ValueError(f"board {board} looks the same two ways round; give a charuco board")
    if options.source is None:
        raise ValueError("no --source was given; name the camera that sees the plate")
    table = Turntable(options.port, options.table)
    if options.background is not None and not options.background.is_file():
        raise FileNotFoundError(f"--background {options.background} does not exist; give a PNG of the empty plate")
    background = None if options.background is None else read_picture(options.background)
    todo, skipped, finished = session.missing(), [], False
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    try:
        if todo:
            with table, Progress(*columns, console=err, disable=not err.is_terminal) as progress:
                frames = FreshFrames(open_source(options.source))
                if options.unlock:
                    table.unlock()
                if options.home:
                    table.home()
                else:
                    table.zero()
                bar = progress.add_task("views", total=options.views, completed=options.views - len(todo))
                for index in todo:
                    angle = 360.0 * index / options.views
                    table.move_to(angle)
                    trouble = _take(session, index, frames, board, background, options)
                    if trouble is not None:
                        skipped.append(index)
                        err.print(f"view {index} at {angle:.1f} degrees is skipped: {trouble}", highlight=False)
                    progress.update(bar, advance=trouble is None)
        finished = True
    except KeyboardInterrupt:
        out.print("stopped; the same command continues with the missing views", highlight=False)
    finally:
        taken = session.views - len(session.missing())
        if taken:
            try:
                _finish(session, board, table.garbage, skipped, out)
            except ValueError as error:  # must not hide what stopped the capture
                if finished:
                    raise
                err.print(str(error), highlight=False)
    if not taken and finished:
        raise ValueError(f"the board was seen in none of {session.views} views; check --board and the camera")
    return finished


def _take(
    session: Session,
    index: int,
    frames: FreshFrames,
    board: Board,
    background: np.ndarray | None,
    options: Capture,
) -> str | None:
    """Write one view. Returns None, or why it could not be taken."""
    trouble = ""
    for _ in range(1 + max(options.retakes, 0)):
        time.sleep(options.settle)
        frame = frames.take()
        try:
            pose = locate_plate(board, frame.camera, frame.rgb)
        except PlateNotFoundError as error:
            trouble = str(error)
            continue
        view = square(frame)
        mask = _mask(view, pose, frame, board, background)
        if mask.mean() < _SMALLEST:
            trouble = "no object was found on the plate"
            continue
        if session.side and (session.side, session.focal) != (view.side, view.focal):
            raise ValueError(f"{session.folder} was captured with another camera; give another --instance")
        session.side, session.focal = view.side, view.focal
        session.folder.mkdir(parents=True, exist_ok=True)
        if view.depth is not None:
            session.grow(bounds_by_depth(view, pose.T_plate_camera, mask))
        session.save()
        _write_intrinsics(session, board, np.array([session.low, session.high]) if session.low else None)
        write_view(session.folder, index, view.rgb, mask, pose.T_plate_camera)
        return None
    return trouble


def _mask(
    view: Square, pose: PlatePose, frame: Frame, board: Board, background: np.ndarray | None
) -> Bool[np.ndarray, "s s"]:
    if view.depth is not None:
        return mask_by_depth(view, pose.T_plate_camera, board, PlateMaskConfig())
    if background is None:
        return mask_by_picture(view, pose.T_plate_camera, board, None, PlateMaskConfig())
    empty = Frame(background, None, frame.camera, frame_id=frame.frame_id)
    try:
        where = locate_plate(board, empty.camera, empty.rgb).T_plate_camera
    except PlateNotFoundError as error:
        raise ValueError(f"--background: {error}") from None
    return mask_by_picture(view, pose.T_plate_camera, board, (square(empty), where), PlateMaskConfig())


def _write_intrinsics(session: Session, board: Board, bounds: np.ndarray | None) -> None:
    """With the cube that fits the object, or while that is unknown one as wide as the board."""
    centre, side = cube_of(np.array([[0, 0, 0], [0, 0, max(board.size)]]) if bounds is None else bounds)
    middle = 0.5 * session.side
    write_intrinsics(session.folder, session.focal, (middle, middle), centre, side, (session.side, session.side))


def _finish(session: Session, board: Board, garbage: int, skipped: list[int], out: Console) -> None:
    """Fit the cube to all views, and print a summary."""
    picture, pose = session.files(0)
    for path in [*picture.parent.glob("*.png"), *pose.parent.glob("*.txt")]:  # halves of a view that was cut off
        if not all(p.is_file() for p in (picture.with_stem(path.stem), pose.with_stem(path.stem))):
            path.unlink()
    instance = read_instance(session.folder)
    T = instance.T_world_camera
    bounds = np.array([session.low, session.high])
    if not session.low:
        bounds = bounds_by_carving(instance.mask, T, session.focal, board)
    _write_intrinsics(session, board, bounds)
    rows = Table("what", "value", title=str(session.folder))
    rows.add_row("views", f"{len(T)} of {session.views}" + (f", skipped {skipped}" if skipped else ""))
    sides = 1000 * np.append(bounds[1, :2] - bounds[0, :2], bounds[1, 2])
    hull = "" if session.low else " (visual hull: no depth)"
    rows.add_row("object", " x ".join(f"{side:.0f}" for side in sides) + f" mm{hull}")
    try:
        (x, y), rms = plate_axis(T)
        rows.add_row(
            "plate's axis", f"{1000 * x:.1f}, {1000 * y:.1f} mm from the board's centre; rms {1000 * rms:.1f} mm"
        )
    except ValueError as error:
        rows.add_row("plate's axis", str(error))
    rows.add_row("steps", _steps(session, T))
    if garbage:
        rows.add_row("serial garbage", f"{garbage} bytes")
    out.print(rows)


def _steps(session: Session, T: Float[np.ndarray, "v 4 4"]) -> str:
    """How far the plate turned from view to view by the board, compared with the commanded turns."""
    have = [i for i in range(session.views) if i not in session.missing()]
    turns = np.array([360.0 * (b - a) / session.views for a, b in pairwise(have)])
    seen = np.array([turned(a, b) for a, b in pairwise(T)])
    if not len(turns):
        return "one view"
    forward, backward = (np.abs((seen - sign * turns + 180.0) % 360.0 - 180.0) for sign in (1, -1))
    off = min(forward, backward, key=np.median)
    sense = "clockwise" if off is backward else "counter-clockwise"
    return f"{sense} from above, at most {off.max():.1f} degrees from the commanded turns"
