"""`farside batch`: each unit once, in any order and split; what fails costs itself alone, and says why."""

import io
import json
import re
import resource
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from rich.console import Console

from foundation.store import Store, WriteError
from node.__main__ import main
from node.commands.batch import FAILED, batch
from node.commands.batch_options import BatchConfig
from node.commands.batch_task import TRIES, Event, Job, Record, Runner, Task
from node.commands.batch_unit import Worker
from perception.answers.hypotheses_file import load, load_scene
from perception.inference.schedule import digest
from perception.sources.frame import Frame
from perception.sources.recorder import write_log
from probnerf.prior.checkpoint import identity_of, load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.mugs import table_frame, write_folder
from tests.node.pretend_inference import pretend_estimate


@pytest.fixture(scope="module")
def frame() -> Frame:
    return table_frame()


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(path, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, frame: Frame) -> Path:
    """A frame folder, a recording, and a recording that was cut off; each but the last has two objects."""
    folder = tmp_path_factory.mktemp("logs")
    write_folder(folder / "day 1" / "table", frame)
    write_log(folder / "run.mcap", [replace(frame, stamp_ns=10**18)])
    (folder / "cut.mcap").write_bytes((folder / "run.mcap").read_bytes()[:999])
    (folder / "notes.txt").touch()
    return folder


@pytest.fixture
def given(logs: Path, prior: Path, tmp_path: Path) -> BatchConfig:
    return BatchConfig(logs=(str(logs),), prior=prior, out=str(tmp_path / "out"))


def here(job: Job, flip: bool = False) -> Runner:
    """A runner in this process; `flip`: that takes the last task first."""
    worker = Worker(job)

    def run(tasks: Iterable[Task], then: Callable[[Task, Record], Iterable[Task]]) -> Iterator[Event]:
        waiting = list(tasks)
        while waiting:
            task = waiting.pop(-1 if flip else 0)
            record = worker(task)
            waiting += then(task, record)
            yield Event(task, record)

    return run


def run(
    config: BatchConfig, runner: Callable[[Job], Runner] = here, infer: Callable = pretend_estimate
) -> tuple[int, str]:
    """The exit code, and what is printed."""
    text = io.StringIO()
    code = batch(config, Console(file=text), Console(file=text), runner, infer)
    return code, text.getvalue()


def table(config: BatchConfig) -> list[dict]:
    return pq.read_table(f"{config.out}/table.parquet").to_pylist()


def test_each_unit_is_written_and_listed(given: BatchConfig, logs: Path) -> None:
    code, text = run(given)
    assert code == FAILED and "4 units done, 0 were there, 1 failed" in text
    rows = table(given)
    recording, folder = str(logs / "run.mcap"), str(logs / "day 1" / "table")
    units = [(folder, 1, 0), (folder, 2, 0), (recording, 1, 0), (recording, 2, 0)]
    assert [(row["log"], row["object"], row["seed"]) for row in rows] == [(str(logs / "cut.mcap"), None, None), *units]
    assert rows[0]["result"] == "failed" and str(logs / "cut.mcap") in rows[0]["error"]
    for row in rows[1:]:
        h = load(f"{given.out}/{row['file']}")
        assert (h.object_id, h.seed, h.stamp_ns) == (row["object"], row["seed"], row["stamp_ns"])
        assert row["digest"] == digest(h) and row["result"] == "converged" and row["error"] is None
        assert (Path(given.out) / row["file"]).stat().st_size == row["bytes"]
        assert 0.03 < row["width_m"] < 0.3 and row["seconds"] == 1.5 and row["r_hat"] is None
    assert len(load_scene(Path(given.out) / Path(rows[1]["file"]).parent)) == 2  # to be asked jointly


def test_what_is_there_is_not_done_again(given: BatchConfig) -> None:
    run(replace(given, object=1))
    before = {path: path.stat().st_mtime_ns for path in Path(given.out).rglob("object*")}
    code, text = run(replace(given, object=1), infer=None)  # a real inference would take minutes
    assert code == FAILED and "0 units done, 3 were there, 1 failed" in text
    run(replace(given, object=1, seeds=2))
    after = {path: path.stat().st_mtime_ns for path in Path(given.out).rglob("object*")}
    assert before.items() < after.items() and len(after) == 2 * len(before)
    assert [row["seed"] for row in table(given) if row["file"]] == [0, 1, 0, 1]


@pytest.mark.parametrize("parts", [1, 3])
def test_any_split_and_order_makes_the_same_table(given: BatchConfig, parts: int, tmp_path: Path) -> None:
    given = replace(given, seeds=2)
    run(given)
    other = replace(given, out=str(tmp_path / "other"))
    for i in reversed(range(parts)):
        _, text = run(replace(other, shard=f"{i}/{parts}"), lambda job: here(job, flip=True))
        assert not (tmp_path / "other" / "table.parquet").exists() and "--table-only" in text
    assert main(["batch", "--table-only", "--out", other.out]) == FAILED
    assert (tmp_path / "other" / "table.parquet").read_bytes() == (tmp_path / "out" / "table.parquet").read_bytes()
    assert len(table(other)) == 9


def test_parts_share_the_work_out(given: BatchConfig) -> None:
    """Each does its share alone: four seeds of two logs that can be read, and one that cannot."""
    done = []
    for i in range(3):
        _, text = run(replace(given, seeds=4, shard=f"{i}/3"))
        done.append(text.count(": converged"))
    assert sum(done) == 16 and max(done) <= 8


def test_a_store_elsewhere_takes_the_same(given: BatchConfig, tmp_path: Path) -> None:
    """Logs, too."""
    run(given)
    remote = Store(f"memory://{tmp_path.name}")
    for path in Path(given.logs[0]).rglob("*"):
        if path.is_file():
            remote.write(str(path.relative_to(given.logs[0])), path.read_bytes())
    elsewhere = Store(f"memory://{tmp_path.name}-out")
    assert run(replace(given, logs=(remote.url,), out=elsewhere.url))[0] == FAILED
    rows = pq.read_table(io.BytesIO(elsewhere.read(["table.parquet"])["table.parquet"])).to_pylist()
    same = ("object", "seed", "result", "digest", "width_m", "stamp_ns")
    assert [[row[name] for name in same] for row in rows] == [[row[name] for name in same] for row in table(given)]
    assert all(row["log"].startswith("memory://") for row in rows)
    assert "farside-" not in rows[0]["error"]  # the log is named, not its copy


def test_what_failed_is_done_again_on_request_alone(given: BatchConfig) -> None:
    def broken(frame, found, *args, seed, **limits):
        if found.id == 2:
            raise ValueError("the object is\n a ghost")
        return pretend_estimate(frame, found, *args, seed=seed)

    given = replace(given, logs=(f"{given.logs[0]}/*.mcap", *given.logs))
    _, text = run(given, infer=broken)
    assert "run.mcap object 2 seed 0: failed: the object is a ghost" in text and "2 units done" in text
    assert [row["error"] for row in table(given) if row["object"] == 2] == ["the object is a ghost"] * 2
    code, text = run(given)
    assert code == FAILED and "0 units done" in text
    code, text = run(replace(given, retry_failed=True))
    assert code == FAILED and "2 units done" in text  # the cut recording fails again
    assert not any(row["error"] for row in table(given) if row["object"])
    assert not list(Path(given.out).rglob("object*.failed.json"))


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is damaged"),
        (b"\xff\x00", "is damaged"),
        (b"[]", "is damaged"),
        (b"[" * 100_000, "is damaged"),
        (b"[" + 9_000_000 * b"0," + b"0]", "is damaged"),
        (b'{"format": "farside-batch-99"}', "has format 'farside-batch-99', not farside-batch-1; give another"),
    ],
    ids=["empty", "no text", "list", "nested", "huge", "newer"],
)
def test_settings_that_cannot_be_read_are_named(given: BatchConfig, content: bytes, why: str) -> None:
    settings = Path(given.out) / "settings.json"
    settings.parent.mkdir(parents=True, exist_ok=True)
    settings.write_bytes(content)
    for config in (given, replace(given, table_only=True)):
        with pytest.raises(ValueError, match=rf"settings\.json {why}") as caught:
            batch(config, Console(), Console())
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_settings_in_another_layout_are_the_same(given: BatchConfig) -> None:
    run(given)
    settings = Path(given.out) / "settings.json"
    settings.write_text(json.dumps(json.loads(settings.read_text()), indent=4) + "\n\n")
    assert run(given)[0] == FAILED  # of the log that was cut off
    assert run(BatchConfig(table_only=True, out=given.out))[0] == FAILED


def test_other_settings_and_other_logs_do_not_mix_in(given: BatchConfig, logs: Path, tmp_path: Path) -> None:
    log = tmp_path / "my.mcap"
    log.write_bytes((logs / "run.mcap").read_bytes())
    given = replace(given, logs=(str(log),))
    assert run(given)[0] == 0
    with pytest.raises(ValueError, match="holds results with stages None, and this is 4; give that, or another --out"):
        run(replace(given, stages=4))
    with pytest.raises(ValueError, match=r"holds results with controller.grid 64, and this is 32"):
        run(replace(given, controller=replace(given.controller, grid=32)))
    save_prior(tmp_path / "new.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(1)), {})
    with pytest.raises(ValueError, match="holds results with prior"):
        run(replace(given, prior=tmp_path / "new.safetensors"))
    log.write_bytes(log.read_bytes() + b"more")
    with pytest.raises(ValueError, match=r"my\.mcap has changed since its objects were found"):
        run(given)
    record = next(Path(given.out).rglob("object_1.json"))
    record.write_text(json.dumps(json.loads(record.read_text()) | {"settings": "other"}))
    with pytest.raises(ValueError, match=r"object_1\.json is no record of this run \(it is of other settings\)"):
        run(BatchConfig(table_only=True, out=given.out))


def test_a_frame_that_changed_is_not_taken_for_the_one_before(given: BatchConfig, logs: Path) -> None:
    task = Task(str(logs / "run.mcap"), 1, 0, frame="0" * 16)
    record = Worker(Job(given, given.out, "settings", pretend_estimate))(task)
    assert record["result"] == "failed" and "another frame than when its objects were found" in record["error"]


def test_what_is_left_out_has_its_reason_in_the_table(given: BatchConfig, frame: Frame, tmp_path: Path) -> None:
    """The carton is cut off by the picture's border."""
    edge = int(np.flatnonzero((frame.label == 2).any(axis=0)).mean())
    colour, depth = frame.rgb[:, :edge, ::-1], np.rint(1000 * np.nan_to_num(frame.depth[:, :edge]))
    folder = write_folder(tmp_path / "edge", frame, color=colour, depth=depth.astype(np.uint16))
    (folder / "label.png").unlink()
    given = replace(given, logs=(str(folder),))
    assert run(given)[0] == 0
    (left,) = [row for row in table(given) if row["result"] == "left out"]
    assert "border" in left["error"] and left["object"] == 2 and left["seed"] is None


def test_a_prior_is_known_without_its_weights(prior: Path) -> None:
    assert identity_of(prior) == load_prior(prior).identity and identity_of() == load_prior().identity


def test_a_task_that_was_lost_thrice_is_given_up(given: BatchConfig) -> None:
    def losing(job: Job) -> Runner:
        def run(tasks: Iterable[Task], then: Callable) -> Iterator[Event]:
            for task, lost in ((task, n) for task in tasks for n in range(1, TRIES + 1)):
                yield Event(task, None, "process 7 ended", lost)

        return run

    code, text = run(given, losing)
    assert code == FAILED and text.count("process 7 ended; tried again") == 2 * 3 * 2 and "3 failed" in text
    assert {row["error"] for row in table(given)} == {"given up after 3 tries: process 7 ended"}


def test_a_place_that_fills_up_ends_the_batch_and_the_command_goes_on(given: BatchConfig) -> None:
    run(given)
    next(Path(given.out).rglob("run*/seed_0/object_1.json")).unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, hard))  # room for records, not for shapes
    text = io.StringIO()
    try:
        with pytest.raises(WriteError) as caught:
            batch(given, Console(file=text), Console(file=text), here, pretend_estimate)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    line = r".*/out/logs/.*object_1\.npz cannot be written \(File too large\); make room or give another place"
    assert re.fullmatch(line + "; then the same command goes on", str(caught.value))
    assert "0 units done" in text.getvalue() and not list(Path(given.out).rglob("object*.failed.json"))
    assert run(given)[0] == FAILED and len(table(given)) == 5


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--out", "{out}"], "there are no logs; give recordings"),
        (["{logs}"], "there is no place for the results; give --out"),
        (["{logs}", "--out", "nope://x"], "Protocol not known: nope"),
        (["{logs}", "--out", "memory://x"], "is the memory of one process"),
        (["nope://x", "--out", "{out}"], "Protocol not known: nope"),
        (["{logs}", "--out", "{logs}/notes.txt"], "is a file; give a folder"),
        (["{logs}", "--out", "{out}", "--shard", "3/2"], "the parts of 2 are 0/2 to 1/2"),
        (["{logs}", "--out", "{out}", "--shard", "2"], "the shard is '2'; give I/N"),
        (["{logs}", "--out", "{out}", "--seeds", "0"], "seeds is 0; give 1 or more"),
        (["{logs}/*.bag", "--out", "{out}"], "*.bag matches nothing"),
        (["{logs}/none.mcap", "--out", "{out}"], "none.mcap does not exist"),
        (["{logs}", "--out", "{out}", "--prior", "none.safetensors"], "none.safetensors: no such prior"),
        (["--table-only", "--out", "{out}"], "holds no results of `farside batch`"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    args: list[str], says: str, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["batch", *(a.format(logs=logs, out=tmp_path / "out") for a in args)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("farside: error: ") and says in line
    assert not (tmp_path / "out").exists()
