"""`farside replay`: from a source's frame to each object's hypotheses, answer and picture."""

import re
import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from foundation.whole_file import check_folder
from node.commands.frame import read_frame, segments_of
from node.commands.options import ReplayConfig
from node.commands.progress import InferenceProgress
from node.figures.object_figure import draw_object
from node.figures.summary import answer, diagnostics, figures, warnings
from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import frame_path, hypotheses_path, load, save
from perception.answers.summary import summarise
from perception.inference.controller import inference_of
from perception.inference.inference import Inference
from perception.inference.limits import Callbacks, Limits
from perception.inference.scene import Answered, estimate_scene
from perception.observation.segmentation import Segment
from perception.sources.frame import Frame
from perception.sources.frame_folder import write_frame_folder
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import load_prior
from probnerf.types import StopReason

BUDGET_S = 90.0
PICTURE_S = 3.0  # of each object's share of the budget, kept back for its picture


def replay(config: ReplayConfig, out: Console, err: Console) -> bool:
    """Infer, save, picture and print the objects of one frame. False if Ctrl-C ended it; saved files are whole.

    An object that cannot be inferred is skipped with a note, unless it is the only one. Raises `ValueError` or
    `FileNotFoundError` in one line, before anything is written, for errors of the input.
    """
    begun = time.monotonic()
    check_folder(config.folder)
    prior = load_prior(config.prior)
    frame = read_frame(config, err)
    segments, source = segments_of(config, frame, err), config.source or SHIPPED_LOG
    limit = config.budget or (None if config.stages else BUDGET_S)
    kept, done = frame_path(config.folder), list[Hypotheses]()
    is_source = config.source is not None and config.source.resolve() == kept.resolve()
    complaint = ValueError("no object")

    deadline = None if limit is None else begun + limit

    def start(found: Segment, end: float | None) -> Inference:
        limits, callbacks = Limits(end, config.stages), Callbacks(partial(progress.on_stage, found.id))
        return inference_of(frame, found, prior, config.inference, seed=config.seed, limits=limits, callbacks=callbacks)

    written = set[Path]()
    with InferenceProgress([found.id for found in segments], config.stages, limit, err) as progress:
        answered = estimate_scene(segments, start, deadline, PICTURE_S)
        for found, result in _saved_if_interrupted(answered, config.folder, written):
            progress.finished(found.id)
            with progress.hidden(), _rest_saved(answered, config.folder):
                if isinstance(result, ValueError):
                    if len(segments) > 1:
                        err.print(f"object {found.id} is left out: {result}", highlight=False, soft_wrap=True)
                    complaint = ValueError(f"{source}: {result}")
                    continue
                if not done and not is_source:
                    (kept / "meta.json").unlink(missing_ok=True)  # an older frame must not stay beside new objects
                log = (f"started at {result.start}", *result.log)
                written.add(publish(config.folder, frame, found, result.hypotheses, result.seconds, out, log))
                if not done:
                    one = result.hypotheses if config.object is not None else None
                    _clear_others(config.folder, written, one, out)
                    if not is_source:
                        write_frame_folder(kept, frame)
                done.append(result.hypotheses)
    if not done:
        raise complaint
    return all(h.result != StopReason.INTERRUPTED for h in done)


@contextmanager
def _rest_saved(answered: Generator[Answered, None, None], folder: Path) -> Iterator[None]:
    """A Ctrl-C within: the present answers of the objects that are still to come are saved before it ends the job."""
    try:
        yield
    except KeyboardInterrupt as error:
        with suppress(StopIteration, KeyboardInterrupt):
            _save([answered.throw(error)], folder)
            for one in answered:
                _save([one], folder)
        raise


def _save(answers: Iterable[Answered], folder: Path) -> set[Path]:
    written = set()
    for found, result in answers:
        if not isinstance(result, ValueError):
            save(hypotheses_path(folder, found.id), result.hypotheses)
            written.add(hypotheses_path(folder, found.id))
    return written


def _saved_if_interrupted(answered: Iterator[Answered], folder: Path, written: set[Path]) -> Iterator[Answered]:
    """The same; after a Ctrl-C all that follows is saved first, before anything is drawn, and added to `written`."""
    for found, result in answered:
        if not isinstance(result, ValueError) and result.hypotheses.result == StopReason.INTERRUPTED:
            rest = [(found, result), *answered]
            written |= _save(rest, folder)
            yield from rest
            return
        yield found, result


def publish(
    folder: Path,
    frame: Frame,
    found: Segment,
    h: Hypotheses,
    seconds: float,
    out: Console,
    log: Sequence[str] = (),
) -> Path:
    """Save, picture and print one object (`report`); the file's path."""
    path = hypotheses_path(folder, h.object_id)
    save(path, h)
    picture = path.with_suffix(".png")
    draw_object(picture, h, frame, found)
    report(h, out, seconds, log)
    for written in (path, picture):
        out.print(f"  {written}", highlight=False, soft_wrap=True)
    return path


def _clear_others(folder: Path, written: set[Path], same: Hypotheses | None, out: Console) -> None:
    """Remove results of earlier runs beside those `written`: a folder's objects must be of one frame. With `same` (one
    object inferred) remove only those of other frames.
    """
    for other in sorted(folder.glob("object_*.npz")):
        if other in written or not re.fullmatch(r"object_\d+\.npz", other.name):
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


def report(h: Hypotheses, out: Console, seconds: float | None = None, log: Sequence[str] = ()) -> None:
    """Print one object: the answer in words, its numbers, the warnings, and last the sampler's diagnostics.

    `seconds` is the time of inference, `log` the reasons for the amount of model.
    """
    label = f" ({h.label})" if h.label else ""
    first = Text.assemble((f"object {h.object_id}{label}:", "bold"), f" {answer(summarise(h))}")
    out.print(first, highlight=False, soft_wrap=True)
    table = Table.grid(padding=(0, 2))
    for name, value in figures(h).items():
        table.add_row(f"  {name}", value)
    out.print(table, highlight=False)
    for line in warnings(h):
        out.print(f"  {line}", style="yellow", highlight=False, soft_wrap=True)
    time = {} if seconds is None else {"time": f"{seconds:.1f} s"}
    details = ", ".join(f"{name} {value}" for name, value in {**time, **diagnostics(h)}.items())
    for line in (f"sampler: {details}", *log):
        out.print(f"  {line}", style="dim", highlight=False, soft_wrap=True)
