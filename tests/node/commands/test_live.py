"""The whole node: a camera driver, Farside and a planner in three processes, and a recording that repeats it all."""

import io
import re
import signal
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE
from typing import Any

import jax
import numpy as np
import pytest
from rich.console import Console

from calibration.hand_eye import hand_eye
from calibration.pose_files import write_hand_eye
from node.__main__ import main
from node.commands.config_file import load_config
from node.commands.live import LiveNode
from node.commands.options import LiveConfig
from node.ros.bus import Bus
from node.ros.frame_tree import FrameTree
from node.ros.messages import HYPOTHESES, NEXT_VIEW, QUERY_REGION, hypotheses_from, make
from node.ros.planner_messages import SceneDifferences
from node.ros.publishers import Announcer
from node.ros.services import Answers
from node.ros.settings import BusConfig, PlannerConfig
from node.viewer.page import Page
from perception.answers.hypotheses import Hypotheses
from perception.inference.tracker import Look, Tracker
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.calibration.robots import CAMERA, posed_views
from tests.conftest import ROOT
from tests.node.commands.test_replay_whole import FEW
from tests.node.pretend_inference import pretend_live
from tests.node.shapes import body_with_handle, free_port
from tests.perception.cylinders import CAN, picture

LAUNCH = ROOT / "launch"


def test_the_launch_file_is_the_defaults() -> None:
    assert load_config(LAUNCH / "live.yaml", LiveConfig) == LiveConfig()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.mcap"], "nowhere.mcap does not exist"),
        (["oak"], "no OAK camera|oak"),
        (["webcam:99"], "webcam:99|camera 99"),
        (["--hand-eye", "/nowhere.yaml"], "nowhere.yaml: no such file; `farside hand-eye` writes one"),
        (["--budget", "0"], "the budget is 0 s; give more than 0"),
        ([str(SHIPPED_LOG), "--record", "/proc/none/a.mcap"], "/proc/none/a.mcap cannot be written|No such file"),
    ],
)
def test_what_is_not_there_is_one_line(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "live.yaml").write_text("bus: {listen: [tcp/127.0.0.1:0]}")  # another node may run on this machine
    assert main(["live", *arguments, "--config", str(tmp_path / "live.yaml")]) == 1
    said = capsys.readouterr().err
    assert said.startswith("farside: error: ") and said.count("\n") == 1 and re.search(says, said)


def test_a_page_shows_what_the_node_infers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """The shipped recording through reader, tracker, bus and page: hypotheses are given in place of the sampler's."""
    shown: list[tuple[int, dict[int, str], bytes]] = []
    port, show = free_port(), Page.show

    def seen(self: Page, scene: Any, view: Any) -> None:
        show(self, scene, view)
        with urllib.request.urlopen(self.address, timeout=10) as answer:
            shown.append((view.frame.stamp_ns, {h.object_id: h.result for h in scene}, answer.read()))

    def found(look: Look) -> list[Hypotheses]:
        stamp = {"stamp_ns": look._view.frame.stamp_ns, "object_id": look.object_id}
        return [body_with_handle(**stamp, result="underway"), body_with_handle(**stamp)]

    monkeypatch.setattr("node.commands.live.warm_up", lambda _: None)
    monkeypatch.setattr(Page, "show", seen)
    pretend_live(monkeypatch, found)
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    (tmp_path / "live.yaml").write_text("bus: {listen: [tcp/127.0.0.1:0]}")
    options = ["--prior", str(tmp_path / "tiny.safetensors"), "--config", str(tmp_path / "live.yaml")]
    result, mounted, mount = hand_eye(posed_views("in-hand", count=6), CAMERA), list[Any](), FrameTree.mount

    def place(self: FrameTree, bus: Bus, camera: Any) -> None:
        mount(self, bus, camera)
        mounted.append(self.T("tool0", "wrist", 0))

    monkeypatch.setattr(FrameTree, "mount", place)
    write_hand_eye(tmp_path / "hand_eye.yaml", result, "tool0", "wrist")
    options += ["--hand-eye", str(tmp_path / "hand_eye.yaml")]
    assert main(["live", str(SHIPPED_LOG), *options, "--page", str(port)]) == 0
    said = capsys.readouterr()
    np.testing.assert_allclose(mounted, [result.T_parent_camera], atol=1e-9)
    assert "--hand-eye places 'wrist', but pictures are of" in said.err and said.err.count("\n") <= 2
    assert f"http://127.0.0.1:{port} shows it" in said.out
    assert {stamp for stamp, _, _ in shown} <= {frame.stamp_ns for frame in Log(SHIPPED_LOG)}
    scenes = [scene for _, scene, _ in shown[:4]]  # of the first frame: first answers of all, then the last ones
    first, last = "underway", "converged"
    assert scenes == [{1: first}, {1: first, 2: first}, {1: last, 2: first}, {1: last, 2: last}]
    assert all(b"<html" in page for *_, page in shown)


def test_what_is_taken_from_the_table_is_taken_from_the_planners_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also the last object, when a picture shows that nothing stands there; a camera that sees nothing takes none."""
    told: list[list[tuple[str, int]]] = []
    differences = SceneDifferences("/farside", PlannerConfig())

    def hear(self: Announcer, objects: Any, *_: Any) -> None:
        if (message := differences.message(objects)) is not None:
            told.append([(it.id, it.operation) for it in message.world.collision_objects])
            differences.sent()

    monkeypatch.setattr(Announcer, "scene", hear)
    monkeypatch.setattr(LiveNode, "_tell_status", lambda _: None)
    pretend_live(monkeypatch, lambda look: 2 * [replace(body_with_handle(), object_id=look.object_id)])
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    said, answers = Console(file=io.StringIO()), Answers()
    nobody: Any = None  # reads or keeps frames
    with Bus(BusConfig()) as bus:
        tracker, announcer = Tracker(load_prior(tmp_path / "tiny.safetensors")), Announcer(bus)
        node = LiveNode(LiveConfig(), tracker, announcer, answers, nobody, nobody, None, said)
        empty = picture(label=False)
        node.take(picture(CAN, label=False), said)
        assert answers.scene.objects and told == [[("farside_object_1", 0)]]
        node.take(replace(empty, depth=np.full_like(empty.depth, np.nan)), said)
        assert answers.scene.objects and len(told) == 1
        node.take(empty, said)
    assert told[1:] == [[("farside_object_1", 1)]]
    with pytest.raises(ValueError, match="there are no hypotheses"):
        _ = answers.scene


def wait_for(planner: Bus, name: str, kind: str, request: Any, seconds: float = 200.0) -> Any:
    """The first response that is a success."""
    until, why = time.monotonic() + seconds, ""
    while time.monotonic() < until:
        try:
            response = planner.call(name, kind, request, timeout_s=5.0)
        except (OSError, TimeoutError) as error:
            why = str(error)
        else:
            if response.success:
                return response
            why = response.message
        time.sleep(0.2)
    raise AssertionError(why)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_driver_the_node_and_a_planner_in_three_processes(tmp_path: Path) -> None:
    save_prior(tmp_path / "tiny.safetensors", ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    port = free_port()
    config = tmp_path / "live.yaml"
    config.write_text(f"bus: {{listen: [tcp/127.0.0.1:{port}]}}\ntrack: {{moved_below: 0.0}}\n{FEW}")
    log, endpoint = tmp_path / "live.mcap", f"tcp/127.0.0.1:{port}"
    options = ["--config", str(config), "--prior", str(tmp_path / "tiny.safetensors")]
    live = [sys.executable, "-m", "node", "live", "topic", "--record", str(log), *options]
    driver = [sys.executable, "-m", "tests.node.driver", endpoint, str(SHIPPED_LOG), "10"]
    errors = tmp_path / "errors"  # a file: a pipe that nobody reads would fill and stop the node
    with (
        errors.open("w") as stderr,
        subprocess.Popen(live, cwd=ROOT, stdout=PIPE, stderr=stderr, text=True) as node,
    ):
        try:
            assert "is up" in node.stdout.readline()
            with (
                subprocess.Popen(driver, cwd=ROOT, stdout=PIPE, text=True) as camera,
                Bus(BusConfig(name="planner", connect=(endpoint,))) as planner,
            ):
                heard: list = []
                planner.subscribe("/farside/hypotheses", HYPOTHESES, heard.append)
                asked = make(f"{QUERY_REGION}_Request", kind=1, points=np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.7]))
                asked.header.frame_id = "camera"
                response = wait_for(planner, "/farside/query_region", QUERY_REGION, asked)
                nowhere = response.outside_fraction == 1.0  # outside of both objects' cubes
                assert np.isnan(response.p_free) if nowhere else 0.0 <= response.p_free <= 1.0
                assert len(response.p_occupied) == 2
                assert response.objects >= 1 and response.age < 100.0
                views = make(f"{NEXT_VIEW}_Request", count=3)
                views.header.frame_id = "camera"
                ranked = wait_for(planner, "/farside/next_view", NEXT_VIEW, views)
                assert len(ranked.poses) == 3 and (np.diff(ranked.gain_nats) <= 0).all()
                until = time.monotonic() + 100.0
                while (done := _converged(heard)) != {1, 2} and time.monotonic() < until:
                    time.sleep(0.2)
                assert done == {1, 2}
                assert any("/farside" in entity for entity in planner.graph())
                camera.kill()
            node.send_signal(signal.SIGINT)
            said = node.stdout.read()
            assert node.wait(60.0) == 0, errors.read_text()
        finally:
            node.kill()
    received, _, inferred = (int(n) for n in re.search(r"(\d+) frames, (\d+) looked at, (\d+) inferred", said).groups())
    recorded = list(Log(log))
    assert len(recorded) == received and "0 dropped" in said  # every frame that came is in the recording
    assert inferred >= 2
    # and the recording repeats what was inferred live
    again = ["replay", str(log), "--schedule", *_for_replay(options, tmp_path), "--out", str(tmp_path / "out")]
    # a process of its own: with another number of devices sums are rounded otherwise
    ended = subprocess.run([sys.executable, "-m", "node", *again], cwd=ROOT, capture_output=True, text=True, check=True)
    assert f"{inferred} of {inferred} inferences came out as they did" in ended.stdout, ended.stdout


def _converged(messages: list) -> set[int]:
    """The objects of which a last answer came."""
    return {h.object_id for h in map(hypotheses_from, messages) if h.result == "converged"}


def _for_replay(options: list[str], folder: Path) -> list[str]:
    """The same configuration without what only the live node has."""
    path = folder / "replay.yaml"
    path.write_text("\n".join(line for line in Path(options[1]).read_text().splitlines() if not line.startswith("bus")))
    return ["--config", str(path), *options[2:]]
