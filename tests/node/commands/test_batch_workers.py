"""`farside batch` with processes and on a Dask cluster: a worker that dies costs its unit one try, and no result."""

import io
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from foundation.store import WriteError
from node.__main__ import main
from node.commands.batch import FAILED, batch
from node.commands.batch_options import BatchConfig
from node.commands.batch_task import TRIES
from perception.answers.hypotheses_file import load
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.commands.test_batch import here
from tests.node.commands.test_replay_whole import FEW
from tests.node.mugs import table_frame, write_folder
from tests.node.pretend_inference import deadly_estimate, pretend_estimate


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs of one frame, which has two objects, and a prior."""
    folder, frame = tmp_path_factory.mktemp("given"), table_frame()
    for name in "ab":
        write_folder(folder / "logs" / name, frame)
    save_prior(folder / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    return folder


@pytest.fixture
def given(place: Path, tmp_path: Path) -> BatchConfig:
    return BatchConfig(logs=(str(place / "logs"),), prior=place / "tiny.safetensors", out=str(tmp_path / "alone"))


@pytest.fixture
def deaths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "deaths"
    folder.mkdir()
    monkeypatch.setenv("FARSIDE_TEST_DEATHS", str(folder))
    return folder


def run(config: BatchConfig) -> tuple[int, str]:
    text = io.StringIO()
    code = batch(config, Console(file=text), Console(file=text), infer=deadly_estimate)
    return code, text.getvalue()


def test_a_killed_worker_changes_no_result(given: BatchConfig, deaths: Path, tmp_path: Path) -> None:
    assert batch(given, Console(file=io.StringIO()), Console(file=io.StringIO()), here, pretend_estimate) == 0
    (deaths / "1").touch()
    code, text = run(replace(given, out=str(tmp_path / "two")))
    assert code == 0 and "4 units done" in text and not list(deaths.iterdir())
    assert "object 2 seed 0: process" in text and "was ended by signal 9 (Killed); tried again" in text
    assert (tmp_path / "two" / "table.parquet").read_bytes() == (tmp_path / "alone" / "table.parquet").read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("deaths")
def test_a_result_that_finds_no_place_thrice_ends_the_batch(given: BatchConfig) -> None:
    run(given)
    next(Path(given.out).rglob("object_2.json")).unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, hard))  # the processes inherit it
    try:
        with pytest.raises(WriteError, match=r"object_\d\.npz cannot be written \(File too large\); make room"):
            run(given)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert run(given)[0] == 0


@pytest.mark.slow
def test_what_kills_every_worker_is_given_up(given: BatchConfig, deaths: Path, tmp_path: Path) -> None:
    for n in range(TRIES):
        (deaths / str(n)).touch()
    code, text = run(replace(given, logs=(f"{given.logs[0]}/a",)))
    assert code == FAILED and "1 units done, 0 were there, 1 failed" in text and "signal 9 (Killed); given up" in text
    assert not list(deaths.iterdir())
    alive, dead = pq.read_table(tmp_path / "alone" / "table.parquet").to_pylist()
    assert alive["result"] == "converged" and dead["error"].startswith("given up after 3 tries: ")


def test_a_prior_that_cannot_be_read_ends_it_all(
    given: BatchConfig, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    prior = tmp_path / "no.safetensors"
    prior.write_bytes(b"no weights")
    assert main(["batch", *given.logs, "--out", given.out, "--prior", str(prior)]) == 1
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("farside: error: ") and str(prior) in line
    assert not list(Path(given.out).rglob("object*"))


@pytest.mark.slow
def test_dask_loses_a_worker_and_no_result(given: BatchConfig, deaths: Path, tmp_path: Path) -> None:
    batch(given, Console(file=io.StringIO()), Console(file=io.StringIO()), here, pretend_estimate)
    (deaths / "1").touch()
    code, text = run(replace(given, workers=2, dask="local", out=str(tmp_path / "dask")))
    assert code == 0 and "2 workers; " in text and "4 units done" in text and not list(deaths.iterdir())
    assert "lost: worker tcp://127.0.0.1:" in text
    assert (tmp_path / "dask" / "table.parquet").read_bytes() == (tmp_path / "alone" / "table.parquet").read_bytes()


def test_a_scheduler_that_is_not_there_is_named(
    given: BatchConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("node.commands.batch_dask._CONNECT_S", 0.2)
    args = ["--out", given.out, "--prior", str(given.prior), "--dask", "tcp://127.0.0.1:1"]
    assert main(["batch", *given.logs, *args]) == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:1" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_real_parts_on_processes_make_the_same_table(tmp_path: Path, given: BatchConfig) -> None:
    """The shipped recording with a small untrained prior: two processes and two parts, against one process."""
    (tmp_path / "few.yaml").write_text(FEW)
    args = ["--config", str(tmp_path / "few.yaml"), "--prior", str(given.prior), "--stages", "2", "--seeds", "2"]
    log = str(SHIPPED_LOG)
    assert main(["batch", log, "--out", str(tmp_path / "one"), *args]) == 0
    for i in range(2):
        assert main(["batch", log, "--out", str(tmp_path / "two"), *args, "--shard", f"{i}/2", "--workers", "2"]) == 0
    assert main(["batch", "--table-only", "--out", str(tmp_path / "two")]) == 0
    one, two = (pq.read_table(tmp_path / name / "table.parquet").drop_columns(["seconds"]) for name in ("one", "two"))
    assert one.equals(two) and one.num_rows == 4


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_no_process_stays_and_the_same_command_goes_on(
    tmp_path: Path, given: BatchConfig, number: signal.Signals, code: int
) -> None:
    (tmp_path / "few.yaml").write_text(FEW)
    args = ["--config", str(tmp_path / "few.yaml"), "--prior", str(given.prior), "--out", given.out]
    command = [sys.executable, "-m", "farside", "batch", str(SHIPPED_LOG), *args, "--stages", "2"]
    many = [*command, "--workers", "2", "--seeds", "500"]
    with subprocess.Popen(many, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as started:
        while "seed" not in (line := started.stderr.readline()):
            assert line, "it ended by itself"
        children = Path(f"/proc/{started.pid}/task/{started.pid}/children").read_text().split()
        started.send_signal(number)
        out, _ = started.communicate()
    assert started.returncode == code and ("the same command goes on" in out) == (code == 130)
    late = time.monotonic() + 60
    while any(Path(f"/proc/{child}").exists() for child in children):
        assert time.monotonic() < late, "a process stays"
        time.sleep(0.1)
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "were there, 0 failed" in ended.stdout and "0 were there" not in ended.stdout
    assert {load(path).object_id for path in Path(given.out).rglob("object_*.npz")} == {1, 2}  # all are whole
