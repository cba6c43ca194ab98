"""Recording: frames per second that the recorder sustains with each encoding, and the cost of a frame.

Frames of the shipped recording (640x480, depth in whole millimetres), with a camera's noise added to the colour
because colour without noise compresses too well. The recorder gets them as fast as it takes them.

- frames_per_s: until the last frame is on its way to the disk, one thread encoding and writing.
- cpu_ms_per_frame: processor time of the whole process; 30 frames per second at 10 ms take 30% of one core.
- bytes_per_frame: of the file.
"""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args, get_type_hints

from matplotlib.figure import Figure

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.scenes.recording import noisy
from perception.sources.frame import Frame
from perception.sources.recorder import Recorder
from perception.sources.settings import RecordConfig


@dataclass(frozen=True)
class Cost:
    """What one configuration takes."""

    name: str
    frames_per_s: float
    cpu_ms: float
    bytes_per_frame: float


@dataclass(frozen=True)
class Options(TableOptions):
    """What recording takes, with every encoding."""

    frames: int = 150
    """Frames that are recorded, at most 20 with --quick."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    out = options.out
    count = min(options.frames, 20) if options.quick else options.frames
    source = noisy(count)
    costs = []
    for config in encodings():
        costs.append(measure(source, config, out))
        c = costs[-1]
        say(f"{c.name:12s} {c.frames_per_s:5.0f} frames/s, {c.cpu_ms:5.1f} ms CPU, {c.bytes_per_frame / 1e6:5.2f} MB")
    rows = []
    for c in costs:
        for metric, value, unit in (
            ("frames_per_s", c.frames_per_s, "1/s"),
            ("cpu_ms_per_frame", c.cpu_ms, "ms"),
            ("bytes_per_frame", c.bytes_per_frame, "B"),
        ):
            rows.append(Row("record", c.name, "640x480, RGB-D", metric, value, unit, count))
    return Summary(rows, picture=lambda: draw(costs))


def encodings() -> list[RecordConfig]:
    """Every colour encoding with every compression; depth stays exact."""
    hints = get_type_hints(RecordConfig)
    colours, compressions = get_args(hints["colour"]), get_args(hints["compression"])
    return [RecordConfig(colour=colour, compression=c) for colour in colours for c in compressions]


def measure(frames: Sequence[Frame], config: RecordConfig, folder: Path) -> Cost:
    """Record to a file in `folder`, which is removed."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        begun, cpu = time.perf_counter(), time.process_time()
        with Recorder(Path(place) / "bench.mcap", config, wait=True) as recorder:
            for frame in frames:
                recorder.write_frame(frame)
        seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
        if recorder.error is not None:
            raise OSError(recorder.error)
        n = len(frames)
        return Cost(f"{config.colour}, {config.compression}", n / seconds, 1e3 * cpu / n, recorder.bytes / n)


def draw(costs: Sequence[Cost]) -> Figure:
    """Size against processor time: best is the lower left."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained", dpi=120)
    axes = figure.subplots()
    marks = {"raw": "o", "png": "s", "jpeg": "^"}
    for c in costs:
        axes.plot(c.cpu_ms, c.bytes_per_frame / 1e6, marks[c.name.split(",")[0]], color="tab:blue")
        axes.annotate(
            c.name, (c.cpu_ms, c.bytes_per_frame / 1e6), xytext=(6, 3), textcoords="offset points", fontsize=8
        )
    axes.set_xlabel("processor time (ms per frame)")
    axes.set_ylabel("size (MB per frame)")
    axes.set_xlim(0.0, 1.25 * max(c.cpu_ms for c in costs))
    axes.set_ylim(0.0, 1.15 * max(c.bytes_per_frame for c in costs) / 1e6)
    axes.grid(alpha=0.3)
    return figure
