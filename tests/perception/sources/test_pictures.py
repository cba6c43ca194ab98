"""Pictures for calibration come as they were stored, from folders and from logs that know no camera."""

import time
from collections.abc import Generator, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from perception.sources.frame import Frame
from perception.sources.pictures import open_pictures, pictures_of
from perception.sources.recorder import write_log
from tests.perception.sources.test_recording import frames, maker, record

RGB = np.random.default_rng(0).integers(0, 256, (3, 12, 16, 3), dtype=np.uint8)


def test_a_folder_gives_its_images_by_name(tmp_path: Path) -> None:
    for name, rgb in zip(("b.png", "a.bmp", "c.tiff"), RGB, strict=True):
        cv2.imwrite(str(tmp_path / name), rgb[..., ::-1])
    (tmp_path / "notes.txt").write_text("no picture")
    pictures, count = open_pictures(tmp_path)
    found = list(pictures)
    assert count == 3 and [p.name for p in found] == ["a.bmp", "b.png", "c.tiff"]
    for picture, rgb in zip(found, RGB[[1, 0, 2]], strict=True):
        np.testing.assert_array_equal(picture.rgb, rgb)
    pictures, count = open_pictures(tmp_path / "b.png")
    assert count == 1 and np.array_equal(next(pictures).rgb, RGB[0])


def test_grey_and_deep_images_are_pictures(tmp_path: Path) -> None:
    grey = RGB[0, ..., 0]
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    cv2.imwrite(str(tmp_path / "b.png"), grey.astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "c.pgm"), grey)
    assert open_pictures(tmp_path)[1] == 3
    for picture in open_pictures(tmp_path)[0]:
        np.testing.assert_array_equal(picture.rgb, np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_a_log_needs_no_camera_info_nor_fitting_depth(tmp_path: Path, kind: str) -> None:
    make = maker(kind)
    messages = [make.image("/cam/image_raw", 10 + i, rgb, "rgb8") for i, rgb in enumerate(RGB)]
    messages.append(make.image("/cam/depth", 10, np.zeros((5, 5), np.uint16), "16UC1"))
    path = record(tmp_path / ("a.bag" if kind == "bag" else "a"), kind, messages)
    pictures, count = open_pictures(path)
    found = list(pictures)
    assert count is None and [p.name for p in found] == ["frame 0", "frame 1", "frame 2"]
    np.testing.assert_array_equal([p.rgb for p in found], RGB)


def test_frames_are_pictures(tmp_path: Path) -> None:
    written = frames()
    write_log(tmp_path / "a.mcap", written)
    for found in (pictures_of(written), open_pictures(tmp_path / "a.mcap")[0]):
        for picture, frame in zip(found, written, strict=True):
            np.testing.assert_array_equal(picture.rgb, frame.rgb)


def test_a_live_source_gives_its_newest_pictures_and_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    class Live:
        live, notes, closed = True, (), False

        def close(self) -> None:
            self.closed = True

        def __iter__(self) -> Iterator[Frame]:
            yield from frames(3)
            while not self.closed:
                time.sleep(0.01)

    source = Live()
    monkeypatch.setattr("perception.sources.pictures.open_source", lambda name: source)
    pictures, count = open_pictures("webcam:0")
    first = next(pictures)
    assert count is None and any(np.array_equal(first.rgb, frame.rgb) for frame in frames(3))
    assert isinstance(pictures, Generator)
    pictures.close()
    assert source.closed


def test_what_holds_no_picture_says_so(tmp_path: Path) -> None:
    def says(path: Path, *parts: str) -> None:
        with pytest.raises((ValueError, FileNotFoundError)) as caught:
            list(open_pictures(path)[0])
        assert "\n" not in str(caught.value)
        for part in (str(path), *parts):
            assert part in str(caught.value)

    says(tmp_path / "absent", "does not exist")
    says(tmp_path, "holds no image")
    (tmp_path / "a.txt").write_text("text")
    says(tmp_path / "a.txt", "cannot be read as a recording")
    make = maker("mcap")
    depth = make.image("/cam/depth", 10, np.zeros((5, 5), np.uint16), "16UC1")
    says(record(tmp_path / "log", "mcap", [depth]), "no colour image", "/cam/depth (16UC1)")
    whole = cv2.imencode(".png", RGB[0])[1].tobytes()
    (tmp_path / "cut.png").write_bytes(whole[:-20])
    says(tmp_path / "cut.png", "cut short at byte")
    (tmp_path / "bad.jpg").write_bytes(b"\xff\xd8 no picture")
    says(tmp_path / "bad.jpg", "cannot be decoded")


def test_a_cut_picture_of_a_recording_costs_itself(tmp_path: Path) -> None:
    make = maker("mcap")
    data = cv2.imencode(".jpg", RGB[0])[1].ravel()
    sent = [make.compressed("/cam/image/compressed", 10 + i, data[: 300 if i == 1 else None], "jpeg") for i in range(3)]
    notes: list[str] = []
    pictures, _ = open_pictures(record(tmp_path / "a", "mcap", sent), notes)
    assert [picture.name for picture in pictures] == ["frame 0", "frame 2"]
    assert "pictures that cannot be read left out: 1" in notes[-1]
