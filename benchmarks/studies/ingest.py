"""Taking frames in and recording them: a camera's 640x480 RGB-D at 30 Hz, alone and beside inference and queries.

A synthetic camera gives frames (the shipped recording's, with a camera's noise) by its own clock into a `Reader`. A
listener records every frame. Under the condition "inference", a second thread takes the newest frame as often as it
can and samples one stage of the default posterior of its first object; a third asks for 1000 points of the hypotheses
twenty times a second. "idle" is the same without these two.

- frames_due: frames by the camera's clock. frames_in: frames that the reader received. The camera keeps the last four
  frames, as drivers do; a frame that is later than four periods is dropped.
- recorded: frames in the file. lost: frames due that are not in the file, for any reason.
- newest_skipped: frames that inference passed over for a newer one, as it must.
- newest_age: from the frame's stamp to inference, median and 95th percentile.
- listener_age: the same to the recording.
- query: from a question to its answer, in this process, median and 99th percentile.
"""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.scenes.recording import noisy
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import estimate
from perception.inference.tracker import Tracker
from perception.inference.warm_up import warm_up
from perception.observation.segmentation import segment
from perception.sources.frame import Frame
from perception.sources.reader import Reader, ReaderCounts
from perception.sources.recorder import Recorder
from probnerf.prior.checkpoint import load_prior

FPS = 30.0
ASK_S = 0.05  # between questions
BUFFERS = 4  # frames that a camera's driver keeps for a reader that is late (V4L2's usual number)


class SyntheticCamera:
    """640x480 colour and depth at 30 Hz for so many seconds; stamps are the time at which a frame was due."""

    live = True

    def __init__(self, seconds: float) -> None:
        self._frames = noisy(8)
        self.notes: list[str] = []
        self.due = round(seconds * FPS)
        self.missed = 0
        self._closed = threading.Event()

    def close(self) -> None:
        self._closed.set()

    def __iter__(self) -> Iterator[Frame]:
        begun, unix = time.monotonic(), time.time_ns()
        for i in range(self.due):
            at = i / FPS
            if self._closed.wait(max(0.0, begun + at - time.monotonic())):
                return
            if time.monotonic() - begun - at > BUFFERS / FPS:
                self.missed += 1
                continue
            yield replace(self._frames[i % len(self._frames)], stamp_ns=unix + round(at * 1e9))


@dataclass(eq=False)
class Taken:
    """When the two consumers got their frames."""

    counts: ReaderCounts
    due: int
    missed: int
    recorded: int
    newest_age: list[float] = field(default_factory=list)  # s
    listener_age: list[float] = field(default_factory=list)  # s
    query_s: list[float] = field(default_factory=list)


def take_in(
    seconds: float, path: Path, work: Callable[[Frame], None] | None, ask: Callable[[], None] | None = None
) -> Taken:
    """Read the synthetic camera for so long and record it to `path`, with `work` for every newest frame (None: take it
    and do nothing) and `ask` twenty times a second.
    """
    camera = SyntheticCamera(seconds)
    newest_age: list[float] = []
    listener_age: list[float] = []
    query_s: list[float] = []
    reader = Reader(camera)
    listener = reader.listen("recording")
    with Recorder(path) as recorder:
        with reader:

            def infer() -> None:
                while (frame := reader.newest()) is not None and not reader.over:  # the last one only ages
                    newest_age.append((time.time_ns() - frame.stamp_ns) * 1e-9)
                    if work is not None:
                        work(frame)

            def question() -> None:
                while ask is not None and not reader.over:
                    begun = time.perf_counter()
                    ask()
                    query_s.append(time.perf_counter() - begun)
                    time.sleep(ASK_S)

            threads = [threading.Thread(target=target) for target in (infer, question)]
            for thread in threads:
                thread.start()
            for frame in listener:
                listener_age.append((time.time_ns() - frame.stamp_ns) * 1e-9)
                recorder.write_frame(frame)
            for thread in threads:
                thread.join()
            counts = reader.counts()
    for error in (counts.error, recorder.error):
        if error:
            raise ValueError(f"the measurement failed: {error}")
    return Taken(counts, camera.due, camera.missed, recorder.frames, newest_age, listener_age, query_s)


def inference() -> tuple[Callable[[Frame], None], Callable[[], None]]:
    """One stage of the default posterior of a frame's first object, and a question; as warm as the node begins."""
    prior, made = load_prior(), []

    def work(frame: Frame) -> None:
        made.append(estimate(frame, segment(frame)[0], prior, stages=1).hypotheses)
        del made[:-1]

    work(noisy(1)[0])
    points = Points(np.random.default_rng(0).uniform(-0.1, 0.1, (1000, 3)))

    def ask() -> None:
        query(made[-1:], points, "object")

    ask()
    warm_up(Tracker(prior))
    return work, ask


@dataclass(frozen=True)
class Options(TableOptions):
    """Taking frames in: 30 Hz RGB-D through the reader into a recording, with and without inference beside it."""

    seconds: float = 60.0
    """Of each condition (quick: at most 3)."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    seconds = options.seconds
    if not seconds > 0:
        raise ValueError(f"seconds is {seconds:g}; give more than 0")
    seconds = min(seconds, 3.0) if options.quick else seconds
    taken = {}
    with tempfile.TemporaryDirectory(dir=options.out) as folder:
        for condition, (work, ask) in {"idle": (None, None), "inference": inference()}.items():
            say(f"{condition}: {seconds:g} s at {FPS:g} Hz")
            taken[condition] = take_in(seconds, Path(folder) / f"{condition}.mcap", work, ask)
    rows = [row for condition, result in taken.items() for row in _rows(condition, result)]
    return Summary(rows, picture=lambda: _draw(taken))


def _rows(condition: str, t: Taken) -> list[Row]:
    n = t.due
    values: list[tuple[str, float, str, int]] = [
        ("frames_due", t.due, "", n),
        ("frames_in", t.counts.received, "", n),
        ("recorded", t.recorded, "", n),
        ("lost", t.due - t.recorded, "", n),
        ("newest_taken", len(t.newest_age), "", n),
        ("newest_skipped", t.counts.dropped["newest"], "", n),
    ]
    for name, ages, high in (
        ("newest_age", t.newest_age, 0.95),
        ("listener_age", t.listener_age, 0.95),
        ("query", t.query_s, 0.99),
    ):
        if name == "query" and not ages:
            continue
        for suffix, q in (("median", 0.5), (f"q{100 * high:.0f}", high)):
            value = float(np.quantile(ages, q)) if ages else float("nan")
            values.append((f"{name}_{suffix}", 1000.0 * value, "ms", len(ages)))
    return [Row("ingest", "Reader", condition, metric, float(value), unit, n) for metric, value, unit, n in values]


def _draw(taken: dict[str, Taken]) -> Figure:
    """Ages of the frames when they were handed over, as cumulative shares."""
    figure = Figure(figsize=(7, 4), layout="constrained", dpi=110)
    ax = figure.subplots()
    for (condition, t), colour in zip(taken.items(), ("tab:blue", "tab:orange"), strict=False):
        for ages, who, style in ((t.newest_age, "newest, for inference", "-"), (t.listener_age, "every frame", ":")):
            if ages:
                share = (np.arange(len(ages)) + 1) / len(ages)
                label = f"{condition}: {who} ({len(ages)} of {t.due})"
                ax.step(1000.0 * np.sort(ages), share, style, color=colour, where="post", label=label)
    ax.axvline(1000.0 / FPS, color="0.7", linewidth=0.8)
    ax.set(
        xscale="log", xlabel="age of a frame when it is handed over, ms (line: one period)", ylabel="share of frames"
    )
    ax.set_ylim(0, 1.02)
    ax.legend(loc="upper left", fontsize=8)
    return figure
