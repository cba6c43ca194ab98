"""The examples do what their docstrings say."""

import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import farside
from farside import api
from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, QUERY_REGION, hypotheses_message
from node.ros.services import Answers
from node.ros.settings import BusConfig
from tests.node.mugs import mug_hypotheses, table_frame
from tests.node.shapes import body_with_handle, free_port
from tests.test_architecture import ROOT


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Callable]:
    """The `main` of an example, found as Python finds what stands beside a script."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "examples"), *sys.path])
    return lambda name: runpy.run_path(str(ROOT / "examples" / f"{name}.py"))["main"]


def test_one_frame(
    example: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    frame = table_frame()
    h = mug_hypotheses(frame, farside.segment(frame, 1)[0], [1.0, -1.0], [0.75, 0.25], 16)
    monkeypatch.setattr(api, "read_frame", lambda source: frame)
    monkeypatch.setattr(api, "estimate", lambda frame, **_: farside.Scene((h,), {7: "too small"}))
    example("01_one_frame")(out=str(tmp_path))
    output = capsys.readouterr().out
    assert "object 1: 2 hypotheses (2 effective); the heaviest is" in output
    assert "object 7 is left out: too small" in output
    assert len(farside.load(tmp_path)) == 1


def test_query_boxes(example: Callable, tmp_path: Path) -> None:
    """The body's handle points to the camera with 0.3 and away from it with 0.7; beside it there is nothing."""
    (file,) = farside.save(tmp_path, body_with_handle())
    answers = example("02_query_boxes")(str(file), distance=0.62)
    assert answers["towards the camera"].p_free == pytest.approx(0.7)
    assert answers["behind it"].p_free == pytest.approx(0.3)
    assert answers["left of it"].p_free == answers["right of it"].p_free == 1.0


@pytest.mark.slow
def test_own_objects(example: Callable, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    example("03_own_objects")(run=str(tmp_path / "run"), steps=20)
    assert "object 1 is" in capsys.readouterr().out


def test_reach_planner_takes_a_way_that_is_free_enough_and_no_doubtful_one(
    example: Callable, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Of a file and of a running node alike; the goal lies where the handle is with 0.7."""
    h, main = body_with_handle(), example("04_reach_planner")
    (file,) = farside.save(tmp_path, h)
    answers, endpoint = Answers(), f"tcp/127.0.0.1:{free_port()}"
    answers.update([h])
    with Bus(BusConfig(name="farside", listen=(endpoint,))) as bus:
        bus.serve("~/query_region", QUERY_REGION, answers.query_region)
        for source in ({"file": file}, {"connect": endpoint}):
            main((0.0, 0.10, 0.0), **source)
            assert "taken: from" in capsys.readouterr().out
            main((-0.07, 0.0, 0.0), **source)
            output = capsys.readouterr().out
            assert "free with 0.30" in output and "no way is free enough" in output
            main((-0.07, 0.0, 0.0), least=0.25, **source)
            assert "taken: from" in capsys.readouterr().out


def test_ompl_plans_against_each_thing_that_planners_get(
    example: Callable, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """In unseen space: a goal clear of both handles that there may be, one in a handle with 0.3, one in the body.

    By a file and by a running node in turn. OMPL waits out its time where a goal is not clear.
    """
    pytest.importorskip("ompl")
    h, main, endpoint = body_with_handle(), example("05_ompl_planner"), f"tcp/127.0.0.1:{free_port()}"
    careful = {"Farside", "MoveIt's mesh", "nvblox's distances"}
    file = farside.save(tmp_path, h)[0]
    beside = main((0.0, -0.3, 0.0), (0.0, 0.1, 0.0), seconds=2.0, file=file)
    with Bus(BusConfig(name="farside", listen=(endpoint,))) as bus:
        publisher = bus.publisher("~/hypotheses", HYPOTHESES, latched=True, depth=8)
        publisher.publish(hypotheses_message(h))
        handle = main((0.0, 0.3, 0.0), (0.07, 0.03, 0.0), seconds=0.5, connect=endpoint)
    inside = main((0.0, 0.3, 0.0), (0.0, 0.025, 0.0), seconds=0.5, file=file)
    assert set(beside) == careful | {"unknown is free", "unknown is occupied", "octomap"}
    found = [{rule: answer and answer.p_free for rule, answer in way.items()} for way in (beside, handle, inside)]
    assert all(way["unknown is occupied"] is None for way in found)
    assert all(found[0][rule] == 1.0 for rule in (*careful, "octomap"))
    assert all(way[rule] is None for way in found[1:] for rule in careful)
    assert found[1]["octomap"] == pytest.approx(0.7)  # MoveIt goes where P(occupied) is below a half
    assert found[2]["octomap"] is None and found[2]["unknown is free"] == 0.0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 21 and lines[0].split() == ["by", "way,", "cm", "P(free)"]


def test_ompl_planner_says_what_it_needs(example: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file,) = farside.save(tmp_path, body_with_handle())
    monkeypatch.setitem(sys.modules, "ompl", None)
    with pytest.raises(SystemExit, match="OMPL is not installed; this example needs it: pip install ompl"):
        example("05_ompl_planner")((0.0, -0.3, 0.0), (0.0, 0.1, 0.0), file=file)
