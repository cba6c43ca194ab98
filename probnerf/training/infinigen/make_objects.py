"""Make training meshes with Infinigen's object generators, from seeds. Stands alone, in an environment of its own.

    python3.11 -m venv ENV && ENV/bin/pip install --no-deps -r probnerf/training/infinigen/requirements.txt
    ENV/bin/python probnerf/training/infinigen/make_objects.py OUT --count 60

Each object becomes `OUT/<Factory>_<seed>.ply`: binary, metres, z up as in Blender, triangles only, all parts joined,
at most 20,000 faces. `OUT/index.jsonl` has one line for each: `Made`, or `Failed` with the reason. A run can be killed
at any time: the next one skips what the index has. Objects come seed by seed, each seed from all factories, so a part
of a run is balanced. The same seed gives the same shape, whatever was made before it (Blender may place triangles
another way, within 0.1 mm of the surface).

This folder imports nothing of Farside, and nothing of Farside imports it: Blender (`bpy`) is under the GPL. It runs in
child processes, which are replaced after some objects, as Blender's memory grows, and when an object takes too long.
"""

import argparse
import contextlib
import json
import os
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from one_object import FACTORIES, Made, Task, make


@dataclass(frozen=True)
class Failed:
    """A seed that gave no object, and why."""

    factory: str
    seed: int
    failed: str


def round_robin(factories: Iterable[str], first_seed: int, count: int) -> list[Task]:
    """All factories' objects of the first seed, then of the next, `count` seeds in all."""
    names = list(factories)
    return [Task(name, seed) for seed in range(first_seed, first_seed + count) for name in names]


def finished(folder: Path) -> set[Task]:
    """What the folder's index has, as a file that is still there or as a failure. A line cut short counts as none."""
    index, tasks = folder / "index.jsonl", set[Task]()
    for line in index.read_text(encoding="utf-8").splitlines() if index.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            row = json.loads(line)
            task = Task(row["factory"], row["seed"])
            if "failed" in row or (folder / task.file).exists():
                tasks.add(task)
    return tasks


def work(connection: Connection, folder: Path, log: Path) -> None:
    """A child process: answer each task that comes with a `Made` or `Failed`, until None comes."""
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)  # Blender and Infinigen print much
    os.dup2(output, 2)
    while (task := connection.recv()) is not None:
        result: Made | Failed
        try:
            result = make(task, folder)
        except Exception as error:
            traceback.print_exc()
            words = " ".join(str(error).split())
            result = Failed(task.factory, task.seed, f"{type(error).__name__}: {words}"[:300])
        connection.send(result)


@dataclass
class Child:
    """A child process, replaced after `renew` objects, after a crash, and after `limit` seconds without an answer."""

    folder: Path
    log: Path
    renew: int
    limit: float
    process: BaseProcess | None = None
    connection: Connection | None = None
    answered: int = 0

    def answer(self, task: Task) -> Made | Failed:
        if self.process is None or self.connection is None or self.answered >= self.renew:
            self.end()
            context = get_context("spawn")
            self.connection, other = context.Pipe()
            self.process = context.Process(target=work, args=(other, self.folder, self.log), daemon=True)
            self.process.start()
            other.close()
        self.answered += 1
        self.connection.send(task)
        if not self.connection.poll(self.limit):
            self.end(kill=True)
            return Failed(task.factory, task.seed, f"took more than {self.limit:g} s")
        try:
            return self.connection.recv()
        except EOFError:
            self.process.join()
            code = self.process.exitcode
            self.end(kill=True)
            return Failed(task.factory, task.seed, f"the process ended with code {code}")

    def end(self, kill: bool = False) -> None:
        """End the process: at once, or after its last answer."""
        if self.process is not None and self.connection is not None:
            if kill:
                self.process.kill()
            else:
                self.connection.send(None)
            self.process.join()
            self.connection.close()
        self.process, self.connection, self.answered = None, None, 0


def run(tasks: list[Task], folder: Path, jobs: int, renew: int, limit: float) -> int:
    """Make all tasks' objects with `jobs` processes, append to the index, print progress; how many failed."""
    start, lock, done, failed = time.monotonic(), threading.Lock(), 0, 0
    waiting: Iterator[Task] = iter(tasks)

    def record(result: Made | Failed) -> None:
        nonlocal done, failed
        with open(folder / "index.jsonl", "a", encoding="utf-8") as index:
            index.write(json.dumps(asdict(result)) + "\n")
        done, failed = done + 1, failed + isinstance(result, Failed)
        rate = done / (time.monotonic() - start)
        what = (
            f"{result.failed[:80]}" if isinstance(result, Failed) else f"{result.faces} faces, {result.seconds:.1f} s"
        )
        left = (len(tasks) - done) / rate / 60
        name = f"{result.factory}_{result.seed}"
        print(
            f"{done}/{len(tasks)} {name}: {what}; {60 * rate:.1f}/min, {left:.0f} min left, {failed} failed", flush=True
        )

    def serve(number: int) -> None:
        child = Child(folder, folder / f"child_{number}.log", renew, limit)
        try:
            while True:
                with lock:
                    task = next(waiting, None)
                if task is None:
                    return
                result = child.answer(task)
                with lock:
                    record(result)
        finally:
            child.end(kill=True)

    with ThreadPoolExecutor(jobs) as pool:
        for service in [pool.submit(serve, number) for number in range(jobs)]:
            service.result()
    return failed


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Make training meshes with Infinigen's object generators, from seeds.")
    parser.add_argument("out", type=Path, help="folder for the meshes and index.jsonl; made if it is not there")
    parser.add_argument("--count", type=int, default=60, help="objects of each factory (%(default)s)")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first of them (%(default)s)")
    parser.add_argument(
        "--factories",
        nargs="+",
        choices=[*FACTORIES],
        default=[*FACTORIES],
        metavar="NAME",
        help=f"some of {', '.join(FACTORIES)} (all)",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes at once (%(default)s); each needs up to 3 GB")
    parser.add_argument("--renew", type=int, default=40, help="objects after which a process is replaced (%(default)s)")
    parser.add_argument(
        "--limit", type=float, default=240, help="seconds for one object, then it is given up (%(default)s)"
    )
    return parser.parse_args(words)


def main() -> None:
    args = arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    made = finished(args.out)
    tasks = [task for task in round_robin(args.factories, args.first_seed, args.count) if task not in made]
    with tempfile.TemporaryDirectory() as user_folder:
        os.environ["BLENDER_USER_RESOURCES"] = user_folder  # a user's own Blender settings must change nothing
        os.environ["PYTHONHASHSEED"] = "0"
        failed = run(tasks, args.out.resolve(), args.jobs, args.renew, args.limit)
    print(f"{len(tasks)} tried, {failed} failed, {len(made)} were there before: {args.out}")


if __name__ == "__main__":
    main()
