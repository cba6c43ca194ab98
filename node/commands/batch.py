"""`farside batch`: the objects of many logs, each inferred once, on one machine or many.

A log's record (log.json) lists its objects. Each object with each seed is a unit: its hypotheses file is written first
and its record last, each whole or not at all. What has a record is not done again.
"""

import hashlib
import json
import re
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from foundation.bounded import parse_json
from foundation.one_line import one_line
from foundation.store import Store, WriteError, bytes_of
from node.commands.batch_logs import find_logs
from node.commands.batch_options import BatchConfig
from node.commands.batch_table import TABLE, make_table
from node.commands.batch_task import TRIES, Event, Job, Record, Runner, Task
from node.commands.batch_unit import write_record
from node.commands.batch_workers import run_processes
from probnerf.prior.checkpoint import identity_of

SETTINGS = "settings.json"
FORMAT = "farside-batch-1"
FAILED = 3  # exit code: all is done that can be, and some of it failed
INTERRUPTED = 130


def batch(
    config: BatchConfig,
    out: Console,
    err: Console,
    runner: Callable[[Job], Runner] | None = None,
    infer: Callable[..., Any] | None = None,
) -> int:
    """Do what is not done yet, and make the table. The exit code: 0, `FAILED`, or 130 after Ctrl-C.

    `runner` takes the place of processes, `infer` that of `perception.inference.controller.estimate`. Raises
    `ValueError` or `OSError` in one line, before any inference, for errors of the input and the place.
    """
    if not config.out:
        raise ValueError("there is no place for the results; give --out FOLDER, or a URL")
    store = Store(config.out)
    if store.in_memory and runner is None:
        raise ValueError(f"{config.out} is the memory of one process, and would be lost; give --out another place")
    if config.table_only:
        return _table(store, None, out)
    logs = find_logs(config.logs, store.url)
    if config.dask is not None and find_spec("distributed") is None:
        raise ValueError("--dask needs the package distributed: pip install 'farside[cluster]'")
    store.check()
    camera, masks, prior = map(_absolute, (config.camera, config.masks, config.prior))
    config = replace(config, camera=camera, masks=masks, prior=prior)
    settings = _claimed(store, _settings(config))
    job = Job(config, store.url, settings, infer)
    work = _Work(store, job, logs)
    tasks = work.plan()
    run = runner(job) if runner is not None else _runner(job, err)
    begun = time.monotonic()
    try:
        _run(run, tasks, work, err)
    except KeyboardInterrupt:
        work.report(out, time.monotonic() - begun)
        out.print("interrupted; the same command goes on", highlight=False)
        return INTERRUPTED
    except WriteError as error:  # nothing more can be kept
        work.report(out, time.monotonic() - begun)
        raise WriteError(f"{error}; then the same command goes on") from None
    work.report(out, time.monotonic() - begun)
    if config.shard is None:
        return _table(store, settings, out)
    out.print(f"when all parts are done: farside batch --table-only --out {store.url}", highlight=False, soft_wrap=True)
    return FAILED if work.failed else 0


def _runner(job: Job, err: Console) -> Runner:
    """Dask, or processes of this machine."""
    if job.config.dask is None:
        return partial(run_processes, job, job.config.workers)
    from node.commands.batch_dask import run_dask  # here: it needs the extra `cluster`

    say = partial(err.print, highlight=False, soft_wrap=True)
    return partial(run_dask, job, job.config.dask, job.config.workers, say)


class _Work:
    """What of the logs is this process's to do, and what came of it."""

    def __init__(self, store: Store, job: Job, logs: list[str]) -> None:
        i, n = job.config.part
        self._store, self._job = store, job
        self._seeds: dict[str, list[int]] = {}
        # by log and seed, not by object: nobody needs to open a log only to count its objects
        for log, seed in [(log, seed) for log in logs for seed in range(job.config.seeds)][i::n]:
            self._seeds.setdefault(log, []).append(seed)
        self._there = set(store.sizes())
        self.done = self.skipped = 0
        self.failed = 0
        self.lost = list[str]()

    def plan(self) -> list[Task]:
        """The tasks to begin with. Raises `ValueError` where a log is not the one that was inferred before."""
        known = {name: log for log in self._seeds if (name := Task(log).done) in self._there}
        records = {known[name]: parse_json(text) for name, text in self._store.read(known).items()}
        sizes = bytes_of(records)
        tasks = list[Task]()
        for log in self._seeds:
            if (record := records.get(log)) is None:
                tasks += self._open([Task(log)])
            elif not isinstance(record, dict) or not isinstance(record.get("bytes"), int):
                raise ValueError(f"{self._store.path(Task(log).done)} is damaged; remove it, and it is made again")
            elif record["bytes"] != sizes[log]:
                raise ValueError(
                    f"{log} has changed since its objects were found ({record['bytes']} bytes then, {sizes[log]} now);"
                    f" give another --out, or remove {self._store.path(str(Path(Task(log).name).parent))}"
                )
            else:
                tasks += self.then(Task(log), record)
        return tasks

    def then(self, task: Task, record: Record) -> Iterator[Task]:
        """The units that follow from a log's record."""
        objects, seeds = record.get("objects", ()), self._seeds[task.log]
        return self._open([Task(task.log, i, seed, record["frame"]) for seed in seeds for i in objects])

    def _open(self, tasks: Iterable[Task]) -> Iterator[Task]:
        """Those that are still to be done."""
        for task in tasks:
            if task.done in self._there:
                self.skipped += 1
            elif task.failed in self._there and not self._job.config.retry_failed:
                self.skipped += 1
                self.failed += 1
            else:
                yield task

    def ended(self, task: Task, record: Record) -> None:
        """Count a task that has come to its end."""
        if record.get("result") == "failed":
            self.failed += 1
            return
        self.done += task.object_id is not None
        if task.failed in self._there:
            self._store.remove(task.failed)

    def lose(self, event: Event) -> str:
        """Keep for the report which worker was lost."""
        again = "tried again" if event.tries < TRIES else "given up"
        self.lost.append(event.lost if event.task is None else f"{event.task}: {event.lost}; {again}")
        return self.lost[-1]

    def give_up(self, task: Task, why: str) -> Record:
        """Write that a task was lost too often."""
        record = self._job.failure(task, f"given up after {TRIES} tries: {why}")
        write_record(self._store, task, record)
        return record

    def report(self, out: Console, seconds: float) -> None:
        """Print what was done, and what became of workers."""
        line = f"{self.done} units done, {self.skipped} were there, {self.failed} failed"
        if self.done:
            line += f"; {seconds:.0f} s, {3600 * self.done / max(seconds, 1e-3):.0f} units an hour"
        out.print(line, highlight=False, soft_wrap=True)
        for each in self.lost:
            out.print(f"  lost: {each}", highlight=False, soft_wrap=True)


def _run(runner: Runner, tasks: list[Task], work: _Work, err: Console) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=err, transient=True, disable=not err.is_terminal) as bars:
        bar, total, ended = bars.add_task("logs and units", total=len(tasks)), len(tasks), 0

        say = partial(bars.console.print, markup=False, highlight=False, soft_wrap=True)

        def then(task: Task, record: Record) -> list[Task]:
            nonlocal total
            new = list(work.then(task, record))
            total += len(new)
            return new

        for event in runner(tasks, then):
            record = event.record
            if record is None:
                say(f"lost: {work.lose(event)}", style="yellow")
                if event.task is None or event.tries < TRIES:
                    continue
                record = work.give_up(event.task, event.lost)
            assert event.task is not None
            work.ended(event.task, record)
            ended += 1
            bars.update(bar, completed=ended, total=total)
            line, style = _said(event.task, record)
            say(f"[{ended}/{total}] {line}", style=style)


def _said(task: Task, record: Record) -> tuple[str, str]:
    """What became of a task, and its style."""
    if record.get("result") == "failed":
        return f"{task}: failed: {record['error']}", "red"
    if "objects" in record:
        left = f", {len(record['left_out'])} left out" if record["left_out"] else ""
        return f"{task}: {len(record['objects'])} objects{left}", ""
    return f"{task}: {record['result']}, {record['seconds']:.1f} s", ""


def _table(store: Store, settings: str | None, out: Console) -> int:
    """Make the table of all that is there, of these settings or those that were kept. The exit code."""
    if not store.has(SETTINGS):
        raise FileNotFoundError(f"{store.url} holds no results of `farside batch`; give the --out of a run")
    sizes = store.sizes()
    kept = _kept(store)
    table = make_table(store, settings or _digest(kept), kept, sizes)
    failed = table["result"].to_pylist().count("failed")
    files = [size for name, size in sizes.items() if re.search(r"^logs/.*\.(json|npz)$", name)]
    line = f"{store.path(TABLE)}: {table.num_rows} rows ({failed} failed)"
    line += f", of {len(files)} files with {sum(files) / 1e6:.2f} MB"
    out.print(line, highlight=False, soft_wrap=True)
    return FAILED if failed else 0


def _settings(config: BatchConfig) -> dict[str, Any]:
    """All that results depend on but their log, object and seed; files by their content."""
    own = ("source", "logs", "out", "seeds", "shard", "workers", "retry_failed", "table_only", "dask", "method")
    values = {name: value for name, value in asdict(config).items() if name not in own}
    for name in ("camera", "masks"):
        path = getattr(config, name)
        values[name] = None if path is None else hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    values |= {"prior": identity_of(config.prior), "controller": asdict(config.inference)}
    return {"format": FORMAT, "farside": version("farside"), **values}


def _claimed(store: Store, settings: dict[str, Any]) -> str:
    """The digest of these settings, which the place holds from now on. Raises `ValueError` if it holds others."""
    text = _written(settings)
    if not store.has(SETTINGS):
        store.write(SETTINGS, text.encode())
    kept = _kept(store)
    if kept != text:
        before, after = dict(_leaves(parse_json(kept))), dict(_leaves(parse_json(text)))
        name = next(name for name in sorted(before | after) if before.get(name, ...) != after.get(name, ...))
        old, new = (str(values.get(name))[:80] for values in (before, after))
        raise ValueError(f"{store.url} holds results with {name} {old}, and this is {new}; give that, or another --out")
    return _digest(kept)


def _kept(store: Store) -> str:
    """The settings that the place holds, as they were written. Raises `ValueError` where they are damaged, or another
    version's.
    """
    try:
        values = parse_json(store.read([SETTINGS])[SETTINGS].decode())
        if not isinstance(values, dict):
            raise ValueError("it is no mapping")
    except ValueError as error:
        raise ValueError(f"{store.path(SETTINGS)} is damaged ({one_line(error)[:200]}); give another --out") from None
    if (found := values.get("format")) != FORMAT:
        raise ValueError(f"{store.path(SETTINGS)} has format {str(found)[:40]!r}, not {FORMAT}; give another --out")
    return _written(values)


def _written(settings: dict[str, Any]) -> str:
    """In one way, whoever wrote them."""
    return json.dumps(settings, sort_keys=True, default=str, indent=1)


def _digest(settings: str) -> str:
    return hashlib.sha256(settings.encode()).hexdigest()[:16]


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, by dotted names."""
    if not isinstance(value, dict):
        yield name, value
        return
    for key, each in value.items():
        yield from _leaves(each, f"{name}.{key}" if name else key)


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.absolute()
