"""Tests run JAX on the CPU, reuse programs compiled by earlier runs, and read recorded data where there is some."""

import os
import signal
from pathlib import Path

import pytest

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


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of recorded data beside the checkout; what needs it is skipped where it is absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no recorded data: ../shared/data is not beside this checkout")
    return folder


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A slow test may take a quarter of an hour: where nothing is compiled yet, or beside other work."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(900))
