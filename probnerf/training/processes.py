"""One training run by several processes (`jax.distributed`): each computes a share of a batch; gradients are averaged.

Every process draws the whole batch of a step, which takes milliseconds, and gives its devices their rows. So a run does
not depend on the number of processes, but for roundings, and can go on with another number. None can make a step
without the others: if one is lost, all end.
"""

import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from foundation.one_line import one_line

KNOWN_S = 60  # in which the name of process 0's machine must be known
LOST_S = 60  # without a sign of life, after which a process is lost
_AGAIN = "start all processes again with the same options: they go on from the last checkpoint"
_WHOLE, _SPLIT = PartitionSpec(), PartitionSpec("objects")
T = TypeVar("T", bound=PyTree)


@contextmanager
def joined(coordinator: str, processes: int | None, process: int | None, lost_s: int = LOST_S) -> Iterator[Mesh]:
    """All devices of all processes, on one axis, "objects". To be entered before JAX computes anything.

    `coordinator` is HOST:PORT of process 0, or "auto" under Slurm and Open MPI, which tell all three. Raises ValueError
    where nothing knows that host, ConnectionError, one line, where another process breaks off. Where one does not come
    within 5 minutes, says nothing for `lost_s` seconds, or was the first one, JAX may abort this process from within,
    with a trace of its own; a shell that waits beside it then prints the line.
    """
    where = None if coordinator == "auto" else coordinator
    if where is not None:
        _known(where.rpartition(":")[0])
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.config.update("jax_num_cpu_devices", 1)  # of a process; its threads share the work
    line = f"farside: error: this process was aborted, as all are where one does not come or is lost; {_AGAIN}"
    shell = ("sh", "-c", 'read -r orderly || echo "$0" >&2', line)
    with subprocess.Popen(shell, stdin=subprocess.PIPE, start_new_session=True) as watcher:
        try:
            jax.distributed.initialize(where, processes, process, heartbeat_timeout_seconds=lost_s)
            multihost_utils.sync_global_devices("joined")  # makes gloo's connections, for which it waits 30 s alone
            yield Mesh(np.array(jax.devices()), ("objects",))
            jax.distributed.shutdown()  # waits for the others
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if not isinstance(error, jax.errors.JaxRuntimeError) and "Gloo" not in str(error):
                if jax.distributed.is_initialized():
                    raise  # wrong input
                what = one_line(error).rstrip(".")
                raise ValueError(f"--coordinator auto found no cluster ({what}); give HOST:PORT") from error
            raise ConnectionError(f"a process is lost, or failed ({one_line(error)[:200]}); {_AGAIN}") from error
        finally:
            watcher.communicate(b"orderly\n")


def _known(host: str) -> None:
    """Wait until the host's name is known: a cluster may learn it when that process has begun. JAX would wait forever.

    Raises ValueError after `KNOWN_S`.
    """
    end = time.monotonic() + KNOWN_S
    while True:
        try:
            socket.getaddrinfo(host.strip("[]"), None)
            return
        except (OSError, UnicodeError) as error:
            if time.monotonic() > end:
                raise ValueError(
                    f"--coordinator: {host} is no known host ({one_line(error)}); give process 0's"
                ) from None
        time.sleep(1.0)


def is_first() -> bool:
    """Whether this process reads and writes the run's folder; a process alone is the first."""
    return jax.process_index() == 0


def everywhere(state: T, mesh: Mesh | None) -> T:
    """The first process's state, on all devices."""
    if mesh is None:
        return state
    return _placed(multihost_utils.broadcast_one_to_all(state), NamedSharding(mesh, _WHOLE))


def shares(batch: T, mesh: Mesh | None) -> T:
    """A batch that all processes have drawn alike, each device's rows on it.

    Raises ValueError if the devices cannot share it evenly.
    """
    if mesh is None:
        return batch
    for size in {len(a) for a in jax.tree.leaves(batch)}:
        if size % mesh.size:
            raise ValueError(f"{mesh.size} devices cannot share {size} objects of a batch; give a multiple")
    return _placed(batch, NamedSharding(mesh, _SPLIT))


def _placed(tree: T, sharding: NamedSharding) -> T:
    def placed(a: np.ndarray) -> Array:
        return jax.make_array_from_callback(a.shape, sharding, lambda rows: a[rows])

    return jax.tree.map(placed, tree)


def share_by_share(function: Callable[..., Array], mesh: Mesh | None) -> Callable[..., Array]:
    """A function of arrays with a leading object axis, of which each device computes its share, as it would alone.

    For what XLA would not divide by itself: loops over objects, and the kernel.
    """
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=_SPLIT, out_specs=_SPLIT, check_vma=False)
