"""A holistic recording of DepthAI is read as far as it goes, and an OAK camera's depth is set up as chosen."""

import time
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import depthai as dai
import numpy as np
import pytest

from perception.sources.oak import camera_of_device_json, set_up
from perception.sources.open_source import open_source
from perception.sources.pictures import open_pictures
from perception.sources.settings import OakConfig, OakPreset
from tests.perception.recorded import write_device_json
from tests.perception.sources.test_recording import CAMERA

SIZE = (320, 240)


class Sender(dai.node.ThreadedHostNode):
    """A grey that gets lighter, as the frames of a camera."""

    def __init__(self) -> None:
        super().__init__()
        self.out = self.createOutput()

    def run(self) -> None:
        for i in range(30):
            message = dai.ImgFrame()
            message.setFrame(np.full((SIZE[1], SIZE[0], 3), 8 * i + 8, np.uint8))
            message.setWidth(SIZE[0]).setHeight(SIZE[1])
            message.setType(dai.ImgFrame.Type.BGR888i)
            message.setSequenceNum(i)
            message.setTimestamp(timedelta(milliseconds=33 * i))
            self.out.send(message)
            time.sleep(0.02)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Videos that DepthAI's own node records on this machine, and a device's calibration as the library writes it."""
    folder = tmp_path_factory.mktemp("recording")
    pipeline = dai.Pipeline(createImplicitDevice=False)
    sender = pipeline.create(Sender)
    for socket in ("CAM_A", "CAM_B"):
        record = pipeline.create(dai.node.RecordVideo)
        record.setRecordVideoFile(folder / f"1844_v_Camera{socket}.avi").setFps(30)
        record.setRecordMetadataFile(folder / f"1844_v_Camera{socket}.mcap")
        sender.out.link(record.input)
    pipeline.start()
    time.sleep(1.5)
    pipeline.stop()
    pipeline.wait()
    write_device_json(folder / "1844_calibration.json")
    return folder


def test_its_colour_has_the_device_s_calibration(recording: Path) -> None:
    source = open_source(recording)
    frames = list(source)
    assert len(frames) > 5 and not source.live
    assert np.diff([f.rgb.mean() for f in frames]).min() > 4  # in their order
    stated = camera_of_device_json(recording / "1844_calibration.json", "CAM_A", *SIZE)
    np.testing.assert_allclose(frames[0].camera.K, stated.K)
    np.testing.assert_allclose(frames[0].camera.distortion, stated.distortion)
    assert frames[0].depth is None
    assert "the video of CAM_A is read (CAM_B beside it), without depth" in source.notes[0]
    pictures, count = open_pictures(recording)
    assert len(list(pictures)) == len(frames) and count is None


def test_a_camera_file_replaces_the_device_s(recording: Path) -> None:
    with pytest.raises(ValueError, match=r"gives 320x240 px but the calibration is for 64x48"):
        next(iter(open_source(recording, CAMERA)))


def test_what_is_no_whole_recording_is_refused(recording: Path, tmp_path: Path) -> None:
    for name in ("1_calibration.json", "2_calibration.json", "1_CAM_A.mp4"):
        (tmp_path / name).write_bytes(b"{")
    with pytest.raises(ValueError, match="several devices"):
        open_source(tmp_path)
    (tmp_path / "2_calibration.json").unlink()
    with pytest.raises(ValueError, match=r"1_CAM_A.mp4 cannot be decoded"):
        open_source(tmp_path)
    (tmp_path / "1_CAM_A.mp4").write_bytes((recording / "1844_v_CameraCAM_A.avi").read_bytes())
    with pytest.raises(ValueError, match=r"1_calibration.json is no calibration of an OAK camera"):
        open_source(tmp_path)
    (tmp_path / "r.tar").write_bytes(b"")
    with pytest.raises(ValueError, match=r"r.tar is an archive; unpack it"):
        open_source(tmp_path / "r.tar")


def stereo_of(config: OakConfig) -> tuple[list[tuple[str, object]], dai.StereoDepthConfig]:
    """What is called on the node, which cannot be made without a device, and its own configuration."""
    called: list[tuple[str, object]] = []
    names = ("setLeftRightCheck", "setSubpixel", "setDefaultProfilePreset")
    calls = {name: lambda value, name=name: called.append((name, value)) for name in names}
    node = SimpleNamespace(**calls, initialConfig=dai.StereoDepthConfig())
    node.initialConfig.postProcessing.decimationFilter.decimationFactor = 2
    set_up(node, config)
    return called, node.initialConfig


def test_depth_is_computed_as_chosen() -> None:
    called, _ = stereo_of(OakConfig())
    assert called == [("setLeftRightCheck", True), ("setSubpixel", True)]
    called, own = stereo_of(OakConfig(preset="ROBOTICS", confidence=120))
    assert called == [("setDefaultProfilePreset", dai.node.StereoDepth.PresetMode.ROBOTICS)]
    assert own.getConfidenceThreshold() == 120 and own.postProcessing.decimationFilter.decimationFactor == 1


def test_all_presets_are_depthai_s() -> None:
    assert set(get_args(OakPreset)) == set(dai.node.StereoDepth.PresetMode.__members__)
    with pytest.raises(ValueError, match="oak: confidence is 256; give 0 to 255"):
        OakConfig(confidence=256)
