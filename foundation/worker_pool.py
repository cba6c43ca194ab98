"""Processes of one thread each, for work that is many independent jobs."""

import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import contextmanager

_ONE_THREAD = {  # of each process; and none of them takes an accelerator's memory
    "JAX_PLATFORMS": "cpu",
    "OMP_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


@contextmanager
def worker_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of so many processes. Jobs that have not begun are dropped where the block ends by an error."""
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        before = {name: os.environ.get(name) for name in _ONE_THREAD}
        os.environ.update(_ONE_THREAD)
        try:  # a process is started with each job that finds none idle: all of them now, with this environment
            wait([pool.submit(time.sleep, 0.5) for _ in range(processes)])
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
