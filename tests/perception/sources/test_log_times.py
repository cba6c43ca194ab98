"""Log times rise whatever the camera's clock does; a recording whose times tell nothing is read in little memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from perception.sources import log_messages
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.settings import RecordConfig
from tests.perception.sources.test_recorder import START, frame, record, same


def log_times(path: Path) -> list[int]:
    with path.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    return list(dict.fromkeys(times))  # messages of a frame share a time


def test_log_times_rise_where_the_cameras_clock_jumps_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written = [replace(frame(i), stamp_ns=START + 33_000_000 * i - 10_000_000_000 * (i > 2)) for i in range(6)]
    record(path, written)
    times = log_times(path)
    assert len(times) == 5 and (np.diff(times) == 33_000_000).all()  # the fourth frame has the third one's
    log = Log(path)
    for read, was in zip(log, written, strict=True):
        same(read, was)
    assert "stamps jump back by 9.97 s" in log.notes[-1]


def test_a_clock_that_jumps_to_and_fro_carries_log_times_nowhere(tmp_path: Path) -> None:
    stamps = [(START if i % 2 else 5_000_000_000) + 33_000_000 * i for i in range(12)]
    record(tmp_path / "a.mcap", [replace(frame(i), stamp_ns=stamp) for i, stamp in enumerate(stamps)])
    assert max(log_times(tmp_path / "a.mcap")) == max(stamps) and len(list(Log(tmp_path / "a.mcap"))) == 12


def test_frames_that_overtake_each_other_shift_no_later_one(tmp_path: Path) -> None:
    stamps = [START + 33_000_000 * i for i in (0, 2, 1, 3, 4)]
    record(tmp_path / "a.mcap", [replace(frame(i), stamp_ns=stamp) for i, stamp in enumerate(stamps)])
    assert log_times(tmp_path / "a.mcap") == [START + 33_000_000 * i for i in (0, 2, 3, 4)]


def test_a_recording_that_knows_one_time_only_is_not_read_all_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of converters that leave log times empty, and of this recorder once, whose clock had been set back."""
    path, written = tmp_path / "a.mcap", [frame(i) for i in range(6)]
    monkeypatch.setattr(Recorder, "_follow", lambda self, stamp_ns: None)
    add = Writer.add_message
    monkeypatch.setattr(Writer, "add_message", lambda self, channel, at, *rest: add(self, channel, START, *rest))
    record(path, written, RecordConfig(chunk_bytes=20_000))
    assert not Log(path).notes  # it is small
    monkeypatch.setattr(log_messages, "_MOST_MERGED", 40_000)
    log = Log(path)
    assert log.notes == ["a.mcap: its times of recording do not tell an order; messages are read as they lie"]
    for read, was in zip(log, written, strict=True):
        same(read, was)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1  # within a chunk
    path.write_bytes(data)
    log = Log(path)
    assert 0 < len(list(log)) < 6 and "a.mcap is damaged (" in log.notes[1] and "recovered" in log.notes[1]


def test_topics_that_lie_one_after_the_other_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However large: only their times tell what belongs together."""
    monkeypatch.setattr(log_messages, "_MOST_MERGED", 0)
    path, written = tmp_path / "a.mcap", [frame(i) for i in range(6)]
    record(tmp_path / "b.mcap", written)
    with (tmp_path / "b.mcap").open("rb") as stream, path.open("wb") as out:
        messages = sorted(make_reader(stream).iter_messages(), key=lambda each: each[1].topic)
        writer = Writer(out, chunk_size=20_000)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for schema, channel, message in messages:
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", kind)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    log = Log(path)
    for read, was in zip(log, written, strict=True):
        same(read, was)
    assert not any("as they lie" in note for note in log.notes)
