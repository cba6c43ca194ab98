"""Compile the kernel with the machine's C++ compiler, once: `python -m probnerf.kernel.build`. Reports a missing
compiler.

The package contains the sources. The library is stored in the user's cache folder, under a digest of its sources,
options and versions. So a checkout, an installed package and several versions can coexist.
"""

import fcntl
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import jax

from probnerf.environment import cache_folder

SOURCES = Path(__file__).resolve().parent
COMPILERS = ("c++", "g++", "clang++")
OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-fno-math-errno")
# Floats in a vector, points of a tile, and the compiler's options, by instruction set.
PLAIN: dict[str, tuple[int, int, list[str]]] = {"plain": (4, 64, [])}
X86: dict[str, tuple[int, int, list[str]]] = {
    "avx512": (16, 128, ["-mavx512f", "-mavx512dq", "-mavx512vl", "-mavx512bw", "-mfma", "-mprefer-vector-width=512"]),
    "avx2": (8, 64, ["-mavx2", "-mfma"]),
}


def compiler() -> str | None:
    """$CXX, or the first of the usual compilers that is installed."""
    return next((found for name in (os.environ.get("CXX"), *COMPILERS) if name and (found := shutil.which(name))), None)


@cache
def library_path() -> Path:
    """The path of the built library."""
    digest = hashlib.sha256(repr((OPTIONS, PLAIN, X86, jax.__version__, platform.machine())).encode())
    for path in sorted([*SOURCES.glob("*.cc"), *SOURCES.glob("*.h")]):
        digest.update(path.name.encode() + path.read_bytes())
    return cache_folder() / f"kernel-{digest.hexdigest()[:16]}" / "farside_kernel.so"


def built_library() -> Path | None:
    """The library, built if it is missing; None if the build failed or there is no compiler.

    A failed build is not repeated until `failed.txt`, which holds the compiler's messages, is removed.
    """
    path = library_path()
    if path.is_file():
        return path
    failure = path.with_name("failed.txt")
    if failure.is_file() or (cxx := compiler()) is None:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.with_name("lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # processes that start together build it only once
            if not path.is_file() and not failure.is_file():
                print("farside: building the kernel, once; this takes some seconds", file=sys.stderr)
                if complaint := _build(cxx, path):
                    failure.write_text(complaint)
    except OSError as error:  # a full or read-only disk costs only speed
        print(f"farside: the kernel cannot be kept in {path.parent} ({error.strerror or error})", file=sys.stderr)
    return path if path.is_file() else None


def _build(cxx: str, path: Path) -> str:
    """Write the library. Returns the compiler's messages if it failed, else ""."""
    sets = PLAIN | (X86 if platform.machine() in ("x86_64", "AMD64") else {})
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        runs, objects = [], []

        def compile_(source: str, name: str, options: list[str]) -> None:
            objects.append(f"{scratch}/{name}.{source}.o")
            include = ["-isystem", jax.ffi.include_dir()]
            runs.append([cxx, *OPTIONS, *include, *options, "-c", str(SOURCES / f"{source}.cc"), "-o", objects[-1]])

        for name, (lanes, tile, options) in sets.items():
            sizes = [f"-DFARSIDE_ISA={name}", f"-DFARSIDE_LANES={lanes}", f"-DFARSIDE_TILE={tile}"]
            for source in ("view", "points"):
                compile_(source, name, [*options, *sizes])
        compile_("binding", "all", [])
        started = [subprocess.Popen(run, stderr=subprocess.PIPE, text=True) for run in runs]
        ended = [(process.communicate()[1], process.returncode) for process in started]
        complaint = "\n".join(errors or cxx for errors, code in ended if code != 0)
        if not complaint:
            link = [cxx, "-shared", "-pthread", *objects, "-o", f"{scratch}/linked.so"]
            linked = subprocess.run(link, capture_output=True, text=True)
            complaint = (linked.stderr or cxx) if linked.returncode != 0 else ""
        if not complaint:
            os.replace(f"{scratch}/linked.so", path)
    return complaint


def main() -> None:
    """Build, and print the library's path or what is missing."""
    library_path().with_name("failed.txt").unlink(missing_ok=True)
    if built_library() is not None:
        return
    failure = library_path().with_name("failed.txt")
    why = f"{compiler()} could not build the kernel ({failure})" if failure.is_file() else "no C++ compiler found"
    print(f"{why}: Farside runs on JAX alone, several times slower", file=sys.stderr)


if __name__ == "__main__":
    main()
