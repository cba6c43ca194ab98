"""A schedule is read as it was written, and refused where it cannot be followed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perception.inference.schedule import config_hash, digest, scheduled
from perception.inference.settings import ControllerConfig
from perception.observation.settings import MaskConfig, SegmentConfig
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.schedule_entry import SCHEDULE_TOPIC, Scheduled
from tests.perception.answers.test_query import _fill, _object
from tests.perception.sources.test_recorder import START, frame

ENTRY = Scheduled(START, 3, 7, 2**40, "a" * 16, "b" * 16, "c" * 16, "tracked")


def test_a_recording_gives_its_schedule_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    later = replace(ENTRY, stamp_ns=frame(1).stamp_ns, started_from="fresh")
    with Recorder(path) as recorder:
        for i in range(3):
            recorder.write_frame(frame(i))
        for entry in (ENTRY, replace(ENTRY, object_id=4), later):
            recorder.write_schedule(entry)
    log = Log(path)
    assert log.schedule() == [ENTRY, replace(ENTRY, object_id=4), later] and len(list(log)) == 3
    whole = log.schedule()
    path.write_bytes(path.read_bytes()[:-30])  # as after a kill
    assert "cut short" in Log(path).notes[0] and Log(path).schedule() == whole


def written(path: Path, text: str) -> Log:
    from perception.sources.recorder import _TYPES, _definition

    kind = "std_msgs/msg/String"
    with Recorder(path) as recorder:
        recorder.write_frame(frame(0))
        recorder.write_raw(
            SCHEDULE_TOPIC, kind, _definition(kind), _TYPES.serialize_cdr(_TYPES.types[kind](text), kind), 0
        )
    return Log(path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": 2}, "a.mcap: the schedule has version 2, and this Farside follows 1: update Farside"),
        ({"version": None}, "the schedule has version None"),
        ({"stages": 2.5}, "has stages 2.5; record it again"),
        ({"seed": True}, "has seed True"),
        ({"digest": 3}, "has digest 3"),
        ({"started_from": "dreams"}, "started from 'dreams': update Farside"),
        ({"colour": "red"}, "has fields ['colour', 'config_hash'"),
    ],
)
def test_an_entry_that_cannot_be_followed_is_named(tmp_path: Path, change: dict, says: str) -> None:
    log = written(tmp_path / "a.mcap", json.dumps({**json.loads(ENTRY.to_json()), **change}))
    with pytest.raises(ValueError) as caught:
        log.schedule()
    assert says in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "hello", "{}"])
def test_what_is_no_entry_is_named(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match="is not an entry of a schedule"):
        written(tmp_path / "a.mcap", text).schedule()


def test_an_entry_names_what_came_out() -> None:
    h = _object([_fill(((0, 0, 0), (4, 4, 4))), _fill(((0, 0, 0), (2, 2, 2)))], [0.5, 0.5])
    entry = scheduled(h, "b" * 16)
    assert (entry.stamp_ns, entry.object_id, entry.stages, entry.seed) == (h.stamp_ns, 1, h.stage, h.seed)
    assert (entry.prior_hash, entry.started_from) == (h.prior_hash, "fresh")
    assert entry.digest == digest(replace(h, label="a mug"))
    opacity = h.opacity.copy()
    opacity[1, 2, 3, 4] ^= 1
    others = [replace(h, opacity=opacity), replace(h, weights=np.array([0.5 + 1e-12, 0.5 - 1e-12]))]
    assert len({entry.digest, *map(digest, others)}) == 3


def test_a_configuration_is_named_by_its_values() -> None:
    one = config_hash(ControllerConfig(), SegmentConfig())
    assert one == config_hash(ControllerConfig(), SegmentConfig()) and len(one) == 16
    assert one != config_hash(ControllerConfig(), SegmentConfig(above=0.009))
    assert one != config_hash(ControllerConfig(hypotheses=47), SegmentConfig())


def test_a_configuration_with_a_path_has_a_hash() -> None:
    def of(name: str) -> str:
        return config_hash(SegmentConfig(mask=MaskConfig(background=Path(name))))

    assert of("empty.png") == of("empty.png") != of("other.png")
