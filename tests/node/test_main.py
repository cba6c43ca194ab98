"""The command: help that reads, answers that parse, and for bad input one line, a code, and nothing left behind."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest
import trimesh

from node.__main__ import COMMANDS, main
from perception.answers.hypotheses_file import load, load_scene, save
from perception.inference.limits import Limits
from perception.sources.frame import Frame
from perception.sources.recorder import write_log
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.types import StopReason
from tests.node.mugs import MUG, mug_hypotheses, table_frame, write_folder
from tests.node.pretend_inference import Asked

BOX = ["--box", "-0.02", "-0.02", "0", "0.02", "0.02", "0.05"]


@pytest.fixture(scope="module")
def frame() -> Frame:
    return table_frame()


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained weights: nothing here depends on what they say."""
    path = tmp_path_factory.mktemp("prior") / "tiny.safetensors"
    save_prior(path, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    return path


@pytest.fixture
def folder(tmp_path: Path, frame: Frame) -> Path:
    return write_folder(tmp_path / "table", frame)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    stand_in = Asked()
    monkeypatch.setattr("node.commands.replay.inference_of", stand_in)
    monkeypatch.setattr("node.commands.replay.draw_object", lambda path, *_: path.touch())
    return stand_in


def one_line(error: str) -> str:
    """The complaint; fails unless it is a single clear line."""
    lines = [line for line in error.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1 and lines[0].startswith("farside: error: ") and "Traceback" not in error, error
    return lines[0]


def test_replay_writes_a_file_and_a_picture_per_object(
    folder: Path, tmp_path: Path, prior: Path, asked: Asked, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "new" / "out"
    assert main(["replay", str(folder), "--prior", str(prior), "--out", str(out), "--budget", "100"]) == 0
    said = capsys.readouterr().out
    files = ["frame", "object_1.npz", "object_1.png", "object_2.npz", "object_2.png"]
    assert sorted(p.name for p in out.iterdir()) == files
    for word in ("object 1", "time", "ESS", "log evidence", "unseen space", "acceptance", "stopped"):
        assert word in said
    assert str(out / "object_2.png") in said
    assert [h.object_id for h in load_scene(out)] == [1, 2]
    first, second = (call["limits"].deadline - time.monotonic() for call in asked.calls)
    assert 50 < first < 95 and first == pytest.approx(second, abs=0.1)  # one budget, less what the pictures take
    assert asked.calls[0]["prior"].model.preset.name == "tiny"


def test_options_win_over_the_file_and_reach_the_sampler(
    folder: Path, tmp_path: Path, prior: Path, asked: Asked
) -> None:
    config = tmp_path / "my.yaml"
    config.write_text(
        f"source: {folder}\nprior: {prior}\nseed: 5\nstages: 3\nout: {tmp_path / 'out'}\nobject: 2\n"
        "method: annealed_hmc\ncontroller: {hypotheses: 9}\n"
    )
    assert main(["replay", "--config", str(config), "--stages", "4", "--controller.runs", "2"]) == 0
    (call,) = asked.calls
    assert (call["id"], call["seed"], call["limits"]) == (2, 5, Limits(stages=4))
    assert (call["config"].hypotheses, call["config"].runs, call["config"].infer.method) == (9, 2, "annealed_hmc")
    assert load(tmp_path / "out" / "object_2.npz").seed == 5


def test_a_folder_holds_one_frame(folder: Path, tmp_path: Path, prior: Path, asked: Asked, frame: Frame) -> None:
    """Objects of other frames leave it, those of the same frame stay where one object was asked for."""
    out = tmp_path / "out"
    run = ["replay", str(folder), "--prior", str(prior), "--out", str(out), "--stages", "1"]
    assert main(run) == 0
    stale = replace(load(out / "object_1.npz"), stamp_ns=77, object_id=9)
    save(out / "object_9.npz", stale)
    (out / "object_9.png").touch()
    (out / "object_mine.npz").touch()
    assert main([*run, "--object", "1"]) == 0
    names = ["frame", "object_1.npz", "object_1.png", "object_2.npz", "object_2.png", "object_mine.npz"]
    assert sorted(p.name for p in out.iterdir()) == names


def test_one_object_that_fails_does_not_stop_the_others(
    tmp_path: Path, frame: Frame, prior: Path, asked: Asked, capsys: pytest.CaptureFixture
) -> None:
    label = frame.label.astype(np.uint8)
    label[label == 0] = np.where(np.isfinite(frame.depth[label == 0]), 3, 0)  # the table is no object of this size
    folder = write_folder(tmp_path / "table", frame, label=label)
    out = tmp_path / "out"
    assert main(["replay", str(folder), "--prior", str(prior), "--out", str(out), "--stages", "1"]) == 0
    assert "object 3 is left out: " in capsys.readouterr().err
    assert sorted(p.name for p in out.glob("*.npz")) == ["object_1.npz", "object_2.npz"]
    assert main(["replay", str(folder), "--object", "3", "--prior", str(prior), "--out", str(tmp_path / "no")]) == 1
    assert "tabletop objects are" in one_line(capsys.readouterr().err) and not (tmp_path / "no").exists()


def test_ctrl_c_keeps_what_is_there(folder: Path, tmp_path: Path, prior: Path, asked: Asked) -> None:
    asked.result = StopReason.INTERRUPTED
    out = tmp_path / "out"
    assert main(["replay", str(folder), "--prior", str(prior), "--out", str(out)]) == 130
    files = ["frame", "object_1.npz", "object_1.png", "object_2.npz", "object_2.png"]
    assert sorted(p.name for p in out.iterdir()) == files
    assert {h.result for h in load_scene(out)} == {"interrupted"}


@pytest.mark.usefixtures("asked")
def test_ctrl_c_while_a_picture_is_drawn_keeps_what_is_there(
    folder: Path, tmp_path: Path, prior: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("node.commands.replay.draw_object", Mock(side_effect=KeyboardInterrupt))
    out = tmp_path / "out"
    assert main(["replay", str(folder), "--prior", str(prior), "--out", str(out)]) == 130
    assert sorted(p.name for p in out.glob("object_*")) == ["object_1.npz", "object_2.npz"]


def test_a_recording_gives_the_asked_frame(
    tmp_path: Path, frame: Frame, prior: Path, asked: Asked, capsys: pytest.CaptureFixture
) -> None:
    log = tmp_path / "three.mcap"
    write_log(log, [replace(frame, stamp_ns=10**9 * i) for i in (1, 2, 3)])
    run = ["replay", str(log), "--prior", str(prior), "--stages", "1", "--object", "1", "--out", str(tmp_path / "out")]
    for k, stamp in (("0", 1), ("-1", 3), ("1", 2)):
        assert main([*run, "--frame", k]) == 0
        assert load(tmp_path / "out" / "object_1.npz").stamp_ns == 10**9 * stamp
    capsys.readouterr()
    assert main([*run, "--frame", "3"]) == 1
    assert "three.mcap has 3 frames, no number 3; give 0 to 2" in one_line(capsys.readouterr().err)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: int(0.8 * log.stat().st_size)])
    assert main([*run[:1], str(cut), *run[2:]]) == 0
    assert "note: cut.mcap is cut short" in capsys.readouterr().err


def _spoil(folder: Path, what: str, frame: Frame) -> None:
    """Damage a frame folder."""
    import cv2

    if what == "truncated colour":
        path = folder / "color.png"
        path.write_bytes(path.read_bytes()[:500])
    elif what == "other size":
        cv2.imwrite(str(folder / "depth.png"), np.ones((90, 120), np.uint16))
    elif what == "no depth":
        cv2.imwrite(str(folder / "depth.png"), np.zeros((180, 240), np.uint16))
    elif what == "tiny mask":
        label = np.zeros((180, 240), np.uint8)
        label[100:103, 100:103] = 1
        cv2.imwrite(str(folder / "label.png"), label)
    elif what == "too large":
        meta = json.loads((folder / "meta.json").read_text())
        (folder / "meta.json").write_text(json.dumps({**meta, "depth_unit_m": 0.006}))
    elif what == "no matrix":
        (folder / "meta.json").write_text('{"depth_unit_m": 0.001}')


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("truncated colour", r"color\.png cannot be decoded \(it is cut short at byte 500\); copy it again"),
        ("other size", r"depth\.png is 120x90 px but the colour is 240x180; align"),
        ("no depth", r"no pixel of 43200 has depth; check the depth sensor"),
        ("tiny mask", r"object 1 has 9 pixels, .* at least 50 are needed: move the camera nearer"),
        ("too large", r"object 1 measures .* cm across and .* tabletop objects are .*: give another object"),
        ("no matrix", r"meta\.json has no camera_matrix_px; add it"),
    ],
)
def test_a_bad_frame_folder_is_named(
    folder: Path,
    tmp_path: Path,
    frame: Frame,
    prior: Path,
    asked: Asked,
    capsys: pytest.CaptureFixture,
    what: str,
    says: str,
) -> None:
    _spoil(folder, what, frame)
    out = tmp_path / "out"
    assert main(["replay", str(folder), "--object", "1", "--prior", str(prior), "--out", str(out)]) == 1
    assert re.search(says, one_line(capsys.readouterr().err))
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["replay", "nowhere"], "nowhere does not exist; give oak"),
        (["replay", "{table}", "--object", "12"], "no object 12; its objects: 1, 2"),
        (["replay", "{table}", "--budget", "0"], "the budget is 0 s; give more than 0"),
        (["replay", "{table}", "--stages", "0"], "stages is 0; give 1 or more"),
        (["replay", "{table}", "--out", "{text}"], "notes.txt is a file; give a folder"),
        (["replay", "{table}", "--out", "{text}/below"], "below is a file, or in one; give a folder"),
        (["replay", "{table}", "--prior", "{text}"], "notes.txt is not a readable prior"),
        (["replay", "{table}", "--prior", "{other}"], "needs ["),
        (["replay", "{table}", "--prior", "none.safetensors"], "none.safetensors: no such prior"),
        (["replay", "{table}", "--config", "{yaml}"], "my.yaml: unknown key stges; did you mean stages?"),
        (["replay", "{log}"], "cut.mcap holds no readable message; record it again"),
        (["replay", "{text}"], "notes.txt cannot be read as a recording"),
        (["query", "none.npz", *BOX], "none.npz: no such file; `farside replay` writes"),
        (["query", "{text}", *BOX], "notes.txt is not a hypotheses file"),
        (["query", "{table}", *BOX], "table holds no object_<id>.npz"),
        (["query", "{mug}"], "needs one of --box X0 Y0 Z0 X1 Y1 Z1, --points FILE.xyz and --mesh"),
        (["query", "{mug}", *BOX, "--points", "p.xyz"], "needs one of --box"),
        (["query", "{mug}", "--box", "0", "0", "0", "1", "-1", "1"], "the box is empty: y1 = -1 is not greater"),
        (["query", "{mug}", *BOX, "--risk", "0.6"], "risk is 0.6; give the chance of being wrong"),
        (["query", "{mug}", "--points", "p.xyz"], "p.xyz: no such file; give a text file"),
        (["query", "{mug}", "--mesh", "{text}"], "notes.txt is no mesh by its name"),
        (["query", "{mug}", *BOX, "--frame", "world"], "without the camera's pose in the world"),
        (["view", "{text}"], "notes.txt is not a hypotheses file"),
        (["view", "{mug}", "--port", "70000"], "port 70000 does not exist; give one of 0 to 65535"),
        (["view", "{mug}", "--out", "{table}"], "table is a folder; give a file for --out"),
    ],
)
def test_bad_input_gets_one_line(
    folder: Path,
    tmp_path: Path,
    frame: Frame,
    prior: Path,
    asked: Asked,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    places = {
        name: tmp_path / file
        for name, file in (
            ("table", "table"),
            ("text", "notes.txt"),
            ("other", "other.safetensors"),
            ("yaml", "my.yaml"),
            ("log", "cut.mcap"),
            ("mug", "mug.npz"),
        )
    }
    places["text"].write_text("no prior, no picture\n")
    places["yaml"].write_text("stges: 3\n")
    if "{other}" in arguments:  # its arrays are not those of the preset that it names
        save_prior(places["other"], ProbNeRF(replace(PRESETS["tiny"], latent=6), jax.random.key(0)), {})
    if "{log}" in arguments:
        write_log(places["log"], [frame])
        places["log"].write_bytes(places["log"].read_bytes()[:60])
    if "{mug}" in arguments:
        save(places["mug"], _any_hypotheses(frame))
    before = sorted(tmp_path.rglob("*"))
    given = [a.format(**places) for a in arguments]
    if arguments[0] == "replay" and "--prior" not in given:
        given += ["--prior", str(prior)]
    assert main(given) == 1
    assert says in one_line(capsys.readouterr().err)
    assert sorted(tmp_path.rglob("*")) == before  # nothing was written
    with pytest.raises((ValueError, OSError)):
        main(["--debug", *given])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["replay", "--budgt", "3"], "--budget"),
        (["replay", "--method", "nuts"], "annealed_hmc"),
        (["replay", "--seed", "x"], "--seed"),
        (["replya"], "replay"),
        (["query"], "FILE"),
        (["bench", "hiden"], "hidden"),
    ],
)
def test_a_mistyped_option_names_the_right_one(capsys: pytest.CaptureFixture, arguments: list[str], says: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err
    assert ended.value.code == 2 and says in error and "Traceback" not in error


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_help_reads_well(capsys: pytest.CaptureFixture, command: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    text = capsys.readouterr().out
    assert ended.value.code == 0 and f"usage: farside {' '.join(command)}".strip() in text
    if command in (["replay"], ["query"], ["view"]):
        assert "None" not in text
    if not command:
        assert all(name in text for name in COMMANDS)
        with pytest.raises(SystemExit):
            main([])
        assert capsys.readouterr().out == text


def _any_hypotheses(frame: Frame):
    from perception.observation.segmentation import segment

    return mug_hypotheses(frame, segment(frame, 1)[0], [1.0, -1.0], [0.75, 0.25], 16)


def test_query_answers_in_json_and_in_words(tmp_path: Path, frame: Frame, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "object_1.npz"
    save(path, _any_hypotheses(frame))
    assert main(["query", str(path), *BOX, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    keys = {"p_free", "p_free_se", "volume_m3", "unseen_fraction", "outside_fraction", "entropy_nats"}
    assert keys | {"effective_hypotheses"} <= set(answer) and "p_occupied" not in answer
    assert set(answer["volume_m3"]) == {"q05", "q50", "q95"}
    assert answer["verdict"] == "unsure"  # two hypotheses tell no chance of 1 in 20
    assert answer["p_free"] == 0.0 or 0 <= answer["p_free"] <= 1
    points = tmp_path / "p.xyz"
    low = -0.7 * MUG.half_extent  # in the mug's floor
    points.write_text(f"0 0 {low}\n0 0 0.9\n")
    assert main(["query", str(tmp_path), "--points", str(points), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["p_occupied"] == [pytest.approx(0.95, abs=0.05), 0.0] and answer["outside_fraction"] == 0.5
    floor = trimesh.creation.box((0.01, 0.01, 0.01))
    floor.apply_translation([0.0, 0.0, low])
    floor.export(tmp_path / "floor.stl")
    assert main(["query", str(tmp_path), "--mesh", str(tmp_path / "floor.stl"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["p_free"] == 0.0 and set(answer["blocked_by"]) == {"1"}
    assert main(["query", str(path), "--points", str(points), "--frame", "camera"]) == 0
    said = capsys.readouterr().out
    assert "verdict at a risk of 0.05" in said and "all of it is free" in said
    assert "point 2: occupied with probability" in said and "more points" not in said
    points.write_text("0 0 0\n" * 3000)
    assert main(["query", str(path), "--points", str(points)]) == 0
    said = capsys.readouterr().out
    assert "and 2900 more points, which --json lists" in said and "point 100:" in said and "point 101:" not in said
