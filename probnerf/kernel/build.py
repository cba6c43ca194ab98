"""Compile the kernel with the machine's C++ compiler: `python -m probnerf.kernel.build`. Without one, say so."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import jax

FOLDER = Path(__file__).resolve().parent
LIBRARY = FOLDER / "farside_kernel.so"
COMPILERS = ("c++", "g++", "clang++")
# Floats in a vector, points of a tile, and the compiler's options, by instruction set.
PLAIN: dict[str, tuple[int, int, list[str]]] = {"plain": (4, 64, [])}
X86: dict[str, tuple[int, int, list[str]]] = {
    "avx512": (16, 128, ["-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma", "-mprefer-vector-width=512"]),
    "avx2": (8, 64, ["-mavx2", "-mfma"]),
}


def compiler() -> str | None:
    """$CXX, or the first of the usual ones that is there."""
    return next((found for name in (os.environ.get("CXX"), *COMPILERS) if name and (found := shutil.which(name))), None)


def build() -> bool:
    """Write `LIBRARY`; False where there is no compiler, or where it fails (what it said goes to standard error)."""
    cxx = compiler()
    if cxx is None:
        print("no C++ compiler found: Farside runs on JAX alone, several times slower", file=sys.stderr)
        return False
    common = [cxx, "-std=c++17", "-O3", "-fPIC", "-fno-math-errno", "-isystem", jax.ffi.include_dir()]
    sets = PLAIN | (X86 if platform.machine() in ("x86_64", "AMD64") else {})
    runs, objects = [], []

    def compile_(source: str, name: str, options: list[str]) -> None:
        objects.append(LIBRARY.with_suffix(f".{name}.{source}.o"))
        runs.append([*common, *options, "-c", str(FOLDER / f"{source}.cc"), "-o", str(objects[-1])])

    for name, (lanes, tile, options) in sets.items():
        sizes = [f"-DFARSIDE_ISA={name}", f"-DFARSIDE_LANES={lanes}", f"-DFARSIDE_TILE={tile}"]
        for source in ("view", "points"):
            compile_(source, name, [*options, *sizes])
    compile_("binding", "all", [])
    started = [subprocess.Popen(run) for run in runs]
    failed = any([process.wait() for process in started])
    made = LIBRARY.with_suffix(".tmp")
    failed = failed or subprocess.run([cxx, "-shared", "-pthread", *map(str, objects), "-o", str(made)]).returncode != 0
    for path in objects:
        path.unlink(missing_ok=True)
    if failed:
        LIBRARY.unlink(missing_ok=True)  # an older one may not fit the Python beside it
        print(f"{cxx} could not build the kernel: Farside runs on JAX alone, several times slower", file=sys.stderr)
        return False
    os.replace(made, LIBRARY)
    return True


if __name__ == "__main__":
    build()
