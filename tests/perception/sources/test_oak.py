"""Frames go through a real DepthAI pipeline on the host unchanged; losses are mended and counted; nothing hangs."""

import json
import os
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from threading import Event, Timer

import depthai as dai
import numpy as np
import pytest

from calibration.camera import Camera
from perception.sources.oak import OakConfig, OakSource, camera_of_device_json, open_oak
from perception.sources.open_source import open_source
from tests.perception.recorded import CAMERA, DEVICE_K, RecordedImages, numbered, some_frames, write_device_json

FAST = OakConfig(silence_s=0.8, retry_s=0.02, longest_retry_s=0.05)
SILENT = OSError("recorded: no camera was found")


@pytest.fixture
def device_json(tmp_path: Path) -> Path:
    return write_device_json(tmp_path / "calib.json")


def same(frame, sent) -> None:
    np.testing.assert_array_equal(frame.rgb, sent.rgb)
    np.testing.assert_array_equal(frame.depth, sent.depth)
    assert frame.stamp_ns == sent.stamp_ns


def test_frames_in_are_frames_out() -> None:
    sent = some_frames(25)
    images = RecordedImages([sent])
    source = OakSource(images)
    got = list(islice(source, len(sent)))
    assert len(got) == len(sent)
    for frame, expected in zip(got, sent, strict=True):
        same(frame, expected)
    assert got[0].camera is CAMERA and got[0].label is None and source.live
    assert np.isnan(got[0].depth).any() and source.notes == []
    assert images.opened == 1 and images.closed == [1]


def test_a_camera_that_is_lost_is_found_again() -> None:
    sent = some_frames(10)
    images = RecordedImages([sent[:4], SILENT, SILENT, numbered(sent[4:], 2000)])
    source = OakSource(images, FAST)
    got = list(islice(source, 10))
    for frame, expected in zip(got, sent[:4] + numbered(sent[4:], 2000), strict=True):
        same(frame, expected)
    assert images.opened == 4 and images.closed == [1, 4]
    assert source.notes == ["recorded: lost once, back now; last: recorded gave no frame for 0.8 s"]


def test_a_camera_that_stays_away_is_looked_for_until_closed() -> None:
    images = RecordedImages([some_frames(2), SILENT])
    source = OakSource(images, FAST)
    frames = iter(source)
    assert len(list(islice(frames, 2))) == 2
    Timer(1.2, source.close).start()
    assert list(frames) == []
    assert images.opened > 3 and "lost once, away now" in source.notes[0]
    assert list(source) == []  # closed is closed


def test_a_camera_that_never_gives_a_frame_is_an_error() -> None:
    with pytest.raises(OSError, match=r"^recorded gave no frame for 0.8 s$"):
        list(OakSource(RecordedImages([[]]), FAST))
    with pytest.raises(OSError, match="no camera was found"):
        list(OakSource(RecordedImages([SILENT]), FAST))


def test_stamps_that_do_not_match_are_no_frames() -> None:
    images = RecordedImages([some_frames(40)], shift_us=15_000)
    source = OakSource(images, FAST)
    with pytest.raises(OSError, match=r"gave no frame for 0.8 s \(colour and depth at least 15.0 ms apart, 10 are all"):
        list(source)
    assert "pairs left out" in source.notes[0]
    near = RecordedImages([some_frames(5)], shift_us=9_000)
    got = list(islice(OakSource(near, FAST), 5))
    assert [f.stamp_ns for f in got] == [f.stamp_ns for f in some_frames(5)]  # colour's stamps


def test_images_lost_on_the_way_are_counted() -> None:
    source = OakSource(RecordedImages([some_frames(10)], skip=(3, 4, 7)), FAST)
    assert len(list(islice(source, 7))) == 7
    assert source.notes == ["recorded: 3 frames lost between camera and here (gaps in their numbers)"]


def test_a_calibration_of_another_size_is_refused() -> None:
    half = Camera(32, 24, np.array([[30.0, 0, 15], [0, 30, 11], [0, 0, 1]]), np.zeros(5))
    with pytest.raises(ValueError, match=r"^recorded: the camera is calibrated at 32x24 px but colour is 64x48 px"):
        list(OakSource(RecordedImages([some_frames(3)], camera=half), FAST))


def test_a_crop_that_the_images_tell_of_is_honoured() -> None:
    told = dai.ImgTransformation(128, 96, [[130.0, 0, 66], [0, 131, 47], [0, 0, 1]])
    told.addCrop(20, 10, 64, 48)
    source = OakSource(RecordedImages([some_frames(3)], told=told), FAST)
    frame = next(iter(source))
    np.testing.assert_allclose(frame.camera.K, [[130, 0, 46], [0, 131, 37], [0, 0, 1]], atol=1e-4)
    np.testing.assert_array_equal(frame.camera.distortion, CAMERA.distortion)
    assert "focal length is 130.0 px, by the factory calibration 60.0; the former is used" in source.notes[0]


def test_a_device_that_hangs_is_given_up_and_closed_when_it_wakes(monkeypatch: pytest.MonkeyPatch) -> None:
    release = Event()

    class Hanging(RecordedImages):
        def open(self):
            release.wait(30.0)
            return super().open()

    monkeypatch.setattr("perception.sources.oak._OPENING_S", 0.1)
    images = Hanging([some_frames(20)])
    begun = time.monotonic()
    with pytest.raises(OSError, match="recorded does not open"):
        list(OakSource(images, FAST))
    assert time.monotonic() - begun < 2.0
    release.set()
    while not images.closed:
        assert time.monotonic() - begun < 20.0
        time.sleep(0.01)


@pytest.mark.skipif(bool(dai.Device.getAllAvailableDevices()), reason="an OAK camera is here")
def test_without_a_camera_there_is_one_line_at_once() -> None:
    for word, says in (("oak", "oak: no OAK camera was found"), ("oak:14442C10D1", "oak:14442C10D1: no OAK camera")):
        begun = time.monotonic()
        with pytest.raises(OSError, match=says) as caught:
            open_source(word)
        assert time.monotonic() - begun < 2.0
        assert "\n" not in str(caught.value) and "plug it in" in str(caught.value)


@pytest.mark.skipif(bool(dai.Device.getAllAvailableDevices()), reason="an OAK camera is here")
def test_the_library_prints_nothing_of_its_own() -> None:
    code = (
        "from perception.sources.open_source import open_source\ntry: open_source('oak')\nexcept OSError as e: print(e)"
    )
    env = {key: value for key, value in os.environ.items() if key != "DEPTHAI_LEVEL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True)
    assert done.stdout.startswith("oak: no OAK camera") and done.stdout.count("\n") == 1 and done.stderr == ""


def test_other_cameras_that_are_there_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    info = dai.DeviceInfo()
    info.deviceId, info.name = "19443010", "1.2"
    monkeypatch.setattr(dai.Device, "getAllAvailableDevices", staticmethod(lambda: [info]))
    with pytest.raises(OSError, match="oak:1844 is not there; there are oak:19443010"):
        open_oak("1844")
    assert open_oak("1.2").notes == []  # opened only when read


def test_the_device_s_calibration_is_scaled_and_cropped(device_json: Path) -> None:
    half = camera_of_device_json(device_json, "CAM_A", 2028, 1520)
    np.testing.assert_allclose(half.K, np.diag([0.5, 0.5, 1.0]) @ np.array(DEVICE_K), rtol=1e-6)
    np.testing.assert_allclose(half.distortion, np.arange(1, 15) / 100, rtol=1e-6)
    assert (half.width, half.height, half.model) == (2028, 1520, "rational_polynomial")
    assert camera_of_device_json(device_json, "CAM_B", 640, 480).distortion.size == 8
    scale = 1920 / 4056  # 16:9 out of 4:3: rows are cropped evenly above and below
    wide = camera_of_device_json(device_json, "CAM_A", 1920, 1080)
    cropped = (3040 * scale - 1080) / 2
    np.testing.assert_allclose(wide.K[:2, 2], [2010 * scale, 1530 * scale - cropped], atol=0.6)
    np.testing.assert_allclose(wide.K[0, 0], 3000 * scale, rtol=1e-6)


def test_a_wrong_calibration_file_is_named(device_json: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none.json does not exist"):
        camera_of_device_json(tmp_path / "none.json")
    for text in ("{", json.dumps({"cameraData": 3})):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(ValueError, match=r"bad.json is no calibration of an OAK camera"):
            camera_of_device_json(tmp_path / "bad.json")
    with pytest.raises(ValueError, match=r"calib.json has no calibration of CAM_D"):
        camera_of_device_json(device_json, "CAM_D")
    with pytest.raises(ValueError, match=r"calib.json: CAM_C has a Fisheye lens"):
        camera_of_device_json(device_json, "CAM_C")
    with pytest.raises(ValueError, match=r"socket 'RGBX' is unknown; give one of .*CAM_A"):
        camera_of_device_json(device_json, "RGBX")


@pytest.mark.parametrize("wrong", [{"width": 0}, {"fps": -1.0}, {"silence_s": 0.0}])
def test_a_senseless_configuration_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=f"oak: {next(iter(wrong))} is"):
        OakConfig(**wrong)
