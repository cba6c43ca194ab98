"""Odd recordings and files are read, or refused or noted in words that name the cause; docs/tried.md lists them."""

import re
import struct
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from node.__main__ import main
from perception.sources.frame_folder import write_frame_folder
from tests.node.odd_inputs import FRAME, PAGE, READ, RGB, Odd, colour, depth, info, odd_inputs, page
from tests.perception.sources.test_recording import record

CASES = list(odd_inputs())


@pytest.mark.parametrize("case", CASES, ids=[f"{c.kind}: {c.name.encode('unicode_escape').decode()}" for c in CASES])
def test_an_odd_input_is_read_or_named(case: Odd, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    arguments, begun = case.write(tmp_path), time.monotonic()
    code = main(["segment", *arguments, "--out", str(tmp_path / "out")])
    out, error = capfd.readouterr()
    assert time.monotonic() - begun < 30.0
    if case.expected == READ:
        assert code == 0 and "object 2" in out and "farside: error" not in error, error
        return
    assert re.search(case.expected, error) and "--debug" not in error and "Traceback" not in error, error
    told = [line for line in error.splitlines() if line.startswith("farside: error: ")]
    assert len(told) == (code == 1) and all(str(tmp_path) in line and len(line) < 1600 for line in told)


def test_a_picture_that_claims_a_gigapixel_is_refused_at_once(tmp_path: Path) -> None:
    """In a process of its own: OpenCV reads the limit when it is imported."""
    write_frame_folder(tmp_path, FRAME)
    data = bytearray(cv2.imencode(".jpg", RGB)[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 32000, 32000)
    (tmp_path / "color.png").write_bytes(data)
    command = [sys.executable, "-m", "farside", "segment", str(tmp_path), "--out", str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1 and "color.png cannot be decoded (it says that it is larger than" in ended.stderr


@pytest.mark.parametrize("name", ["[red]a", "[/x]", ":smile:"])
def test_names_are_printed_as_they_are(name: str, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    write_frame_folder(tmp_path / "frame", FRAME)
    assert main(["segment", str(tmp_path / "frame"), "--out", str(tmp_path / name)]) == 0
    assert str(tmp_path / name / "label.png") in capfd.readouterr().out
    assert main(["record", str(tmp_path / "frame"), "--out", str(tmp_path / f"{name}.mcap")]) == 0
    assert f"{name}.mcap" in capfd.readouterr().out


def test_a_topic_that_cannot_be_read_costs_itself(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    other = colour(topic="/other/image_raw")
    path = record(tmp_path / "log", "mcap", [info(), colour(), depth(), other])
    (part,) = path.glob("*.mcap")
    _, kind, _, message = other
    store = get_typestore(Stores.ROS2_JAZZY)
    whole = bytes(store.serialize_cdr(message, kind))
    with part.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schemas: dict[str, int] = {}
        for topic, kind, stamp, message in (info(), colour(), depth(), other):
            if kind not in schemas:
                text = store.generate_msgdef(kind, ros_version=2)[0].encode()
                schemas[kind] = writer.register_schema(kind, "ros2msg", text)
            channel = writer.register_channel(topic, "cdr", schemas[kind])
            data = whole[:40] if topic.startswith("/other") else bytes(store.serialize_cdr(message, kind))
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    assert main(["segment", str(part), "--out", str(tmp_path / "out")]) == 0
    assert "messages on /other/image_raw that cannot be read are left out" in capfd.readouterr().err


def test_the_page_lists_them() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "write it with `python -m tests.node.odd_inputs`"
