"""What a row was measured with: the revision of the code, the processor, and its speed beside the measurement."""

import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

ROOT = Path(__file__).resolve().parent.parent.parent
SIDE = 4096  # of the matrices whose product is the machine's peak


def median_seconds(runs: Mapping[str, tuple[Callable, Array]], repeats: int) -> dict[str, float]:
    """Median seconds of each run, one after the other in every round; a first round compiles and is not counted."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(-1, repeats):
        for name, (function, given) in runs.items():
            begun = time.perf_counter()
            jax.block_until_ready(function(given))
            if repeat >= 0:
                taken[name].append(time.perf_counter() - begun)
    return {name: float(np.median(values)) for name, values in taken.items()}


def matrix_speed(side: int = SIDE, repeats: int = 3) -> float:
    """GFLOP/s of the machine's single-precision matrix product, median."""
    matrix = jnp.ones((side, side), jnp.float32)
    return 2e-9 * side**3 / median_seconds({"matrix product": (squared, matrix)}, repeats)["matrix product"]


@jax.jit
def squared(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The matrix product that speeds are compared with."""
    return matrix @ matrix


@cache
def revision() -> str:
    """The short hash of the checkout's commit, with "+" where files were changed since; "" without git."""
    try:
        head = _git("rev-parse", "--short", "HEAD")
        return head + "+" * bool(_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@cache
def machine() -> str:
    """The processor, the number of its cores in use, and the speed of its matrix product when this was first asked."""
    speed = float(f"{matrix_speed(1024):.2g}")
    return f"{processor()}, {os.cpu_count()} cores, {speed:g} GFLOP/s"


def processor() -> str:
    """The processor's name as the operating system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())
