"""Tests run JAX on the CPU, reuse programs compiled by earlier runs, and read recorded data where there is some."""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import farside

ROOT = Path(__file__).resolve().parent.parent

# Set before anything imports jax, which reads them once; they reach the processes that tests start, too.
os.environ["JAX_PLATFORMS"] = "cpu"
# Importing JAX sets it to 1 for all that tests start; jaxlib 0.10.1 then says 200 KB of its own kept programs.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
signal.signal(
    signal.SIGINT, signal.default_int_handler
)  # run in the background, children would inherit its being ignored
os.environ.setdefault("DEPTHAI_LEVEL", "error")  # its warning about a missing USB bus
os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # its handlers end the process; Python raises

farside.prepare = lambda: None  # what it sets would reach all tests of this process


def pytest_configure(config: pytest.Config) -> None:
    """The default tests compile more than they compute: they optimise little. Slow ones run the code that users run."""
    if config.option.markexpr == "not slow and not nightly":
        quick = (
            "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1 "
            "--xla_cpu_parallel_codegen_split_count=1"  # small programs: to split one takes longer than to compile it
        )
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {quick}".strip()
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # level 0, but for the fixture `optimised`


@pytest.fixture
def optimised() -> Iterator[None]:
    """For a default test that computes for longer than it compiles, or that compares roundings."""
    import jax  # not before its settings are made

    name = "jax_disable_most_optimizations"
    before = jax.config.values[name]
    jax.config.update(name, False)
    yield
    jax.config.update(name, before)


MOST_MAPPINGS = 25_000  # of memory, of a process; Linux refuses more than 65,530, and XLA then aborts


@pytest.fixture(scope="module", autouse=True)
def _few_programs() -> Iterator[None]:
    """Drop compiled programs, each a dozen mappings of memory, before a long run of tests holds too many of them."""
    yield
    mappings = Path("/proc/self/maps")
    if "jax" in sys.modules and mappings.exists() and len(mappings.read_bytes().splitlines()) > MOST_MAPPINGS:
        sys.modules["jax"].clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded data beside the checkout; what needs it is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no recorded data: ../shared/data is not beside this checkout")
    return folder


def pytest_collection_finish() -> None:
    """Python need not look for garbage in what was imported, nor through all that lives at every tenth look."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A slow test may take a quarter of an hour: where nothing is compiled yet, or beside other work."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(900))
