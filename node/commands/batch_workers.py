"""Processes of this machine that do the tasks of `farside batch`. One that dies costs one try of one task."""

import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING

from foundation.one_line import one_line
from foundation.store import StoreError, WriteError
from node.commands.batch_task import TRIES, Event, Job, Record, Task, UnusableError
from probnerf.environment import prepare

if TYPE_CHECKING:
    from node.commands.batch_unit import Worker


@lru_cache(maxsize=1)
def worker_of(job: Job) -> "Worker":
    """The worker of this process.

    JAX gets one device in it, however many processes and cores there are: particles that are shared out over devices
    round differently, and results must not depend on who makes them.
    """
    os.environ["JAX_NUM_CPU_DEVICES"] = "1"
    prepare()
    from node.commands.batch_unit import Worker  # here, after JAX's variables are set

    return Worker(job)


def run_processes(
    job: Job, workers: int, tasks: Iterable[Task], then: Callable[[Task, Record], Iterable[Task]]
) -> Iterator[Event]:
    """A `Runner` with so many processes, each with a JAX of its own. They are killed when the iteration is left.

    A task whose process dies, or whose place does not answer, is tried three times. Raises `UnusableError`, and
    `WriteError` where a result finds no place thrice.
    """
    waiting, tries = deque(tasks), Counter[Task]()
    crew = list[_Process]()
    try:
        while waiting or any(each.task for each in crew):
            while waiting and (idle := _idle(crew, job, workers)) is not None:
                idle.give(waiting.popleft())
            for connection in wait([each.connection for each in crew if each.task]):
                each = next(each for each in crew if each.connection is connection)
                task, record, lost, unwritten = each.take()
                tries[task] += 1
                if unwritten and tries[task] == TRIES:
                    raise WriteError(lost)
                if not each.process.is_alive() and lost:
                    crew.remove(each)
                if record is not None:
                    waiting.extendleft(reversed(list(then(task, record))))  # while the log's frame is still at hand
                elif tries[task] < TRIES:
                    waiting.append(task)
                yield Event(task, record, lost, tries[task])
    finally:
        for each in crew:
            each.process.kill()
            each.process.join()
            each.connection.close()


def _idle(crew: "list[_Process]", job: Job, most: int) -> "_Process | None":
    """A process without a task, a new one if there may be more."""
    for each in crew:
        if each.task is None:
            return each
    if len(crew) < most:
        crew.append(_Process(job))
        return crew[-1]
    return None


class _Process:
    """A process and the task that it has."""

    def __init__(self, job: Job) -> None:
        context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, job), daemon=True)
        self.process.start()
        theirs.close()  # else its death would not end the connection
        self.task: Task | None = None

    def give(self, task: Task) -> None:
        """Have it do a task."""
        self.task = task
        with suppress(OSError):  # it is dead; `take` will say so
            self.connection.send(task)

    def take(self) -> tuple[Task, Record | None, str, bool]:
        """The task that ended, its record or how it was lost, and if unwritten. Raises `UnusableError`."""
        task, self.task = self.task, None
        assert task is not None
        try:
            kind, value = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            self.connection.close()
            code = self.process.exitcode or 0
            how = f"was ended by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"ended with code {code}"
            return task, None, f"process {self.process.pid} {how}", False
        if kind == "unusable":
            raise UnusableError(value)
        return (task, value, "", False) if kind == "record" else (task, None, value, kind == "unwritten")


def _serve(connection: Connection, job: Job) -> None:
    """A process: do the tasks that come until nobody is there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is the first process's, which ends the others
    while True:
        try:
            task = connection.recv()
        except (EOFError, OSError):
            return
        try:
            answer: tuple[str, Record | str] = "record", worker_of(job)(task)
        except UnusableError as error:
            answer = "unusable", str(error)
        except StoreError as error:
            answer = "unwritten" if isinstance(error, WriteError) else "lost", one_line(error)
        try:
            connection.send(answer)
        except OSError:  # the first process was killed; the record is written
            return
