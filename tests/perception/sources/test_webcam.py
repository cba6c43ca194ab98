"""Video files and webcams give colour as it was, with rising stamps; what is wrong with them is one line."""

import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.camera import Camera
from perception.sources.open_source import open_source
from perception.sources.webcam import VideoFile, Webcam, guessed_camera

CAMERA = Camera(64, 48, np.array([[60.0, 0.0, 31.0], [0.0, 61.0, 23.0], [0.0, 0.0, 1.0]]), np.zeros(5))
HALF = Camera(32, 24, np.array([[30.0, 0.0, 15.0], [0.0, 30.0, 11.0], [0.0, 0.0, 1.0]]), np.zeros(5))


def write(path: Path, codec: str, fps: float, count: int) -> list[np.ndarray]:
    """A video of noise in squares of 16 px; returns its pictures, BGR."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (3, 4, 3), dtype=np.uint8).repeat(16, 0).repeat(16, 1) for _ in range(count)]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (64, 48))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return pictures


class FakeCapture:
    """A camera of 64x48 px that gives so many pictures."""

    def __init__(self, count: int, opens: bool = True) -> None:
        self.left, self.opens, self.released = count, opens, False
        self.asked: dict[int, float] = {}

    def isOpened(self) -> bool:
        return self.opens

    def set(self, key: int, value: float) -> None:
        self.asked[key] = value

    def grab(self) -> bool:
        time.sleep(0.002)
        self.left -= 1
        return self.left >= 0

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.full((48, 64, 3), (1, 2, 3), np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def plug_in(monkeypatch: pytest.MonkeyPatch):
    """A function that puts a fake camera at webcam:0."""

    def put(capture: FakeCapture) -> FakeCapture:
        monkeypatch.setattr("perception.sources.webcam.sys.platform", "elsewhere")
        monkeypatch.setattr("perception.sources.webcam.cv2.VideoCapture", lambda number: capture)
        return capture

    return put


@pytest.mark.parametrize(("suffix", "codec", "fps"), [("avi", "FFV1", 15.0), ("mkv", "FFV1", 10.0)])
def test_a_lossless_video_comes_back_as_it_was(tmp_path: Path, suffix: str, codec: str, fps: float) -> None:
    pictures = write(tmp_path / f"v.{suffix}", codec, fps, 5)
    source = open_source(tmp_path / f"v.{suffix}", CAMERA)
    for _ in range(2):
        frames = list(source)
        assert [f.stamp_ns for f in frames] == pytest.approx([i / fps * 1e9 for i in range(5)], abs=1e6)
        for frame, picture in zip(frames, pictures, strict=True):
            off = frame.rgb[..., ::-1].astype(int) - picture
            assert np.abs(off).max() <= 3  # of rounding to the file's luma and chroma
            assert frame.camera is CAMERA and frame.depth is None
    assert source.notes == [] and not source.live


def test_an_mp4_has_all_its_frames(tmp_path: Path) -> None:
    write(tmp_path / "V.MP4", "mp4v", 30.0, 6)
    frames = list(open_source(str(tmp_path / "V.MP4")))
    assert [f.stamp_ns for f in frames] == pytest.approx([i / 30.0 * 1e9 for i in range(6)], abs=1e3)


def test_without_a_calibration_there_is_a_guess_and_a_note(tmp_path: Path) -> None:
    write(tmp_path / "v.mp4", "mp4v", 30.0, 2)
    source = VideoFile(tmp_path / "v.mp4")
    camera = next(iter(source)).camera
    across = camera.rays(np.array([[-0.5, 23.5], [63.5, 23.5]]))
    assert np.degrees(np.arccos(across[0] @ across[1])) == pytest.approx(60.0)
    assert camera.K_std[0, 0] == pytest.approx(0.25 * camera.K[0, 0])
    assert len(source.notes) == 1 and "60 degrees" in source.notes[0] and "farside calibrate" in source.notes[0]
    assert guessed_camera(640, 480).K[0, 0] == pytest.approx(10 * camera.K[0, 0])


def test_a_calibration_of_another_size_is_refused(tmp_path: Path, plug_in) -> None:
    write(tmp_path / "v.mp4", "mp4v", 30.0, 2)
    says = "gives 64x48 px but the calibration is for 32x24 px; give the calibration of this size"
    with pytest.raises(ValueError, match=f"^v.mp4 {says}"):
        list(VideoFile(tmp_path / "v.mp4", HALF))
    capture = plug_in(FakeCapture(3))
    with pytest.raises(ValueError, match=f"^webcam:0 {says}"):
        list(Webcam("0", HALF))
    assert capture.released and (32, 24) == (
        capture.asked[cv2.CAP_PROP_FRAME_WIDTH],
        capture.asked[cv2.CAP_PROP_FRAME_HEIGHT],
    )


def test_a_video_that_cannot_be_read_is_named(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.avi").touch()
    write(tmp_path / "v.mp4", "mp4v", 30.0, 20)
    whole = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    for name in ("text.mp4", "empty.avi", "cut.mp4"):
        with pytest.raises(ValueError, match=f"{name} cannot be decoded as a video") as caught:
            open_source(tmp_path / name)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileNotFoundError, match=r"none.mp4 does not exist; give oak"):
        open_source(tmp_path / "none.mp4")
    assert capfd.readouterr() == ("", "")  # neither OpenCV nor FFmpeg speaks beside it


def test_a_video_that_is_cut_short_gives_what_is_there(tmp_path: Path) -> None:
    write(tmp_path / "v.avi", "MJPG", 30.0, 100)
    whole = (tmp_path / "v.avi").read_bytes()
    (tmp_path / "v.avi").write_bytes(whole[: len(whole) // 2])
    source = VideoFile(tmp_path / "v.avi", CAMERA)
    frames = list(source)
    assert 25 < len(frames) < 75
    assert source.notes == [f"v.avi is cut short or damaged: {len(frames)} of about 100 frames read"]


def test_a_webcam_gives_frames_until_it_is_closed(plug_in) -> None:
    capture = plug_in(FakeCapture(1000))
    source = open_source("webcam:0", CAMERA)
    before = time.time_ns()
    frames = []
    for frame in source:
        frames.append(frame)
        if len(frames) == 3:
            source.close()
    stamps = [f.stamp_ns for f in frames]
    assert len(frames) == 3 and before < stamps[0] < stamps[1] < stamps[2] < time.time_ns()
    assert (frames[0].rgb == (3, 2, 1)).all() and frames[0].depth is None and source.live
    assert capture.released and list(source) == []


def test_a_webcam_that_is_lost_says_so(plug_in) -> None:
    capture = plug_in(FakeCapture(2))
    frames = iter(Webcam("0", CAMERA))
    assert len(list(islice(frames, 2))) == 2
    with pytest.raises(OSError, match=r"^webcam:0 gives no more pictures; check its cable"):
        next(frames)
    assert capture.released


def test_a_webcam_that_is_not_there_is_named(plug_in, capfd: pytest.CaptureFixture) -> None:
    with pytest.raises(OSError, match=r"webcam:97: there is no /dev/video97 \(cameras here: .*\); plug it in"):
        open_source("webcam:97")
    for word in ("webcam", "webcam:", "webcam:front", "webcam:-1"):
        with pytest.raises(ValueError, match="such as webcam:0 for /dev/video0"):
            open_source(word)
    plug_in(FakeCapture(0, opens=False))
    with pytest.raises(OSError, match="webcam:0 cannot be opened; close the program that uses it"):
        open_source("webcam:0")
    assert capfd.readouterr() == ("", "")
