"""All processes of a pool have one thread and no accelerator, and the caller's environment stays as it was."""

import os
import time

from foundation.worker_pool import worker_pool


def _told(_: int) -> tuple[int, str | None, str | None]:
    time.sleep(0.3)  # so that every process has one
    return os.getpid(), os.environ.get("JAX_PLATFORMS"), os.environ.get("OMP_NUM_THREADS")


def test_every_process_has_the_environment(monkeypatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    with worker_pool(3) as pool:
        assert os.environ["OMP_NUM_THREADS"] == "7" and "JAX_PLATFORMS" not in os.environ
        told = list(pool.map(_told, range(6)))
    assert len({pid for pid, _, _ in told}) == 3
    assert {(platform, threads) for _, platform, threads in told} == {("cpu", "1")}
