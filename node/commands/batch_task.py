"""What `farside batch` divides its work into, and where each part's result goes. Imports nothing heavy."""

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from node.commands.batch_options import BatchConfig

TRIES = 3  # of a task whose worker dies or cannot write
Record = dict[str, Any]  # a task's result, as its JSON file holds it


class UnusableError(ValueError):
    """Nothing can be inferred at all, in one line: the prior cannot be read."""


@dataclass(frozen=True)
class Task:
    """A log whose objects are to be found; with an object and a seed, one unit: one of its objects to be inferred."""

    log: str  # absolute path, or URL
    object_id: int | None = None
    seed: int | None = None
    frame: str = ""  # digest of the frame that the object was found in

    def __str__(self) -> str:
        unit = "" if self.object_id is None else f" object {self.object_id} seed {self.seed}"
        return f"{PurePosixPath(self.log).name}{unit}"

    @property
    def name(self) -> str:
        """The result's file without its suffix; the log's folder holds a digest of where the log is."""
        stem = re.sub(r"[^\w.-]+", "_", PurePosixPath(self.log).name)[:80]
        folder = f"logs/{stem}-{hashlib.blake2b(self.log.encode(), digest_size=4).hexdigest()}"
        return f"{folder}/log" if self.object_id is None else f"{folder}/seed_{self.seed}/object_{self.object_id}"

    @property
    def done(self) -> str:
        """The file of its record. It is written last."""
        return f"{self.name}.json"

    @property
    def failed(self) -> str:
        """The file of its record where it has no result."""
        return f"{self.name}.failed.json"


@dataclass(frozen=True)
class Job:
    """What all tasks of a run share. Paths are absolute."""

    config: BatchConfig
    out: str
    settings: str  # digest of all that results depend on but their log, object and seed
    infer: Callable[..., Any] | None = None  # in place of `perception.inference.controller.estimate`; a module's own

    def failure(self, task: Task, error: str) -> Record:
        """The record of a task that has no result."""
        return {
            "settings": self.settings,
            "log": task.log,
            "object": task.object_id,
            "seed": task.seed,
            "result": "failed",
            "error": error,
        }


@dataclass(frozen=True)
class Event:
    """A task has ended, with its record; or, without one, was lost with its worker, and is tried again or given up.

    Without a task, a worker was lost, and what it had goes to others.
    """

    task: Task | None
    record: Record | None
    lost: str = ""  # which worker, and how
    tries: int = 1


# Does tasks, and those that follow from their records (without any for a failure), and tells of them as they end.
Runner = Callable[[Iterable[Task], Callable[[Task, Record], Iterable[Task]]], Iterator[Event]]
