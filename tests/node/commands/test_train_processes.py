"""`farside train` in two processes: the run of one process, whoever is killed on the way."""

import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import pytest

from node.commands.training_options import Training
from probnerf.prior.checkpoint import load_prior
from probnerf.training import processes

ROOT = Path(__file__).resolve().parents[3]
SIZES = (
    "--preset tiny --objects 8 --pictured 6 --pictures 3 --steps 8 --solid-steps 4 --batch 4 --ray-batch 2 --views 2"
    " --object-rays 8 --near-rays 4 --far-rays 4 --points 24 --colours 8 --warmup 2 --checkpoint-every 3 --log-every 1"
).split()


def start(out: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "farside", "train", "--out", str(out), *SIZES, *more]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def start_two(out: Path) -> list[subprocess.Popen[str]]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{s.getsockname()[1]}"
    return [start(out, "--coordinator", where, "--processes", "2", "--process", str(i)) for i in range(2)]


def finished(processes: Sequence[subprocess.Popen[str]]) -> None:
    try:
        for process in processes:
            _, err = process.communicate(timeout=1200)
            assert process.returncode == 0, err
    finally:
        for process in processes:
            process.kill()


def weights(out: Path) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(load_prior(out / "prior.safetensors").model)]


def figures(out: Path) -> np.ndarray:
    """Steps by figures of the history."""
    lines = (out / "history.jsonl").read_text().splitlines()
    return np.array([[float(v) for v in re.findall(r": (-?[0-9.e+-]+)", line)] for line in lines])


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one process."""
    out = tmp_path_factory.mktemp("alone")
    finished([start(out)])
    return out


@pytest.fixture(scope="module")
def two(alone: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of two that nobody disturbs."""
    out = tmp_path_factory.mktemp("two")
    shutil.copytree(alone / "shapes", out / "shapes")
    finished(start_two(out))
    return out


@pytest.mark.slow
@pytest.mark.timeout(1800)  # with the runs of both fixtures
def test_two_processes_with_half_a_batch_each_make_the_steps_of_one(alone: Path, two: Path) -> None:
    one, both = figures(alone), figures(two)
    assert one.shape == both.shape == (8, 5)
    np.testing.assert_allclose(both[0], one[0], rtol=1e-5)  # the first step: of equal weights
    np.testing.assert_allclose(both, one, rtol=1e-4)
    for a, b in zip(weights(two), weights(alone), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4)
    assert (two / "learnt.json").read_text() == (alone / "learnt.json").read_text()


@pytest.mark.timeout(1800)  # six processes compile
@pytest.mark.parametrize(
    "victim", [pytest.param(0, marks=pytest.mark.slow), pytest.param(1, marks=pytest.mark.nightly)]
)
def test_a_killed_process_ends_the_other_and_the_run_goes_on(two: Path, tmp_path: Path, victim: int) -> None:
    shutil.copytree(two / "shapes", tmp_path / "shapes")
    processes, history = start_two(tmp_path), tmp_path / "history.jsonl"
    with processes[0], processes[1]:
        try:
            while not history.exists() or len(history.read_text().splitlines()) < 4:  # the ray phase is compiled now
                assert all(process.poll() is None for process in processes)
                time.sleep(0.05)
            processes[victim].kill()
            _, err = processes[1 - victim].communicate(timeout=600)
        finally:
            for process in processes:
                process.kill()
    assert processes[1 - victim].returncode not in (0, -9)
    assert re.fullmatch(r"farside: error: .* is lost.*; start all processes again with .*", err.splitlines()[-1])
    assert not (tmp_path / "prior.safetensors").exists() and (tmp_path / "checkpoint.eqx").exists()
    finished(start_two(tmp_path))
    assert history.read_text() == (two / "history.jsonl").read_text()
    for a, b in zip(weights(tmp_path), weights(two), strict=True):
        np.testing.assert_array_equal(a, b)


def test_options_that_do_not_go_together_are_named() -> None:
    for options in ({"coordinator": "here:1"}, {"process": 0}, {"coordinator": "auto", "processes": 2, "process": 0}):
        with pytest.raises(ValueError, match="several processes need --coordinator HOST:PORT"):
            Training(**options)
    with pytest.raises(ValueError, match="--coordinator is here:99999; give HOST:PORT"):
        Training(coordinator="here:99999", processes=2, process=0)
    with pytest.raises(ValueError, match="--coordinator is here; give HOST:PORT"):
        Training(coordinator="here", processes=2, process=0)
    with pytest.raises(ValueError, match="--process is 2 of 2; give 0 to 1"):
        Training(coordinator="here:1", processes=2, process=2)


def test_a_coordinator_that_nobody_knows_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "KNOWN_S", 0.0)
    with pytest.raises(ValueError, match=r"^--coordinator: no\.such\.invalid is no known host \("):
        with processes.joined("no.such.invalid:1234", 2, 1):
            pass
