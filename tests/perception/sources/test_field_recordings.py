"""Recordings as drivers and recorders leave them: one broken message does not cost the log, and what is not read is
named."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from perception.sources.recording import Log
from tests.perception.sources.test_recording import MM, MS, RGB, START, maker, record, says

SHARED = Path(__file__).parents[3] / "../shared/data/interop"
# of the cases there: (frames, part of a note) or part of the error
CASES: dict[str, tuple[int, str] | str] = {
    "depth_65535": (2, ""),
    "ffmpeg_packets": "not read: /camera/color/image_raw/ffmpeg",
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


C, D = "/cam/color/image_raw", "/cam/aligned_depth_to_color/image_raw"


def at(i: int) -> int:
    return START + 33 * i * MS


def test_a_clock_that_begins_anew_gives_each_time_its_own_depth(tmp_path: Path) -> None:
    make = maker("mcap")
    messages = [make.info(START)]
    for episode in range(3):
        for i in range(10):
            for topic, array, encoding in (
                (C, np.full_like(RGB, episode), "rgb8"),
                (D, np.full_like(MM, 500 + episode), "16UC1"),
            ):
                topic, kind, _, message = make.image(topic, at(i), array, encoding)
                messages.append((topic, kind, at(40 * episode + i), message))  # as recorded
    log = Log(record(tmp_path / "x", "mcap", messages))
    shown = [(int(f.rgb[0, 0, 0]), round(1000 * float(f.depth[0, 0])) - 500) for f in log if f.depth is not None]
    assert shown == [(episode, episode) for episode in range(3) for _ in range(10)]


@pytest.mark.parametrize("topic", [C, D])
def test_one_stamp_in_the_future_costs_one_frame(tmp_path: Path, topic: str) -> None:
    make = maker("mcap")
    messages = [make.info(START)]
    for i in range(100):
        for name, array, encoding in ((D, MM, "16UC1"), (C, RGB, "rgb8")):
            ahead = 3_600_000_000_000 if (i, name) == (40, topic) else 0
            _, kind, _, message = make.image(name, at(i) + ahead, array, encoding)
            messages.append((name, kind, at(i), message))
    assert 98 <= len(list(Log(record(tmp_path / "x", "mcap", messages)))) <= 99


def test_depth_that_is_recorded_late_is_waited_for(tmp_path: Path) -> None:
    make = maker("mcap")
    messages = [make.info(START)]
    for i in range(90):
        messages.append(make.image(C, at(i), RGB, "rgb8"))
        _, kind, _, message = make.image(D, at(i), MM, "16UC1")
        messages.append((D, kind, at(i + 60), message))
    assert len(list(Log(record(tmp_path / "x", "mcap", sorted(messages, key=lambda m: m[2]))))) == 90


@pytest.mark.parametrize("cut", [False, True])
def test_a_message_that_cannot_be_decoded_costs_itself(tmp_path: Path, cut: bool) -> None:
    make = maker("mcap")
    store = get_typestore(Stores.ROS2_JAZZY)
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for i, message in enumerate([make.info(START), *(make.image(C, at(i), RGB, "rgb8") for i in range(5))]):
            topic, kind, stamp, content = message
            if topic not in channels:
                text = store.generate_msgdef(kind, ros_version=2)[0].encode()
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
            data = bytes(store.serialize_cdr(content, kind))
            writer.add_message(channels[topic], stamp, data[:60] if i == 3 else data, stamp)
        writer.finish()
    if cut:
        path.write_bytes(path.read_bytes()[:-40])
    log = Log(path)
    assert [frame.stamp_ns for frame in log] == [at(i) for i in range(5) if i != 2]
    assert any(f"messages on {C} that cannot be read are left out" in note for note in log.notes)


@pytest.mark.parametrize("spoil", ["k", "width", "distortion_model", "frame"])
def test_a_camera_info_that_makes_no_sense_is_left_out(tmp_path: Path, spoil: str) -> None:
    make = maker("mcap")
    bad = make.info(at(1) + MS, frame="other" if spoil == "frame" else "cam")
    if spoil == "k":
        bad[3].k[0] = np.nan
    elif spoil == "width":
        bad[3].width = 0
    elif spoil == "distortion_model":
        bad[3].distortion_model, bad[3].d = "omni", np.full(5, 0.1)
    images = [make.image(C, at(i), RGB, "rgb8") for i in range(4)]
    log = Log(record(tmp_path / "x", "mcap", [make.info(START), *images[:2], bad, *images[2:]]))
    assert [f.camera.K[0, 0] for f in log] == [90.0] * 4
    assert "a camera_info is left out" in log.notes[-1]


@pytest.mark.parametrize("which", ["short", "empty", "nameless"])
def test_the_first_image_may_be_no_image(tmp_path: Path, which: str) -> None:
    make = maker("mcap")
    images = [make.image(C, at(i), RGB, "rgb8") for i in range(3)]
    first = images[0][3]
    if which == "short":
        first.data = first.data[:100]
    elif which == "empty":
        first.height, first.width, first.step, first.data = 0, 0, 0, first.data[:0]
    else:
        first.encoding = ""
    log = Log(record(tmp_path / "x", "mcap", [make.info(START), *images]))
    assert [f.stamp_ns for f in log] == [at(1), at(2)]


def test_labels_that_do_not_fit_are_left_alone(tmp_path: Path) -> None:
    make = maker("mcap")
    base = [make.info(START), make.image(C, START, RGB, "rgb8")]
    ids = (MM % 5).astype(np.uint8)
    half = make.image("/yolo/segmentation", START, ids[::2, ::2].copy(), "mono8")
    lossy = make.compressed("/yolo/label", START, cv2.imencode(".jpg", ids)[1].ravel(), "mono8; jpeg compressed mono8")
    for i, (label, why) in enumerate([(half, "it is 32x24 px, colour 64x48"), (lossy, "JPEG changes ids")]):
        log = Log(record(tmp_path / f"{i}", "mcap", [*base, label]))
        assert len(list(log)) == 1 and any(why in note for note in log.notes)
    log = Log(record(tmp_path / "wide", "mcap", [*base, make.image("/label", START, ids.astype(np.int32), "32SC1")]))
    (frame,) = log
    np.testing.assert_array_equal(frame.label, ids)


def test_colour_is_the_one_that_depth_is_of(tmp_path: Path) -> None:
    make = maker("mcap")
    for frame in ("", "cam2"):
        first = make.image("/cam1/image_raw", START, RGB, "rgb8", frame="cam1" if frame else "")
        second = make.image("/cam2/image_raw", START, RGB, "rgb8", frame=frame)
        depth = make.image("/cam2/depth", START, MM, "16UC1", frame=frame)
        infos = [make.info(START, topic=f"/cam{i}/camera_info", frame=f"cam{i}" if frame else "") for i in (1, 2)]
        log = Log(record(tmp_path / f"of {frame}", "mcap", [*infos, first, second, depth]))
        assert (log.colour_topic, log.depth_topic) == ("/cam2/image_raw", "/cam2/depth")
        assert "colour is also on /cam1/image_raw" in log.notes[0]


@pytest.mark.parametrize(
    ("overlay", "real"),
    [
        ("/yolo/dbg_image", "/image_raw"),
        ("/camera/depth_color", "/camera/color/image_raw"),
        ("/cam/color/segmentation_overlay", "/cam/color/image_raw"),
    ],
)
def test_an_overlay_is_not_the_cameras_picture(tmp_path: Path, overlay: str, real: str) -> None:
    make = maker("mcap")
    images = [make.image(topic, START, RGB, "rgb8") for topic in (overlay, real)]
    assert Log(record(tmp_path / "x", "mcap", [make.info(START), *images])).colour_topic == real


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_infrared_of_a_depth_camera_is_no_depth(tmp_path: Path, encoding: str) -> None:
    make = maker("mcap")
    colour = make.image("/depth_cam/rgb/image_raw", START, RGB, "rgb8")
    infrared = make.image("/depth_cam/ir/image_raw", START, MM, encoding)
    log = Log(record(tmp_path / "x", "mcap", [make.info(START), colour, infrared]))
    assert log.depth_topic is None


def test_one_unreadable_depth_beside_a_whole_one(tmp_path: Path) -> None:
    make = maker("mcap")
    broken = make.compressed(f"{D}/compressedDepth", START, np.zeros(40, np.uint8), "16UC1; compressedDepth png")
    depth = make.image(D, START, MM, "16UC1")
    log = Log(record(tmp_path / "x", "mcap", [make.info(START), make.image(C, START, RGB, "rgb8"), broken, depth]))
    assert log.depth_topic == D and "is not taken for depth" in log.notes[0]


def test_depth_of_eight_bits_is_refused(tmp_path: Path) -> None:
    make = maker("mcap")
    content = cv2.imencode(".jpg", (MM >> 4).astype(np.uint8))[1].ravel()
    depth = make.compressed("/cam/depth/compressed", START, content, "16UC1; jpeg compressed mono8")
    says(record(tmp_path / "x", "mcap", [make.info(START), make.image(C, START, RGB, "rgb8"), depth]), "8 bits a pixel")


def test_drivers_pad_their_pictures(tmp_path: Path) -> None:
    make = maker("mcap")
    content = np.append(cv2.imencode(".jpg", RGB[..., ::-1])[1].ravel(), np.zeros(5000, np.uint8))
    picture = make.compressed(f"{C}/compressed", START, content, "jpeg")
    assert len(list(Log(record(tmp_path / "x", "mcap", [make.info(START), picture])))) == 1


def test_a_mosaic_that_is_packed_as_it_is(tmp_path: Path) -> None:
    make = maker("mcap")
    mosaic = np.zeros((48, 64), np.uint8)
    mosaic[::2, ::2] = 200  # all red
    content = cv2.imencode(".png", mosaic)[1].ravel()
    for form, colour in (
        ("bayer_rggb8; png compressed ", [200, 0, 0]),
        ("bayer_rggb8; png compressed mono8", [0, 0, 0]),
    ):
        picture = make.compressed(f"{C}/compressed", START, content, form)
        (frame,) = Log(record(tmp_path / f"as {form}", "mcap", [make.info(START), picture]))
        np.testing.assert_array_equal(frame.rgb[11, 11], colour)


def test_odd_sizes_of_paired_pixels_are_named(tmp_path: Path) -> None:
    make = maker("mcap")
    odd = make.image(C, START, np.zeros((48, 63, 2), np.uint8), "yuyv")
    says(record(tmp_path / "x", "mcap", [make.info(START, size=(48, 63)), odd]), "63x48 px of yuyv", "even size")


def test_other_recordings_in_a_folder_are_named(tmp_path: Path) -> None:
    make = maker("mcap")
    for name in ("mug", "bowl"):
        part = record(tmp_path / name, "mcap", [make.info(START), make.image(C, START, RGB, "rgb8")])
        next(part.glob("*.mcap")).rename(tmp_path / f"{name}.mcap")
        (part / "metadata.yaml").unlink()
        part.rmdir()
    says(tmp_path, "several recordings (bowl.mcap, mug.mcap)", "give one")
    (tmp_path / "bowl.mcap").unlink()
    (tmp_path / "mug.mcap").rename(tmp_path / "mug_2.mcap")
    assert "parts are missing (mug_0, mug_1)" in Log(tmp_path).notes[0]
    (tmp_path / "mug_2.mcap").rename(tmp_path / "mug_2.mcap.zstd")
    says(tmp_path, "zstd -d")
