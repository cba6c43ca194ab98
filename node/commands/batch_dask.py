"""`farside batch --dask`: the tasks on the workers of a Dask cluster. Needs the extra `farside[cluster]`."""

import hashlib
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed

from foundation.one_line import one_line
from foundation.store import StoreError, WriteError
from node.commands.batch_task import TRIES, Event, Job, Record, Task
from node.commands.batch_workers import worker_of

_CONNECT_S = 10
_LOOK_S = 10.0  # between two looks at which workers are there


def do(job: Job, task: Task) -> Record:
    """A task on the worker that this runs on. Raises as `batch_unit.Worker`."""
    return worker_of(job)(task)


def run_dask(
    job: Job,
    address: str,
    workers: int,
    say: Callable[[str], None],
    tasks: Iterable[Task],
    then: Callable[[Task, Record], Iterable[Task]],
) -> Iterator[Event]:
    """A `Runner` on the cluster of the scheduler at `address`, or on a `local` one of so many processes.

    Dask gives the tasks of a lost worker to others, and gives a task up after three (its `allowed-failures`, of a
    scheduler that runs already). `say` gets the dashboard's address. Raises `UnusableError`, `WriteError` where a
    result finds no place thrice, and `ValueError` where no scheduler answers.
    """
    with dask.config.set({"distributed.scheduler.allowed-failures": TRIES - 1}), _client(address, workers) as client:
        here, looked = _workers(client), time.monotonic()
        say(f"{len(here)} workers; {_dashboard(client)}")

        # a scheduler takes equal keys for the same task, and may have other runs
        run = hashlib.blake2b(f"{job.out} {job.settings}".encode(), digest_size=8).hexdigest()

        def submitted(new: Iterable[Task], priority: int) -> dict[Future, Task]:
            how = {"pure": False, "retries": TRIES - 1, "priority": priority}
            return {client.submit(do, job, task, key=f"farside-{run}/{task.name}", **how): task for task in new}

        waiting = submitted(tasks, 0)
        ended = as_completed(waiting)
        for future in ended:
            task = waiting.pop(future)
            if time.monotonic() > looked + _LOOK_S or not waiting:
                now, looked = _workers(client), time.monotonic()
                for name in sorted(here - now):
                    yield Event(None, None, f"worker {name}; what it had went to others")
                here = now
            try:
                record = future.result()
            except KilledWorker as error:
                yield Event(task, None, f"worker {error.last_worker.address} died with it", TRIES)
            except WriteError:
                raise
            except StoreError as error:
                yield Event(task, None, one_line(error), TRIES)
            except Exception as error:  # a worker with another Farside, or a scheduler that went away
                yield Event(task, None, f"{type(error).__name__}: {one_line(error)[:300]}", TRIES)
            else:
                new = submitted(then(task, record), 1)  # units before further logs: the log's frame is still at hand
                waiting |= new
                ended.update(new)
                yield Event(task, record)


@contextmanager
def _client(address: str, workers: int) -> Iterator[Client]:
    if address == "local":
        quiet = {"dashboard_address": "127.0.0.1:0", "silence_logs": 50}
        with (
            LocalCluster(n_workers=workers, threads_per_worker=1, host="127.0.0.1", **quiet) as own,
            Client(own) as client,
        ):
            yield client
        return
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError) as error:
        remedy = "start one with `dask scheduler`, or give `local`"
        raise ValueError(f"no Dask scheduler answers at {address} ({one_line(error)}); {remedy}") from None
    with client:
        yield client


def _workers(client: Client) -> set[str]:
    return set(client.scheduler_info(n_workers=-1)["workers"])


def _dashboard(client: Client) -> str:
    if find_spec("bokeh") is None:
        return "install bokeh for a dashboard"
    return f"dashboard {client.dashboard_link}"
