"""File commands with two objects: a folder is asked jointly, and a schedule repeats the object that it names."""

import json
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
from perception.answers.hypotheses_file import load, save
from perception.answers.query import query
from perception.answers.regions import Box
from perception.inference.limits import Limits
from perception.inference.schedule import config_hash, digest, scheduled
from perception.inference.tracker import Tracker
from perception.observation.segmentation import segment
from perception.sources.recorder import Recorder
from probnerf.prior.checkpoint import load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.commands.test_replay_schedule import pretend_view
from tests.node.commands.test_replay_whole import FEW
from tests.node.shapes import body_with_handle
from tests.perception.cylinders import Cylinder, picture

SMALL, LARGE = Cylinder(-0.12, 0.0, 0.045, 0.12), Cylinder(0.13, -0.05, 0.05, 0.14)
BOX = (-0.12, -0.1, 0.4, -0.021, 0.1, 0.6)  # m, camera frame: where both may have a handle


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Results of `replay` about two objects, 2 cm apart."""
    for h in (body_with_handle(), body_with_handle((0.9, 0.1), object_id=2, T_world_camera=np.eye(4))):
        save(tmp_path / f"object_{h.object_id}.npz", h)
    return tmp_path


def asked(capsys: pytest.CaptureFixture, path: Path, *more: str) -> dict[str, Any]:
    assert main(["query", str(path), "--box", *map(str, BOX), "--json", *more]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_folder_is_asked_jointly(folder: Path, capsys: pytest.CaptureFixture) -> None:
    both = asked(capsys, folder, "--frame", "camera")
    each = [asked(capsys, folder / f"object_{i}.npz", "--frame", "camera") for i in (1, 2)]
    assert [r["p_free"] for r in (*each, both)] == pytest.approx([0.3, 0.9, 0.3 * 0.9])
    assert both["blocked_by"] == each[0]["blocked_by"] | each[1]["blocked_by"]
    scene = [load(folder / f"object_{i}.npz") for i in (1, 2)]
    assert both["p_free"] == query(scene, Box(BOX[:3], BOX[3:]), "camera").p_free
    save(folder / "object_1_before.npz", scene[0])  # a copy under a name of the user's own
    assert asked(capsys, folder, "--frame", "camera")["p_free"] == both["p_free"]


@pytest.mark.parametrize(
    ("frame", "says"),
    [("object", "ambiguous with 2 objects"), ("world", "object 1 was recorded without the camera's pose in the world")],
)
def test_a_frame_that_not_all_objects_share_is_refused(
    folder: Path, frame: str, says: str, capsys: pytest.CaptureFixture
) -> None:
    assert main(["query", str(folder), "--box", *map(str, BOX), "--frame", frame]) == 1
    assert says in capsys.readouterr().err


def test_an_object_that_is_there_twice_is_refused(folder: Path, capsys: pytest.CaptureFixture) -> None:
    save(folder / "object_3.npz", body_with_handle())
    assert main(["query", str(folder), "--box", *map(str, BOX), "--frame", "camera"]) == 1
    assert "holds object 1 in two files" in capsys.readouterr().err


@pytest.mark.parametrize("wanted", [None, 1, 2])
def test_a_schedule_repeats_the_object_that_it_names(
    wanted: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Nobody labels the objects. The second that came is the larger one, which segmentation puts first."""
    monkeypatch.setattr(perception.inference.tracker, "infer_view", pretend_view)
    monkeypatch.setattr("node.commands.replay.draw_object", lambda path, *_: path.touch())
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    (tmp_path / "few.yaml").write_text(FEW)
    prior, config = load_prior(tmp_path / "tiny.safetensors"), load_config(tmp_path / "few.yaml", ReplayConfig)
    tracker, live = Tracker(prior, config.inference, config.track), []
    with Recorder(tmp_path / "log.mcap", wait=True) as recorder:
        for stamp, things in ((10**18, (SMALL,)), (10**18 + 10**8, (SMALL, LARGE))):
            frame = replace(picture(*things, label=False), stamp_ns=stamp)
            recorder.write_frame(frame)
            for look in [tracker.look(frame, s, lambda _: (7, True)) for s in segment(frame, None, config.segment)]:
                live.append(tracker.infer(look, Limits(stages=2)).hypotheses)
                recorder.write_schedule(
                    scheduled(live[-1], config_hash(config.inference, config.segment, config.track))
                )
    assert [h.object_id for h in live] == [1, 2, 1]
    options = ["--prior", str(tmp_path / "tiny.safetensors"), "--config", str(tmp_path / "few.yaml"), "--schedule"]
    options += ["--out", str(tmp_path / "out"), *([] if wanted is None else ["--object", str(wanted)])]
    assert main(["replay", str(tmp_path / "log.mcap"), *options]) == 0
    chosen = [h for h in live if wanted in (None, h.object_id)]
    assert f"{len(chosen)} of {len(chosen)} inferences came out as they did" in capsys.readouterr().out
    written = {(int(path.parent.name), path.stem): digest(load(path)) for path in (tmp_path / "out").rglob("*.npz")}
    assert written == {(h.stamp_ns, f"object_{h.object_id}"): digest(h) for h in chosen}
