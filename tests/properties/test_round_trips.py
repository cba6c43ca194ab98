"""What is written and read again, or sent and received, comes back: every field of it.

The fields are taken from the dataclasses. One that is added later and has no place in a file or message fails here.
"""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.camera import Camera
from calibration.camera_file import read_camera, write_camera
from node.ros.messages import HYPOTHESES, decode, encode, hypotheses_from, hypotheses_message
from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import load, save
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder, write_frame_folder
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.schedule_entry import Scheduled
from perception.sources.settings import RecordConfig
from tests.properties.drawn import assert_same, cameras, every_field, frames, hypotheses, law, slower_law, stamps

QUATERNION = 1e-12  # what a rotation loses on its way through a quaternion


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("round trips")


@law
@given(hypotheses())
def test_hypotheses_on_the_bus(h: Hypotheses) -> None:
    back = hypotheses_from(decode(bytes(encode(hypotheses_message(h, "tempered_smc"))), HYPOTHESES))
    assert_same(h, back, {"T_camera_object": QUATERNION, "T_world_camera": QUATERNION})


@law
@given(h=hypotheses())
def test_a_hypotheses_file(folder: Path, h: Hypotheses) -> None:
    save(folder / "object_1.npz", h)
    assert_same(h, load(folder / "object_1.npz"))


@law
@given(camera=cameras())
def test_a_camera_file(folder: Path, camera: Camera) -> None:
    write_camera(folder / "camera.yaml", camera)
    assert_same(camera, read_camera(folder / "camera.yaml"))


@law
@given(frame=frames())
def test_a_frame_folder(folder: Path, frame: Frame) -> None:
    write_frame_folder(folder / "frame", frame)
    assert_same(frame, read_frame_folder(folder / "frame"), {"depth": 0.501e-3})


@slower_law
@given(frame=frames(), colour=st.sampled_from(["raw", "png"]), compression=st.sampled_from(["none", "lz4", "zstd"]))
def test_a_frame_in_a_recording(folder: Path, frame: Frame, colour: str, compression: str) -> None:
    """All but the camera's deviations, for which ROS has no place."""
    path = folder / "log.mcap"
    path.unlink(missing_ok=True)
    with Recorder(path, RecordConfig(colour=colour, compression=compression), wait=True) as recorder:
        recorder.write_frame(frame)
    (back,) = Log(path)
    camera = replace(frame.camera, K_std=None, distortion_std=None, rms=None)
    assert_same(replace(frame, camera=camera), back, {"T_world_camera": QUATERNION})


@law
@given(every_field(Scheduled, stamp_ns=stamps))
def test_an_entry_of_a_schedule(entry: Scheduled) -> None:
    assert_same(entry, Scheduled.from_json(entry.to_json()))
