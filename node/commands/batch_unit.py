"""The work of `farside batch` in one process: a log's objects, one object's hypotheses, and their records."""

import hashlib
import io
import json
import math
import threading
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console

from foundation.one_line import one_line
from foundation.store import Store, StoreError, bytes_of, local_copy
from node.commands.batch_task import Job, Record, Task, UnusableError
from node.commands.frame import read_frame, segments_of
from perception.answers.hypotheses_file import content_of
from perception.answers.summary import size
from perception.inference.controller import estimate
from perception.inference.schedule import digest
from perception.observation.segmentation import Segments
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.types import StopReason


@dataclass(frozen=True, eq=False)
class _View:
    log: str
    frame: Frame
    digest: str  # of the frame
    segments: Segments
    notes: tuple[str, ...]


class Worker:
    """Does one task after the other; the prior and the latest log's frame stay for the next one."""

    def __init__(self, job: Job) -> None:
        self._job, self._store = job, Store(job.out)
        self._prior: Prior | None = None
        self._view: _View | None = None
        self._alone = threading.Lock()  # a Dask worker may have several threads

    def __call__(self, task: Task) -> Record:
        """Do a task and write its record: its result, or why it has none.

        Raises `StoreError` where a place does not take or give files, which may be over at the next try, and
        `UnusableError` where the prior cannot be read.
        """
        with self._alone:
            try:
                record = self._log(task) if task.object_id is None else self._unit(task)
            except (StoreError, UnusableError):
                raise
            except MemoryError:
                record = self._job.failure(task, "not enough memory")
            except (ValueError, OSError, FloatingPointError) as error:
                record = self._job.failure(task, one_line(error))
            except Exception as error:  # a fault of this program, or input that no reader expected
                record = self._job.failure(task, f"{type(error).__name__}: {one_line(error)[:300]}")
            write_record(self._store, task, record)
            return record

    def _log(self, task: Task) -> Record:
        view = self._seen(task.log)
        return {
            "settings": self._job.settings,
            "log": task.log,
            "bytes": bytes_of([task.log])[task.log],
            "frame": view.digest,
            "stamp_ns": int(view.frame.stamp_ns),
            "objects": [found.id for found in view.segments],
            "left_out": [{"object": it.id, "reason": it.reason} for it in view.segments.left_out],
            "notes": list(view.notes),
        }

    def _unit(self, task: Task) -> Record:
        config, view = self._job.config, self._seen(task.log)
        assert task.seed is not None
        if view.digest != task.frame:
            raise ValueError(f"{task.log} has another frame than when its objects were found; give another --out")
        if self._prior is None:
            try:
                self._prior = load_prior(config.prior)
            except (ValueError, OSError) as error:
                raise UnusableError(one_line(error)) from None
        found = next(found for found in view.segments if found.id == task.object_id)
        estimated = (self._job.infer or estimate)(
            view.frame, found, self._prior, config.inference,
            seed=task.seed, budget_s=config.budget, stages=config.stages,
        )  # fmt: skip
        h = estimated.hypotheses
        if h.result == StopReason.INTERRUPTED:
            raise KeyboardInterrupt
        content = content_of(h)
        self._store.write(f"{task.name}.npz", content)
        return {
            "settings": self._job.settings,
            "log": task.log,
            "frame": task.frame,
            "stamp_ns": int(h.stamp_ns),
            "object": h.object_id,
            "label": h.label,
            "seed": h.seed,
            "result": str(h.result),
            "kinds": {name: _number(p) for name, p in h.kinds.items()},
            "size_m": [round(float(length), 6) for length in size(h)],
            "out_of_model": bool(h.out_of_model),
            "explained": _number(h.diagnostics.explained),
            "expected_loss": _number(h.diagnostics.expected_loss),
            "r_hat": _number(h.diagnostics.r_hat),
            "stage": int(h.stage),
            "digest": digest(h),
            "bytes": len(content),
            "seconds": float(estimated.seconds),
        }

    def _seen(self, log: str) -> _View:
        """The log's frame and objects. Raises `ValueError` naming the log, and `StoreError`."""
        if self._view is not None and self._view.log == log:
            return self._view
        err = Console(file=io.StringIO(), markup=False, emoji=False)
        with local_copy(log) as path:
            options = replace(self._job.config, source=path)
            try:
                frame = read_frame(options, err)
                segments = segments_of(options, frame, err)
            except (ValueError, OSError) as error:
                raise ValueError(one_line(error).replace(str(path), log)) from None
        text = err.file.getvalue().replace(str(path), log)  # type: ignore[attr-defined]
        self._view = _View(log, frame, _digest(frame), segments, tuple(text.splitlines()))
        return self._view


def write_record(store: Store, task: Task, record: Record) -> None:
    """Write a task's record, whole or not at all. Raises `StoreError`."""
    name = task.failed if record.get("result") == "failed" else task.done
    store.write(name, (json.dumps(record, sort_keys=True, allow_nan=False) + "\n").encode())


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _digest(frame: Frame) -> str:
    """16 hexadecimal digits that identify what is inferred from."""
    state = hashlib.blake2b(digest_size=8)
    for array in (frame.rgb, frame.depth, frame.label, frame.camera.K, frame.camera.distortion, frame.T_world_camera):
        state.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return state.hexdigest()
