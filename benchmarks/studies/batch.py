"""A batch: units an hour by the number of workers, and what it moves and keeps, from which a hundred machines follow.

Real units are inferred from copies of the shipped recording, by each number of processes. Their rate leaves out what
the start takes: it counts from the end of the first unit of each process. Beside it stand its ratios to the first
number of processes and to a plain loop over the same units, which runs in this process, on all of its cores, and writes
nothing. What a Dask scheduler has to do for a task is measured with logs that are empty files, so that each task fails
at once and writes why: messages that scheduler and client send or get, heartbeats with them, and seconds, of which two
workers of this machine need a part.
"""

import io
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table
from foundation.store import Store
from node.commands.batch import FAILED, batch
from node.commands.batch_options import BatchConfig
from node.commands.frame import read_frame, segments_of
from perception.inference.controller import estimate
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import load_prior

MACHINES = 100


@dataclass(frozen=True)
class Options(TableOptions):
    """Units an hour of `farside batch`, and what it moves and keeps."""

    workers: tuple[int, ...] = (1, 2)
    """Numbers of processes."""
    logs: int = 6
    """Copies of the shipped recording, of two units each; two with --quick."""
    stages: int | None = None
    """Stages of each unit; 1 with --quick. Until it has converged by default."""
    tasks: int = 1000
    """Tasks on Dask; 20 with --quick."""
    units: int = 100_000
    """Units of the computed run on a hundred machines."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    logs, stages = (2, 1) if options.quick else (options.logs, options.stages)
    rows, rates = list[Row](), dict[str, float]()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        rates["plain loop"] = _plain_rate(logs, BatchConfig(stages=stages))
        for workers in options.workers:
            store = _run(place, logs, BatchConfig(workers=workers, stages=stages))
            rates[f"{workers} workers"] = _rate(store, workers)
        loop, first = list(rates.values())[:2]
        lines = [[name, str(2 * logs), f"{r:.0f}", f"{r / first:.2f}", f"{r / loop:.2f}"] for name, r in rates.items()]
        for name, rate in rates.items():
            figures = {"units_per_hour": rate, "ratio_to_first": rate / first, "ratio_to_loop": rate / loop}
            rows += [Row("batch", "processes", name, k, v, "1/h" * (k[0] == "u"), 2 * logs) for k, v in figures.items()]
            say(f"{name}: {rate:.0f} units an hour")
        sizes = store.sizes()
        units = [name for name in sizes if name.endswith(".npz")]
        kept = {
            "unit_bytes": sum(sizes[name] + sizes[f"{name[:-4]}.json"] for name in units) / len(units),
            "log_bytes": sum(size for name, size in sizes.items() if name.endswith("/log.json")) / logs,
            "read_bytes": float(SHIPPED_LOG.stat().st_size),
        }
        rows += [Row("batch", "files", "shipped recording", name, value, "B", 2 * logs) for name, value in kept.items()]
        tasks = 20 if options.quick else options.tasks
        with _messages() as count:
            begun = monotonic()
            _run(place, tasks, BatchConfig(workers=2, dask="local"), empty=True)
            seconds = monotonic() - begun
        moved = {"messages": count["messages"], "message_bytes": count["bytes"], "seconds": seconds}
        moved = {name: value / tasks for name, value in moved.items()}
        rows += [Row("batch", "dask", "empty logs", f"task_{k}", v, "", tasks) for k, v in moved.items()]
    header = ("by", "units", "units/h", f"of {options.workers[0]} workers", "of the plain loop")
    measured = Table("Units an hour", header, lines)
    return Summary(rows, [measured, computed(options, kept, moved)])


def _run(place: Path, logs: int, config: BatchConfig, empty: bool = False) -> Store:
    """A batch of so many copies, or empty files, in new folders; its results."""
    folder = Path(tempfile.mkdtemp(dir=place))
    (folder / "logs").mkdir()
    for path in (folder / "logs" / f"{i:06d}.mcap" for i in range(logs)):
        path.touch() if empty else shutil.copyfile(SHIPPED_LOG, path)
    text = io.StringIO()
    config = replace(config, logs=(str(folder / "logs"),), out=str(folder / "out"))
    if batch(config, Console(file=text), Console(file=text)) != (FAILED if empty else 0):
        raise RuntimeError(f"the batch failed:\n{text.getvalue()}")
    return Store(str(folder / "out"))


def _plain_rate(logs: int, config: BatchConfig) -> float:
    """Units an hour after the first one, of a loop that reads the log anew for each copy."""
    prior, err, ends = load_prior(None), Console(file=io.StringIO()), list[float]()
    for _ in range(logs):
        options = replace(config, source=SHIPPED_LOG)
        frame = read_frame(options, err)
        for found in segments_of(options, frame, err):
            estimate(frame, found, prior, config.inference, seed=0, budget_s=None, stages=config.stages)
            ends.append(monotonic())
    return 3600.0 * (len(ends) - 1) / (ends[-1] - ends[0])


def _rate(store: Store, workers: int) -> float:
    """Units an hour after the first of each worker, by the times of their records."""
    units = [name for name in store.sizes() if name.endswith(".npz")]
    ends = sorted(Path(store.path(f"{name[:-4]}.json")).stat().st_mtime for name in units)
    return 3600.0 * (len(ends) - workers) / (ends[-1] - ends[workers - 1]) if len(ends) > workers else float("nan")


@contextmanager
def _messages() -> Iterator[dict[str, int]]:
    """Counts messages, and their bytes, that the scheduler and its client, both in this process, send and get.

    Dask sends several messages together; each counts. What the client and the scheduler send each other counts once.
    """
    try:
        from distributed.comm.tcp import TCP
    except ModuleNotFoundError:
        raise ValueError("counting Dask's messages needs the extra cluster: pip install 'farside[cluster]'") from None
    count = {"messages": 0, "bytes": 0}
    write, read, sent = TCP.write, TCP.read, set[int]()

    async def counted_write(self: Any, message: Any, *args: Any, **how: Any) -> int:
        size = await write(self, message, *args, **how)
        count["messages"] += len(message) if isinstance(message, list | tuple) else 1
        count["bytes"] += size
        sent.add(_port(self.local_address))
        return size

    async def counted_read(self: Any, *args: Any, **how: Any) -> Any:
        message = await read(self, *args, **how)
        if _port(self.peer_address) not in sent:  # from another process
            count["messages"] += len(message) if isinstance(message, list | tuple) else 1
        return message

    TCP.write, TCP.read = counted_write, counted_read  # type: ignore[assignment, method-assign]
    try:
        yield count
    finally:
        TCP.write, TCP.read = write, read  # type: ignore[method-assign]


def _port(address: str) -> int:
    return int(address.rpartition(":")[2])


def computed(options: Options, kept: dict[str, float], moved: dict[str, float]) -> Table:
    """What so many units of two a log are on a hundred machines."""
    units, logs = options.units, options.units / 2
    per_task = units + logs
    lines = [
        ["files of results", f"{2 * units + logs:,.0f}"],
        ["bytes of results", f"{(units * kept['unit_bytes'] + logs * kept['log_bytes']) / 1e9:,.1f} GB"],
        ["logs to read, each once", f"{logs * kept['read_bytes'] / 1e9:,.0f} GB"],
        ["files written by a machine", f"{(2 * units + logs) / MACHINES:,.0f}"],
        ["scheduler's messages (Dask)", f"{per_task * moved['messages']:,.0f}"],
        ["scheduler's bytes (Dask)", f"{per_task * moved['message_bytes'] / 1e9:,.2f} GB"],
        ["scheduler's time, at most (Dask)", f"{per_task * moved['seconds'] / 60:,.0f} min"],
    ]
    return Table(f"{units:,} units of {logs:,.0f} logs on {MACHINES} machines, computed", ("what", "how much"), lines)
