"""`farside record`, and `farside replay --schedule`: what was inferred while recording comes out again, bit for bit."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import perception.inference.tracker
from node.__main__ import main
from node.commands.config_file import load_config
from node.commands.options import ReplayConfig
from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import load
from perception.inference.controller import Estimate, estimate
from perception.inference.limits import Limits
from perception.inference.publish import ConditionedView
from perception.inference.schedule import config_hash, scheduled
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment, segment
from perception.sources.frame import Frame
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import Prior, load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.commands.test_replay_whole import FEW
from tests.node.mugs import table_frame
from tests.node.test_main import one_line
from tests.perception.answers.test_query import _object
from tests.perception.cylinders import CAN, picture
from tests.perception.sources.test_recorder import frame as small_frame
from tests.perception.sources.test_recorder import no_file_beyond

ROOT = Path(__file__).parents[3]
STEP = 100_000_000
Session = tuple[Path, list[Hypotheses]]


def pretend(frame: Frame, found: Segment, prior: Prior, config: ControllerConfig, **asked: Any) -> Estimate:
    """Stands for the sampler: as random as it, and as repeatable."""
    rng = np.random.default_rng([asked["seed"], asked["stages"], frame.stamp_ns, int(found.mask.sum())])
    shapes = list(rng.integers(0, 256, (2, 32, 32, 32)).astype(np.uint8))
    h = _object(shapes, [0.25, 0.75], object_id=found.id)
    seen = rng.random((32, 32, 32)) < 0.5
    h = replace(h, stamp_ns=frame.stamp_ns, seed=asked["seed"], stage=asked["stages"], prior_hash=prior.hash, seen=seen)
    return Estimate(h, None, None, None, h.object_frame, 0.1)


def pretend_view(
    view: ConditionedView, prior: Prior, config: ControllerConfig, seed: int, limits: Limits, **_: Any
) -> Estimate:
    return pretend(view.frame, view.segment, prior, config, seed=seed, stages=limits.stages)


def record_session(folder: Path, first: Frame, infer: Callable[..., Estimate]) -> Session:
    """A prior, a configuration, a log of three frames with a schedule, and what was inferred while it was made."""
    save_prior(folder / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    (folder / "few.yaml").write_text(FEW)
    prior, config = load_prior(folder / "tiny.safetensors"), load_config(folder / "few.yaml", ReplayConfig)
    rng = np.random.default_rng(0)
    live: list[Hypotheses] = []
    with Recorder(folder / "session.mcap", wait=True) as recorder:
        for i in range(3):
            depth = (first.depth + rng.normal(0, 1e-3, first.depth.shape)).astype(np.float32)
            frame = replace(first, stamp_ns=10**18 + i * STEP, depth=depth)
            recorder.write_frame(frame)
            if i == 1:
                continue  # the sampler was still busy
            found = segment(frame, 1, config.segment)[0]
            h = infer(frame, found, prior, config.inference, seed=3 + i, stages=2).hypotheses
            recorder.write_schedule(scheduled(h, config_hash(config.inference, config.segment, config.track)))
            live.append(h)
    return folder, live


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return record_session(tmp_path_factory.mktemp("session"), picture(CAN), pretend)


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("node.commands.replay.draw_object", lambda path, *_: path.touch())


@pytest.fixture
def pretending(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perception.inference.tracker, "infer_view", pretend_view)


def run(folder: Path, out: Path, *more: str) -> list[str]:
    given = ["--prior", str(folder / "tiny.safetensors"), "--config", str(folder / "few.yaml"), "--out", str(out)]
    return ["replay", str(folder / "session.mcap"), *given, "--schedule", *more]


def repeats(session: Session, out: Path, capsys: pytest.CaptureFixture) -> None:
    folder, live = session
    assert main(run(folder, out, "--seed", "99", "--stages", "9", "--frame", "1")) == 0  # the schedule's own win
    assert "2 of 2 inferences came out as they did when they were recorded" in capsys.readouterr().out
    assert sorted(p.name for p in out.iterdir()) == [str(h.stamp_ns) for h in live]
    for then in live:
        now = load(out / str(then.stamp_ns) / "object_1.npz")
        assert (now.seed, now.stage, now.prior_hash) == (then.seed, 2, then.prior_hash)
        for name in ("opacity", "weights", "pose", "population", "seen"):
            np.testing.assert_array_equal(getattr(now, name), getattr(then, name))
    assert not np.array_equal(live[0].opacity, live[1].opacity)


def test_a_schedule_repeats_what_was_inferred_live(
    session: Session, pretending: None, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    repeats(session, tmp_path / "out", capsys)
    assert main(run(session[0], tmp_path / "part", "--from", "0.1")) == 0
    assert [p.name for p in (tmp_path / "part").iterdir()] == [str(session[1][1].stamp_ns)]


@pytest.mark.slow
def test_the_sampler_repeats_what_it_inferred_live(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Nothing replaced: the depth is no whole number of millimetres, and every bit of it counts."""
    repeats(record_session(tmp_path, table_frame(), estimate), tmp_path / "out", capsys)


def other(session: Session, folder: Path, **changes: object) -> Path:
    """The session's log with one frame and one entry, which is changed."""
    log = Log(session[0] / "session.mcap")
    entry, frame = log.schedule()[0], next(iter(log))
    with Recorder(folder / "other.mcap") as recorder:
        recorder.write_frame(frame)
        recorder.write_schedule(replace(entry, **changes))
    return folder / "other.mcap"


def test_what_comes_out_otherwise_is_said(
    session: Session, pretending: None, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = other(session, tmp_path, seed=77)
    given = run(session[0], tmp_path / "out")
    assert main([given[0], str(path), *given[2:]]) == 0
    said = capsys.readouterr().out
    assert "differs from what came out when it was recorded" in said and "0 of 1 inferences came out" in said


@pytest.mark.parametrize(
    ("changes", "more", "says"),
    [
        ({"prior_hash": "0" * 16}, [], "was recorded with prior 0000000000000000, and this one is"),
        ({}, ["--method", "annealed_hmc"], r"was recorded with configuration .* --config and --method"),
        ({}, ["--config", "{folder}/tracked.yaml"], r"was recorded with configuration .* --config and --method"),
        ({"config_hash": "{before}"}, [], r"was recorded by Farside before 0\.2\.0, .* record it again"),
        ({"object_id": 9}, [], "has nothing in this range whose inference can be repeated"),
        ({}, ["--object", "2"], "has no schedule for object 2; omit --schedule"),
        ({}, ["--from", "5"], "has no frame from 5 s on; it runs from 0 to 0.000 s"),
    ],
)
def test_what_cannot_be_repeated_is_named(
    session: Session,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    changes: dict,
    more: list[str],
    says: str,
) -> None:
    folder, _ = session
    config = load_config(folder / "few.yaml", ReplayConfig)
    before = config_hash(config.inference, config.segment)  # without the tracker's settings
    changes = {name: before if value == "{before}" else value for name, value in changes.items()}
    path = other(session, tmp_path, **changes)
    (tmp_path / "tracked.yaml").write_text(FEW + "track: {adds: 0.2}\n")
    given = run(folder, tmp_path / "out", *(argument.format(folder=tmp_path) for argument in more))
    assert main([given[0], str(path), *given[2:]]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert re.search(says, lines[-1]) and lines[-1].startswith("farside: error: ") and not (tmp_path / "out").exists()


def test_a_log_without_schedule_says_so(session: Session, capsys: pytest.CaptureFixture) -> None:
    assert main(["replay", "--schedule", "--prior", str(session[0] / "tiny.safetensors")]) == 1
    assert "shipped.mcap has no schedule; omit --schedule" in one_line(capsys.readouterr().err)


def test_record_takes_a_part_of_a_log(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, shipped = tmp_path / "new" / "a.mcap", list(Log(SHIPPED_LOG))
    assert main(["record", str(SHIPPED_LOG), "--out", str(out), "--from", "0.1", "--to", "0.3"]) == 0
    assert re.search(r"a\.mcap: 3 frames over 0\.2 s \(10\.0 per s\), 0 dropped, \d\.\d MB", capsys.readouterr().out)
    _equal(list(Log(out)), shipped[1:4])
    short = tmp_path / "b.mcap"
    assert main(["record", str(SHIPPED_LOG), "--out", str(short), "--seconds", "0.15", "--colour", "png"]) == 0
    _equal(list(Log(short)), shipped[:2])


def _equal(read: list[Frame], written: list[Frame]) -> None:
    for a, b in zip(read, written, strict=True):
        assert a.stamp_ns == b.stamp_ns
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere", "--out", "a.mcap"], "nowhere does not exist"),
        (["{log}", "--out", "there.mcap"], "there.mcap is there already; give another name"),
        (["{log}", "--out", "there.mcap/a.mcap"], "a.mcap cannot be written (Not a directory)"),
        (
            ["{log}", "--out", "a.mcap", "--from", "9"],
            "shipped.mcap has no frame from 9 s on; it runs from 0 to 0.400 s",
        ),
        (["{log}", "--out", "a.mcap", "--seconds", "0"], "--seconds is 0; give more than 0"),
    ],
)
def test_record_names_what_is_wrong_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").write_text("kept")
    assert main(["record", *(a.format(log=SHIPPED_LOG) for a in arguments)]) == 1
    assert says in one_line(capsys.readouterr().err)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("there.mcap", "kept")]


def test_record_on_a_full_disk_keeps_what_was_written(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    source, out = tmp_path / "source.mcap", tmp_path / "out.mcap"
    with Recorder(source, wait=True) as recorder:
        for i in range(100):
            recorder.write_frame(small_frame(i))
    with no_file_beyond(source.stat().st_size // 2):
        assert main(["record", str(source), "--out", str(out), "--chunk-bytes", "1"]) == 1
    assert "out.mcap: recording ended at frame" in one_line(capsys.readouterr().err)
    assert len(list(Log(out))) > 10


SLOW = """
import sys, time
import node.commands.record
from tests.perception.sources.test_recorder import frame
class Camera:
    notes, live = [], True
    def __iter__(self):
        for i in range(10_000):
            time.sleep(0.02)
            if i == 5:
                print("ready", flush=True)
            yield frame(i)
node.commands.record.open_playback = lambda *_, **__: Camera()
from node.__main__ import main
sys.exit(main(["record", "camera", "--out", sys.argv[1]]))
"""


def test_ctrl_c_ends_a_recording_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with subprocess.Popen([sys.executable, "-c", SLOW, path], cwd=ROOT, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "ready\n"
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
        said = child.stdout.read()
    assert child.returncode == 0
    count = int(re.search(r"a\.mcap: (\d+) frames over", said)[1])
    log = Log(path)
    assert len(list(log)) == count >= 5 and log.notes == []
