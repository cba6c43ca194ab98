"""Recordings as drivers and recorders leave them: one broken message does not cost the log, and what is not read is
named."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer

from perception.sources.recording import Log
from tests.perception.sources.test_recording import MM, MS, RGB, START, maker, record, says

SHARED = Path(__file__).parents[3] / "../shared/data/interop"
# of the cases there: (frames, part of a note) or part of the error
CASES: dict[str, tuple[int, str] | str] = {
    "depth_65535": (2, ""),
    "ffmpeg_packets": "video packets are not read: /camera/color/image_raw/ffmpeg",
    "frame_id_slash": (2, ""),
    "info_first_empty": (3, ""),
    "info_other_namespace": (2, ""),
    "info_roi": (2, ""),
    "jpeg_one_broken": (2, "1 image that cannot be read left out"),
    "mcap_protobuf": "its messages are protobuf, which is not read",
    "mcap_split_no_meta": (4, ""),
    "model_librealsense": (2, ""),
    "rational_5": (2, ""),
    "realsense_viewer_bag": (2, ""),
    "step_zero": (2, ""),
    "two_cameras": (2, "choose with --colour-topic"),
}


def jpeg(stamp: int, cut: int | None = None, topic: str = "/cam/image/compressed"):
    data = cv2.imencode(".jpg", RGB[..., ::-1])[1].ravel()[:cut]
    return maker("mcap").compressed(topic, stamp, data, "jpeg")


@pytest.mark.parametrize("broken", [0, 1, 2])
@pytest.mark.parametrize("cut", [20, 2000])
def test_one_cut_picture_is_left_out(tmp_path: Path, broken: int, cut: int) -> None:
    make = maker("mcap")
    stamps = [START + 33 * i * MS for i in range(3)]
    pictures = [jpeg(stamp, cut if i == broken else None) for i, stamp in enumerate(stamps)]
    log = Log(record(tmp_path / "x", "mcap", [make.info(START), *pictures]))
    assert [frame.stamp_ns for frame in log] == [s for i, s in enumerate(stamps) if i != broken]
    assert "1 image that cannot be read left out" in log.notes[-1]
    assert f"cut short at byte {cut}" in log.notes[-1]


def test_pictures_that_are_all_cut_are_an_error(tmp_path: Path) -> None:
    make = maker("mcap")
    path = record(tmp_path / "x", "mcap", [make.info(START), *(jpeg(START + i * MS, 200) for i in range(40))])
    says(path, "cut short at byte 200")


def test_depth_that_is_cut_costs_its_frame_alone(tmp_path: Path) -> None:
    make = maker("mcap")
    png = cv2.imencode(".png", MM)[1].ravel()
    messages = [make.info(START)]
    for i in range(3):
        messages.append(make.image("/cam/image", START + 33 * i * MS, RGB, "rgb8"))
        depth = png[: 99 if i == 1 else None]
        messages.append(make.compressed("/cam/depth/compressed", START + 33 * i * MS, depth, "16UC1; png"))
    log = Log(record(tmp_path / "x", "mcap", messages))
    assert len(list(log)) == 2 and "1 image that cannot be read" in log.notes[-1]


@pytest.mark.parametrize("again", [False, True])
def test_an_empty_camera_info_is_passed_over(tmp_path: Path, again: bool) -> None:
    make = maker("mcap")
    empty = make.info(START)
    empty[3].k[:] = 0.0
    messages = [empty, make.image("/cam/image", START, RGB, "rgb8"), make.info(START + MS, fx=99.0)]
    if again:
        later = make.info(START + 2 * MS)
        later[3].k[:] = 0.0
        messages.append(later)
    messages.append(make.image("/cam/image", START + 40 * MS, RGB, "rgb8"))
    assert [f.camera.K[0, 0] for f in Log(record(tmp_path / "x", "mcap", messages))] == [99.0, 99.0]
    says(record(tmp_path / "y", "mcap", messages[:2]), "positive focal")


def test_parts_without_metadata_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    make = maker("mcap")
    folder = tmp_path / "split"
    folder.mkdir()
    for i in range(11):
        image = make.image("/cam/image", START + i * MS, RGB, "rgb8")
        part = record(tmp_path / f"{i}", "mcap", [make.info(START), image])
        next(part.glob("*.mcap")).rename(folder / f"split_{i}.mcap")
    assert [frame.stamp_ns - START for frame in Log(folder)] == [i * MS for i in range(11)]
    with (folder / "split_10.mcap").open("r+b") as last:
        last.truncate(last.seek(0, 2) - 30)
    log = Log(folder)
    assert len(list(log)) == 11 and "split_10.mcap is cut short" in log.notes[0]


@pytest.mark.parametrize("encoding", ["protobuf", "ros1", "json"])
def test_messages_of_another_kind_are_named(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("foxglove.RawImage", encoding, b"")
        channel = writer.register_channel("/camera", encoding, schema)
        writer.add_message(channel, START, b"123", START)
        writer.finish()
    says(path, encoding, "is not read", "ros2 bag record")


@pytest.mark.skipif(not SHARED.exists(), reason="../shared/data/interop is not beside this checkout")
@pytest.mark.parametrize("case", sorted(CASES))
def test_a_recording_as_it_was_left(case: str) -> None:
    path = next(p for p in (SHARED / case).iterdir() if p.name != "expected.txt")
    expected = CASES[case]
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            Log(path)
        return
    log = Log(path)
    frames = list(log)
    assert len(frames) == expected[0]
    for frame in frames:
        assert frame.depth is not None and np.nanmax(frame.depth) < 3.0
        assert not frame.frame_id.startswith("/")
        # all show the same scene from the same place: what stands on the table is seen by right intrinsics alone
        middle = frame.camera.project(np.array([[0.0, 0.0, 0.5]]))[0]
        assert np.linalg.norm(middle - np.array(frame.rgb.shape[1::-1]) / 2) < 3.0
    assert any(expected[1] in note for note in log.notes) or not expected[1]
