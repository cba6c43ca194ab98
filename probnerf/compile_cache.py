"""Programs that outlive the process: `jax.jit` whose compiled code is read back without tracing anything.

JAX's own cache of compiled code saves the compiler's time and not that of tracing and lowering, which here takes longer
than to read it. So a program is found by what it is made from, without making it: the function and this package's
source, its arguments' structure, shapes and static values, JAX's version and settings, and the processor. What that
does not tell apart (a local function, or another package's) is left to `jax.jit`, and so is everything on other devices
than CPUs, and where `FARSIDE_PROGRAMS` names no folder.

It stays for what it saves at a start: `farside bench startup` was 3.1 s with kept programs (gate: 5 s), 28 s with an
empty cache. Where JAX's own cache alone comes within 2 s of that, this module goes.
"""

import contextlib
import hashlib
import inspect
import os
import pickle  # of files that this module wrote, beside machine code that it runs
import platform
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, update_wrapper
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable

from foundation.whole_file import write_whole
from probnerf.kernel import library
from probnerf.kernel.build import library_path

F = TypeVar("F", bound=Callable[..., Any])

GENERATIONS = 3  # folders kept, of other versions and settings
_LOCK = threading.RLock()
_REHEARSING = ContextVar("rehearsing", default=False)


@contextmanager
def rehearsal() -> Iterator[None]:
    """A context in which kept programs are made ready for their arguments but not run: they return zeros."""
    token = _REHEARSING.set(True)
    try:
        yield
    finally:
        _REHEARSING.reset(token)


@cache
def _folder() -> Path | None:
    """The folder of kept programs, named by `FARSIDE_PROGRAMS`. None if it names none: nothing is kept."""
    named = os.environ.get("FARSIDE_PROGRAMS")
    if not named or jax.default_backend() != "cpu":
        return None
    own = Path(named) / f"programs-{_environment()}"
    try:
        own.mkdir(mode=0o700, parents=True, exist_ok=True)
        if own.stat().st_uid != os.getuid():  # its content is executed
            return None
        own.touch()
        generations = sorted(own.parent.glob("programs-*"), key=lambda f: f.stat().st_mtime, reverse=True)
    except OSError:  # as without: slower by some seconds
        return None
    for old in generations[GENERATIONS:]:
        shutil.rmtree(old, ignore_errors=True)
    return own


class Program:
    """A function as `jax.jit` compiles it, except for the origin of its compiled code."""

    def __init__(
        self, function: Callable[..., Any], static_argnames: tuple[str, ...] = (), rehearse: bool = True
    ) -> None:
        update_wrapper(self, function)
        self._name = (function.__module__, function.__qualname__)
        self.jitted = jax.jit(function, static_argnames=static_argnames)
        self._static = static_argnames
        self._rehearse = rehearse
        self._signature = inspect.signature(function)
        self._ready: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function."""
        if _folder() is None:
            return self.jitted(*args, **kwargs)
        arguments = self._signature.bind(*args, **kwargs).arguments
        static = {name: arguments.pop(name) for name in self._static if name in arguments}
        leaves, tree = jax.tree.flatten(arguments)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.jitted(*args, **kwargs)
        key = (tree, tuple(map(_kind, leaves)), tuple(static.items()))
        if key not in self._ready:
            with _LOCK:
                if key not in self._ready:
                    self._ready[key] = self._found(arguments, static, key)
        run = self._ready[key]
        if self._rehearse and _REHEARSING.get() and isinstance(run, jax.stages.Compiled):
            return jax.tree.map(lambda a: jax.device_put(np.zeros(a.shape, a.dtype), a.sharding), run.out_info)
        return run(**arguments)

    def _found(self, arguments: dict[str, Any], static: dict[str, Any], key: tuple) -> Callable[..., Any]:
        """The program for these arguments: from its file, or compiled and kept there."""
        content = " ".join((*self._name, str(key[0]), str(key[1]), _told(static)))
        folder = _folder()
        if " at 0x" in content or folder is None:  # an object whose text does not identify it
            return lambda **arguments: self.jitted(**arguments, **static)
        path = folder / f"{self._name[1]}-{hashlib.sha256(content.encode()).hexdigest()[:32]}"
        try:
            return _read(path, arguments)
        except Exception:  # not there, cut short, or of a library that reads it otherwise: made, and written over
            pass
        compiled = _compiled(self.jitted.lower(**arguments, **static))
        _write(path, compiled)
        return compiled


def program(*static_argnames: str, rehearse: bool = True) -> Callable[[F], F]:
    """Decorator: compiled once for each set of shapes and of static arguments, which have these names.

    Without `rehearse` it is run in a rehearsal, too: what others are compiled for hangs on its values.
    """

    def decorate(function: F) -> F:
        return cast(F, Program(function, static_argnames, rehearse))

    return decorate


def _compiled(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiled, and past JAX's own cache: what that hands back cannot be written once more."""
    least = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", float("inf"))  # not written there,
    try:
        # and nothing read: an option at its default is part of the name under which JAX would look
        return lowered.compile(compiler_options={"xla_embed_ir_in_executable": False})
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def _write(path: Path, compiled: jax.stages.Compiled) -> None:
    try:
        code, _, out_tree = serialize_executable.serialize(compiled)
    except (ValueError, NotImplementedError, jax.errors.JaxRuntimeError):
        # it closes over arrays, or XLA does not write it a second time: compiled anew in each process
        return
    devices = {d.id for s in jax.tree.leaves(compiled.input_shardings) for d in s.device_set}
    # the tree as an object: equinox's marks of absent fields do not survive in a pickled treedef
    answer = jax.tree.unflatten(out_tree, range(out_tree.num_leaves))
    with contextlib.suppress(OSError):  # a full disk only makes the next start slower
        write_whole(path, pickle.dumps((code, sorted(devices), answer)))


def _read(path: Path, arguments: dict[str, Any]) -> Callable[..., Any]:
    _with_lapack()
    code, devices, answer = pickle.loads(path.read_bytes())
    return serialize_executable.deserialize_and_load(
        code,
        jax.tree.structure(((), arguments)),
        jax.tree.structure(answer),
        execution_devices=[d for d in jax.devices() if d.id in devices],
    )


@cache
def _with_lapack() -> None:
    """Have JAX look up LAPACK's functions, as it does when it lowers the first call of one; without, code crashes."""
    jnp.linalg.cholesky(jnp.ones((1, 1)))


def _kind(leaf: Any) -> tuple:
    """Shape and type of an argument, and where it lies unless on the first device."""
    sharding = getattr(leaf, "sharding", None)
    spread = sharding is not None and len(sharding.device_set) > 1
    return (jax.api_util.shaped_abstractify(leaf), *((sharding,) if spread else ()))


def _told(static: Mapping[str, Any]) -> str:
    """Static arguments as text: functions of this package by name, since the digest covers their source."""
    return repr({
        name: f"{v.__module__}.{v.__qualname__}" if _is_plain(v) else v for name, v in sorted(static.items())
    })  # fmt: skip


def _is_plain(value: Any) -> bool:
    ours = inspect.isfunction(value) and value.__module__.startswith("probnerf.")
    return ours and "<" not in value.__qualname__ and value.__closure__ is None


@cache
def _environment() -> str:
    """A digest of everything that changes the program of a function and its arguments."""
    package = Path(__file__).parent
    source = hashlib.sha256()
    for path in [*sorted(package.rglob("*.py")), library_path()]:
        source.update(path.read_bytes() if path.is_file() else b"none")
    settings = sorted((k, repr(v)) for k, v in jax.config.values.items() if "cache" not in k)
    switches = sorted((k, v) for k, v in os.environ.items() if k.startswith(("XLA_", "FARSIDE_KERNEL")))
    libraries = [version(name) for name in ("jax", "jaxlib", "equinox", "optax", "numpy")]
    machine = [platform.machine(), _processor(), os.cpu_count(), str(jax.devices()), library.available()]
    content = repr((source.hexdigest(), settings, switches, libraries, sys.version, machine))
    return hashlib.sha256(content.encode()).hexdigest()[:16]


def _processor() -> str:
    """The processor's instruction sets, or its name."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
