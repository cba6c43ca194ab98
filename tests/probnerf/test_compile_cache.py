"""Kept programs answer as `jax.jit` does, without tracing anything, and are made again where they cannot be read."""

import os
import subprocess
import sys
from pathlib import Path
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf import compile_cache
from probnerf.compile_cache import Program
from probnerf.fields.cylinder import CylinderModel
from probnerf.inference import likelihood_of, likelihood_settings
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.objects.cylinder_scenes import draw_pixels, grid_of_rays
from probnerf.sampling import tempered_smc
from probnerf.settings import InferConfig, TemperedSMCConfig

ROOT = Path(__file__).parents[2]
TRACED: list[Any] = []


def _scaled(x: jax.Array, by: float = 2.0, *, times: int = 1, how: Any = None) -> dict[str, jax.Array]:
    TRACED.append(x)
    return {"sum": jnp.sum(x * by), "factor": jnp.linalg.cholesky(jnp.eye(3) * times)}


def made() -> Program:
    """A program of which JAX knows nothing yet."""
    function = FunctionType(_scaled.__code__, globals(), _scaled.__name__, _scaled.__defaults__)
    function.__kwdefaults__ = _scaled.__kwdefaults__
    return Program(function, ("times", "how"))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compile_cache, "_folder", lambda: tmp_path)
    TRACED.clear()
    return tmp_path


def test_a_program_is_read_back_without_tracing(folder: Path) -> None:
    x = np.arange(4.0, dtype=np.float32)
    first = made()(x, times=4)
    assert len(TRACED) == 1 and len(list(folder.iterdir())) == 1
    program = made()
    again = program(jnp.asarray(x), times=4)
    assert len(TRACED) == 1
    assert float(again["sum"]) == float(first["sum"]) == 12.0
    np.testing.assert_array_equal(again["factor"], 2.0 * np.eye(3))
    assert float(program(x + 1.0, times=4)["sum"]) == 20.0 and len(TRACED) == 1


def test_a_rehearsal_reads_a_program_and_does_not_run_it(folder: Path) -> None:
    x = np.arange(4.0, dtype=np.float32)
    made()(x, times=4)
    program = made()
    with compile_cache.rehearsal():
        blank = program(x, times=4)
    assert {k: (v.shape, v.dtype) for k, v in blank.items()} == {"sum": ((), x.dtype), "factor": ((3, 3), x.dtype)}
    assert float(blank["sum"]) == 0.0 and isinstance(blank["factor"], jax.Array)
    for kept in folder.iterdir():
        kept.unlink()  # it is not read again
    assert float(program(x, times=4)["sum"]) == 12.0 and len(TRACED) == 1
    with compile_cache.rehearsal():  # what is not kept is run
        assert float(made()(x, how=lambda: 0)["sum"]) == 12.0


@pytest.mark.parametrize(
    ("args", "static"),
    [
        ((np.zeros(5, np.float32),), {"times": 4}),
        ((np.zeros(4, np.int32),), {"times": 4}),
        ((np.zeros(4, np.float32), 3.0), {"times": 4}),
        ((np.zeros(4, np.float32),), {"times": 5}),
        ((np.zeros(4, np.float32),), {"times": 4, "how": tempered_smc.tempered_smc}),
    ],
)
def test_another_shape_kind_or_static_argument_is_another_program(folder: Path, args: tuple, static: dict) -> None:
    made()(np.zeros(4, np.float32), times=4)
    answer = made()(*args, **static)
    assert len(TRACED) == 2 and len(list(folder.iterdir())) == 2
    np.testing.assert_allclose(answer["factor"], np.sqrt(static["times"]) * np.eye(3), rtol=1e-6)


def test_a_file_that_cannot_be_read_is_made_again(folder: Path) -> None:
    x = np.ones(4, np.float32)
    made()(x)
    (kept,) = folder.iterdir()
    whole = kept.read_bytes()
    for spoilt in (b"", whole[: len(whole) // 2], b"no program at all"):
        kept.write_bytes(spoilt)
        assert float(made()(x)["sum"]) == 8.0
        assert len(kept.read_bytes()) > len(whole) // 2
    assert len(TRACED) == 4


@pytest.mark.parametrize("error", [ValueError, NotImplementedError, jax.errors.JaxRuntimeError])
def test_what_cannot_be_written_is_run_all_the_same(
    error: type[Exception], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Any) -> None:
        raise error("UNIMPLEMENTED: `LessThan` is not serializable.")

    monkeypatch.setattr(compile_cache.serialize_executable, "serialize", refuse)
    assert float(made()(np.ones(4, np.float32))["sum"]) == 8.0
    assert not list(folder.iterdir())


def test_what_its_name_does_not_tell_is_left_to_jit(folder: Path) -> None:
    """Two local functions of one name are two programs."""
    for value in (1, 2):
        answer = made()(np.ones(4, np.float32), times=value, how=lambda value=value: value)
        np.testing.assert_allclose(answer["factor"], np.sqrt(value) * np.eye(3), rtol=1e-6)
    assert not list(folder.iterdir())


def test_inside_another_program_it_is_traced(folder: Path) -> None:
    program = made()
    assert float(jax.grad(lambda x: program(x)["sum"])(jnp.ones(4))[0]) == 2.0
    assert float(jax.jit(lambda x: program(x)["sum"])(jnp.ones(4))) == 8.0
    assert not list(folder.iterdir())


def test_settings_that_make_other_code_make_another_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = compile_cache._environment.__wrapped__
    told = environment()
    assert environment() == told
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    other = environment()
    monkeypatch.setattr(compile_cache, "_processor", lambda: "another")
    assert len({told, other, environment()}) == 3


def test_no_folder_or_one_that_cannot_be_made_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = compile_cache._folder.__wrapped__
    monkeypatch.delenv("FARSIDE_PROGRAMS", raising=False)
    assert folder() is None
    (tmp_path / "file").touch()
    monkeypatch.setenv("FARSIDE_PROGRAMS", str(tmp_path / "file"))
    assert folder() is None
    for k in range(5):
        (tmp_path / f"programs-{k}").mkdir()
        os.utime(tmp_path / f"programs-{k}", (k, k))
    monkeypatch.setenv("FARSIDE_PROGRAMS", str(tmp_path))
    own = folder()
    kept = sorted(p.name for p in tmp_path.glob("programs-*"))
    assert own is not None and kept == sorted([own.name, "programs-3", "programs-4"])
    assert own.stat().st_mode & 0o077 == 0
    monkeypatch.setattr(os, "getuid", lambda: own.stat().st_uid + 1)
    assert folder() is None  # another's


@pytest.mark.slow
def test_the_sampler_answers_bit_for_bit_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, settings = CylinderModel(), InferConfig(lattice=12)
    drawn, key = likelihood_settings(settings), jax.random.key(0)
    truth = jax.random.normal(key, (drawn.dim(model),))
    rays = grid_of_rays(4, 3, elevation=30.0)
    observation = draw_pixels(
        key, model, drawn, truth, rays, jnp.ones(12, bool), jnp.asarray(True), pose_sigma=jnp.full(5, 0.05)
    )
    likelihood = likelihood_of(settings, observation)
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    config = TemperedSMCConfig(populations=2, particles=8, start_particles=16, moves=2, final_stages=1, keep=1)

    def sampled() -> np.ndarray:
        return np.asarray(tempered_smc.tempered_smc(key, log_likelihood, args, truth.size, config, stages=4).positions)

    plain = sampled()
    monkeypatch.setattr(compile_cache, "_folder", lambda: tmp_path)
    own: tuple[Any, ...] = (tempered_smc._start, tempered_smc._stage, tempered_smc._prior_start)
    for program in own:
        monkeypatch.setattr(program, "_ready", {})
    written = sampled()
    names = {path.name.split("-")[0] for path in tmp_path.iterdir()}
    assert names == {"_start", "_stage", "_prior_start"}
    for program in own:
        monkeypatch.setattr(program, "_ready", {})
        monkeypatch.setattr(program, "jitted", None)
    read = sampled()
    np.testing.assert_array_equal(written, plain)
    np.testing.assert_array_equal(read, plain)


PROCESS = """
import sys
import jax, jax.numpy as jnp
from probnerf.compile_cache import Program

def whitened(x):
    if sys.argv[1] == "read":
        raise RuntimeError("traced")
    return jnp.linalg.cholesky(jnp.cov(x) + jnp.eye(3)) @ x

program = jax.jit(whitened) if sys.argv[1] == "jit" else Program(whitened)
print(float(program(jnp.arange(12.0).reshape(3, 4)).sum()))
"""


@pytest.mark.slow
def test_from_process_to_process_past_the_cache_of_jax(tmp_path: Path) -> None:
    """What JAX's cache hands back would be written without its code; and a linear algebra library is looked up."""
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "FARSIDE_PROGRAMS": str(tmp_path),
    }
    said = []
    for how in ("jit", "jit", "write", "read"):
        run = [sys.executable, "-c", PROCESS, how]
        ended = subprocess.run(run, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
        assert ended.returncode == 0, ended.stderr
        said.append(ended.stdout)
    assert len(set(said)) == 1
