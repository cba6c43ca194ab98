"""Faults while `farside live` runs: they end in one line, spoil nothing recorded, and one bad frame ends nothing."""

import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from node.__main__ import main
from node.commands.config_file import load_config
from node.commands.keeper import Keeper
from node.commands.options import LiveConfig
from node.viewer.page import Page
from perception.inference.tracker import Tracker
from perception.sources.frame import StillSource
from perception.sources.reader import Reader
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.types import StopReason
from tests.conftest import ROOT
from tests.node.pretend_inference import pretend_live
from tests.node.shapes import body_with_handle


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A command line of `live` that plays the shipped recording with a small untrained prior, not warmed up."""
    monkeypatch.setattr("node.commands.live.warm_up", lambda _: None)
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    (tmp_path / "live.yaml").write_text("bus: {listen: [tcp/127.0.0.1:0]}")
    options = ["--prior", str(tmp_path / "tiny.safetensors"), "--config", str(tmp_path / "live.yaml")]
    return ["live", str(SHIPPED_LOG), *options]


def test_ctrl_c_in_the_sampler_ends_the_node(
    run: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    interrupted = replace(body_with_handle(), result=StopReason.INTERRUPTED)  # as the sampler says it
    asked = pretend_live(monkeypatch, lambda look: [replace(interrupted, object_id=look.object_id)], first=False)
    assert main([*run, "--seconds", "30"]) == 0
    assert "1 inferred" in capsys.readouterr().out
    deadlines = [limits.deadline for limits in asked]
    assert len(deadlines) == 2 and deadlines[0] is not None and deadlines[0] == deadlines[1]  # both objects' own
    assert deadlines[0] <= time.monotonic() + 30.0  # less than the budget of 40 s for each


def test_a_page_that_cannot_open_leaves_no_recording(
    run: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main([*run, "--record", str(tmp_path / "a.mcap"), "--page", str(port)]) == 1
    assert f"port {port} of 127.0.0.1 is in use" in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()


def test_a_page_that_fails_ends_no_inference(
    run: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def fail(self: Page, scene: Any, view: Any) -> None:
        raise RuntimeError("nothing to draw with")

    monkeypatch.setattr(Page, "show", fail)
    pretend_live(monkeypatch, lambda look: 3 * [replace(body_with_handle(), object_id=look.object_id)])
    assert main([*run, "--page", "0"]) == 0
    said = capsys.readouterr()
    assert said.err.count("nothing to draw with") == 1 and " 0 inferred" not in said.out


@pytest.mark.parametrize("command", ["live", "replay"])
@pytest.mark.parametrize("seed", ["-1", "99999999999999999999"])
def test_a_seed_that_is_none_is_one_line(command: str, seed: str, capsys: pytest.CaptureFixture) -> None:
    assert main([command, str(SHIPPED_LOG), "--seed", seed]) == 1
    assert capsys.readouterr().err.startswith(f"farside: error: the seed is {seed}; give 0 to")


def test_a_frame_that_cannot_be_recorded_does_not_end_the_recording(tmp_path: Path) -> None:
    first, *others = Log(SHIPPED_LOG)
    bad = replace(first, label=np.full(first.rgb.shape[:2], 70_000, np.int32))
    said: list[str] = []
    reader = Reader(StillSource((bad, *others)))
    with Recorder(tmp_path / "a.mcap") as recorder:
        keeper = Keeper(reader.listen("keeper"), recorder, None, said.append)
        with reader:
            keeper.thread.start()
            keeper.thread.join(10.0)
        assert not keeper.has(bad) and all(keeper.has(frame) for frame in others)
    assert recorder.frames == len(others) and len(said) == 1 and "70000" in said[0]


def test_a_recording_that_broke_off_is_an_error_at_the_end(
    run: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def full(self: Recorder, message: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recorder, "_add", full)
    monkeypatch.setattr(Tracker, "look", lambda *_: None)
    assert main([*run, "--pace", "0", "--record", str(tmp_path / "a.mcap")]) == 1
    said = capsys.readouterr()
    assert said.err.splitlines()[-1].startswith("farside: error: ") and "No space left on device" in said.err
    assert " frames, " in said.out


PROGRAM = """
import sys
from node.__main__ import COMMANDS, main
from probnerf.types import StopReason

def interrupted(_):
    import jax, os, threading, time
    def f(x):
        for i in range(400):
            x = jax.numpy.sin(x @ x) + jax.lax.cond(x.sum() > i, lambda y: y + i, jax.numpy.sort, x)
        return x
    lowered = jax.jit(f).lower(jax.numpy.ones((8, 8)))
    threading.Timer(0.5, os.kill, (os.getpid(), int(sys.argv.pop()))).start()
    lowered.compile()

COMMANDS["query"] = interrupted
sys.argv = ["farside", "query", *sys.argv[1:]]
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_while_it_compiles_ends_with_its_code(how: signal.Signals, tmp_path: Path) -> None:
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_NUM_CPU_DEVICES": "2"}
    run = [sys.executable, "-c", PROGRAM, str(int(how))]
    ended = subprocess.run(run, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (130, "farside: interrupted\n")


@pytest.mark.parametrize(
    ("key", "says"),
    [
        ("controller: {hypotheses: 0}", "hypotheses is 0; give 1"),
        ("controller: {grid: 0}", "grid is 0; give 1 to 512"),
        ("controller: {infer: {lattice: 0}}", "lattice 0 must be 1 or more"),
        ("controller: {infer: {wall_sigma: 0}}", "wall_sigma 0 and"),
        ("track: {views: 0}", "views 0 and checked 32"),
        ("token: true", "a token is in the page's address; give the page's port, too"),
    ],
)
def test_numbers_that_nothing_can_be_inferred_with_are_refused(key: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "live.yaml").write_text(key)
    with pytest.raises(ValueError, match=says):
        load_config(tmp_path / "live.yaml", LiveConfig)
