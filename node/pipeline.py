"""The main job: a source's frame, the objects in it, and for each one hypotheses, a short table and a picture."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from node.plot import draw_object
from node.summary import figures, warnings
from perception.controller import ControllerConfig, Estimate, estimate
from perception.hypotheses import Hypotheses
from perception.segment import Segment, SegmentConfig, segment
from perception.source import SHIPPED_LOG, Frame, open_source
from perception.store import hypotheses_path, load, load_scene, save
from probnerf.hmc import StageInfo
from probnerf.infer import Method
from probnerf.store import Prior, load_prior

BUDGET_S = 50.0
PICTURE_S = 3.0  # of each object's share of the budget, kept back for its picture


@dataclass(frozen=True)
class ReplayConfig:
    """Keys of a configuration file such as launch/replay.yaml; the command's options have the same names."""

    source: Path | None = None  # frame folder or recording; None: the one that ships with the project
    object: int | None = None  # the one object to infer; None: all
    out: Path | None = None  # None: out/<name of the source>
    budget: float | None = None  # s for the whole job; None: 50, or no limit where `stages` is given
    stages: int | None = None  # of the sampler, per object
    seed: int = 0
    method: Method | None = None  # None: that of `controller.infer`
    frame: int = 0  # of a recording; -1 is the last
    prior: Path | None = None  # None: the one that ships with the project
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)

    def __post_init__(self) -> None:
        if self.budget is not None and not self.budget > 0:
            raise ValueError(f"the budget is {self.budget:g} s; give more than 0")
        if self.stages is not None and self.stages < 1:
            raise ValueError(f"stages is {self.stages}; give 1 or more")

    @property
    def folder(self) -> Path:
        """Where the results go."""
        source = self.source or SHIPPED_LOG
        return self.out or Path("out") / (source.stem if source.is_file() else source.resolve().name)


def replay(config: ReplayConfig, out: Console, err: Console) -> bool:
    """Infer, save, picture and print the objects of one frame. False if Ctrl-C ended it; what is saved is whole.

    An object that cannot be inferred is passed over with a note, unless it is the only one that was asked for. Raises
    `ValueError` or `FileNotFoundError` in one line, before anything is written, for whatever the user can mend.
    """
    begun = time.monotonic()
    if config.folder.exists() and not config.folder.is_dir():
        raise ValueError(f"{config.folder} is a file; give a folder for the results with --out")
    prior = load_prior(config.prior)
    frame = read_frame(config.source, config.frame, err)
    segments = segment(frame, config.object, config.segment)
    limit = config.budget or (None if config.stages else BUDGET_S)
    done: list[Hypotheses] = []
    complaint = ValueError("no object")
    for i, found in enumerate(segments):
        share = None
        if limit is not None:
            share = (begun + limit - time.monotonic()) / (len(segments) - i) - PICTURE_S
        try:
            result = _infer(frame, found, prior, config, share, err)
        except ValueError as error:
            if len(segments) == 1:
                raise
            err.print(f"object {found.id} is left out: {error}", highlight=False, soft_wrap=True)
            complaint = error
            continue
        path = _publish(config.folder, frame, found, result, out)
        if not done:
            _clear_others(config.folder, path, result.hypotheses if config.object is not None else None, out)
        done.append(result.hypotheses)
        if result.hypotheses.result == "interrupted":
            return False
    if not done:
        raise complaint
    return True


def read_frame(source: Path | None, index: int, err: Console) -> Frame:
    """Frame `index` of a source (-1: the last). Its notes go to `err`. Raises ValueError where there is none."""
    opened = open_source(source)
    frame, count = None, 0
    for count, frame in enumerate(opened, start=1):  # noqa: B007
        if count == index + 1:
            break
    for note in opened.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if frame is None:
        raise ValueError(f"{source or SHIPPED_LOG} has no frame; record it again")
    if index not in (-1, count - 1):
        raise ValueError(
            f"{source or SHIPPED_LOG} has {count} frames, no number {index}; give --frame 0 to {count - 1}"
        )
    return frame


def _infer(
    frame: Frame,
    found: Segment,
    prior: Prior,
    config: ReplayConfig,
    share: float | None,
    err: Console,
) -> Estimate:
    """One object's estimate, its progress shown."""
    controller = config.controller
    if config.method is not None:
        controller = replace(controller, infer=replace(controller.infer, method=config.method))
    budget = None if share is None else max(share, 1.0)
    with _progress(f"object {found.id}", config.stages, budget, err) as on_stage:
        return estimate(
            frame, found, prior, controller, seed=config.seed, budget_s=budget, stages=config.stages, on_stage=on_stage
        )


@contextmanager
def _progress(
    name: str, stages: int | None, budget: float | None, err: Console
) -> Iterator[Callable[[StageInfo], None]]:
    """A line that tells the stage, how far the tempering is, and how the sampler moves."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
    begun = time.monotonic()
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as progress:
        task = progress.add_task(f"{name}: first, compiling" if budget is None or budget > 5 else name, total=1.0)

        def on_stage(info: StageInfo) -> None:
            beta, acceptance = min(info.beta), sum(info.acceptance) / len(info.acceptance)
            parts = [0.0]
            if stages is not None:
                parts.append(info.stage / stages)
            if budget is not None:
                parts.append((time.monotonic() - begun) / budget)
            text = f"{name}: stage {info.stage}, temperature {1 / max(beta, 1e-9):.3g}, acceptance {acceptance:.2f}"
            progress.update(task, description=text, completed=min(max(parts), 1.0))

        yield on_stage


def _publish(folder: Path, frame: Frame, found: Segment, result: Estimate, out: Console) -> Path:
    """Save, picture and print one object."""
    h = result.hypotheses
    path = hypotheses_path(folder, h.object_id)
    save(path, h)
    picture = path.with_suffix(".png")
    draw_object(picture, h, frame, found)
    report(h, out, time=f"{result.seconds:.1f} s")
    for written in (path, picture):
        out.print(f"  {written}", highlight=False, soft_wrap=True)
    return path


def _clear_others(folder: Path, path: Path, same: Hypotheses | None, out: Console) -> None:
    """Remove what earlier runs left beside `path`, for a folder's answer is joint over one frame: all objects, or with
    `same` (one object of several was asked for) those of other frames.
    """
    for other in sorted(folder.glob("object_*.npz")):
        if other == path or not re.fullmatch(r"object_\d+\.npz", other.name):
            continue
        if same is not None and _is_of_frame(other, same):
            continue
        other.unlink()
        other.with_suffix(".png").unlink(missing_ok=True)
        out.print(f"  {other} of an earlier run is removed", highlight=False, soft_wrap=True)


def _is_of_frame(path: Path, h: Hypotheses) -> bool:
    try:
        other = load(path)
    except ValueError:  # damaged, or of another version
        return False
    return (other.stamp_ns, other.frame_id) == (h.stamp_ns, h.frame_id)


def report(h: Hypotheses, out: Console, **first: str) -> None:
    """The short table of one object."""
    table = Table.grid(padding=(0, 2))
    for name, value in {**first, **figures(h)}.items():
        table.add_row(f"  {name}", value)
    label = f" ({h.label})" if h.label else ""
    out.print(f"object {h.object_id}{label}", style="bold", highlight=False)
    out.print(table, highlight=False)
    for line in warnings(h):
        out.print(f"  {line}", style="yellow", highlight=False, soft_wrap=True)


def view(path: Path, picture: Path | None, out: Console) -> None:
    """Describe a hypotheses file, or those of a folder, and draw each anew beside it (or to `picture`)."""
    scene = load_scene(path)
    if picture is not None and len(scene) > 1:
        raise ValueError(f"{path} holds {len(scene)} objects; give one file, or leave --out away")
    for h in scene:
        own = hypotheses_path(path, h.object_id) if path.is_dir() else path
        target = picture or own.with_name(f"{own.stem}_view.png")
        draw_object(target, h)
        report(h, out)
        out.print(f"  {target}", highlight=False, soft_wrap=True)
