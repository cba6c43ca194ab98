"""A frame is of one camera: colour, its own camera_info, and depth only from what is depth and aligned to it."""

from pathlib import Path

import numpy as np
import pytest

from perception.sources.recording import Log
from perception.sources.topic_names import TopicNames, is_rectified, name_parts
from tests.perception.sources.test_recording import MM, RGB, START, maker, record, says

make = maker("mcap")
METRES = (0.5 + MM * 1e-4).astype(np.float32)
INFO = make.info(START)
COLOUR = make.image("/cam/color/image_raw", START, RGB, "rgb8")


def test_names_are_split_at_what_is_no_letter() -> None:
    assert name_parts("/Cam1/image_rect_color/compressed") == {"cam", "image", "rect", "color", "compressed"}


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/cam/image_rect", True),
        ("/cam/image_rect_color", True),
        ("/cam/rectified/image", True),
        ("/cam/corrected/image_raw", False),
        ("/direct/image", False),
        ("/rectangle_cam/image_color", False),
    ],
)
def test_a_rectified_picture_is_one_whose_name_has_the_part(tmp_path: Path, topic: str, rectified: bool) -> None:
    assert is_rectified(topic) == rectified
    info = make.info(START)
    info[3].d[:] = 0.01
    info[3].p[0] = 180.0
    (frame,) = Log(record(tmp_path / "x", "mcap", [info, make.image(topic, START, RGB, "rgb8")]))
    assert frame.camera.K[0, 0] == (180.0 if rectified else 90.0)
    assert frame.camera.distortion.any() != rectified


@pytest.mark.parametrize(
    "topic",
    [
        "/farside/uncertainty",
        "/cam/depth/confidence",
        "/zed/confidence/confidence_map",
        "/cam/depth_std_dev",
        "/cam/ir",
    ],
)
def test_what_is_named_otherwise_is_no_depth(tmp_path: Path, topic: str) -> None:
    other = make.image(topic, START, METRES, "32FC1")
    log = Log(record(tmp_path / "x", "mcap", [INFO, COLOUR, other]))
    (frame,) = log
    assert log.depth_topic is None and frame.depth is None and "no depth image" in log.notes[-1]
    real = make.image("/cam/depth/image", START, MM, "16UC1")
    both = Log(record(tmp_path / "y", "mcap", [INFO, COLOUR, other, real]))
    assert both.depth_topic == "/cam/depth/image" and both.notes == []


@pytest.mark.parametrize(("array", "encoding"), [(METRES, "32FC1"), (MM, "16UC1")])
def test_an_image_that_may_be_depth_is_named_and_can_be_chosen(
    tmp_path: Path, array: np.ndarray, encoding: str
) -> None:
    path = record(tmp_path / "x", "mcap", [INFO, COLOUR, make.image("/cam/stereo/image", START, array, encoding)])
    log = Log(path)
    assert next(iter(log)).depth is None
    assert f"/cam/stereo/image ({encoding}) may be depth" in log.notes[0] and "--depth-topic" in log.notes[0]
    chosen = Log(path, names=TopicNames(depth="/cam/stereo/image"))
    assert next(iter(chosen)).depth is not None and chosen.notes == []
    says(path, "no image on /cam/else", "/cam/stereo/image", names=TopicNames(depth="/cam/else"))


@pytest.mark.parametrize(
    ("array", "why"),
    [
        (METRES * 1000, "median is"),  # millimetres
        (METRES * 100, "median is"),  # percent
        (METRES * 0.001, "median is"),
        (np.where(MM % 2, METRES, -METRES), "negative"),
    ],
)
def test_values_that_are_no_distance_are_no_depth(tmp_path: Path, array: np.ndarray, why: str) -> None:
    image = make.image("/cam/depth", START, array.astype(np.float32), "32FC1")
    path = record(tmp_path / "x", "mcap", [INFO, COLOUR, image])
    log = Log(path)
    assert next(iter(log)).depth is None
    assert "/cam/depth is not taken for depth" in log.notes[0] and why in log.notes[0]
    says(path, "/cam/depth is no depth", why, names=TopicNames(depth="/cam/depth"))


def test_counts_of_65535_are_unknown(tmp_path: Path) -> None:
    counts = np.where(MM < 1000, np.uint16(65535), MM)
    image = make.image("/cam/depth", START, counts, "16UC1")
    (frame,) = Log(record(tmp_path / "x", "mcap", [INFO, COLOUR, image]))
    assert frame.depth is not None
    np.testing.assert_array_equal(np.isnan(frame.depth), MM < 1000)


def test_the_camera_info_is_that_of_the_colours_camera(tmp_path: Path) -> None:
    near = make.info(START, fx=50.0, topic="/cam/color/camera_info", frame="other")
    far = make.info(START, fx=70.0, topic="/calibration/camera_info", frame="/cam")
    (frame,) = Log(record(tmp_path / "frame", "mcap", [near, far, COLOUR]))
    assert frame.camera.K[0, 0] == 70.0
    bare = make.info(START, fx=70.0, topic="/left/camera_info", frame="")
    beside = make.info(START, fx=80.0, topic="/cam/color/camera_info", frame="")
    (frame,) = Log(record(tmp_path / "space", "mcap", [bare, beside, COLOUR]))
    assert frame.camera.K[0, 0] == 80.0
    path = record(tmp_path / "none", "mcap", [near, COLOUR])
    says(path, "/cam/color/camera_info", "'other'", "'cam'", "/cam/color/image_raw", "--camera")
    away = make.info(START, topic="/right/camera_info", frame="")
    says(record(tmp_path / "which", "mcap", [bare, away, COLOUR]), "/left/camera_info, /right/camera_info", "--camera")
    later = make.info(START, topic="/cam/camera_info", frame="other")
    log = Log(record(tmp_path / "later", "mcap", [INFO, later, COLOUR]))
    (frame,) = log
    assert frame.camera.K[0, 0] == INFO[3].k[0]
    assert all(part in log.notes[-1] for part in ("/cam/camera_info", "another camera's", "--camera"))


def test_depth_of_another_frame_is_refused_unless_it_is_given(tmp_path: Path) -> None:
    depth = make.image("/cam/depth/image", START, MM, "16UC1", frame="cam_depth")
    path = record(tmp_path / "x", "mcap", [INFO, COLOUR, depth])
    says(path, "/cam/depth/image", "'cam_depth'", "'cam'", "not aligned", "--depth-topic /cam/depth/image")
    log = Log(path, names=TopicNames(depth="/cam/depth/image"))
    assert next(iter(log)).depth is not None and "taken as aligned" in log.notes[0]
    aligned = make.image("/other/depth/image", START, MM, "16UC1")
    assert Log(record(tmp_path / "y", "mcap", [INFO, COLOUR, depth, aligned])).depth_topic == "/other/depth/image"


def test_of_two_cameras_one_is_taken_whole_and_the_other_named(tmp_path: Path) -> None:
    messages = []
    for side, fx in (("left", 70.0), ("right", 80.0)):
        messages += [
            make.info(START, fx=fx, topic=f"/{side}/camera_info", frame=side),
            make.image(f"/{side}/image_color", START, RGB, "rgb8", frame=side),
            make.image(f"/{side}/depth", START, MM, "16UC1", frame=side),
        ]
    path = record(tmp_path / "x", "mcap", messages)
    for side, fx in (("left", 70.0), ("right", 80.0)):
        log = Log(path, names=TopicNames(colour=f"/{side}/image_color"))
        (frame,) = log
        assert (frame.frame_id, frame.camera.K[0, 0], log.depth_topic) == (side, fx, f"/{side}/depth")
    assert "--colour-topic" in Log(path).notes[0] and "/right/image_color" in Log(path).notes[0]
    says(path, "no colour image on /up/image", names=TopicNames(colour="/up/image"))


def test_empty_stamps_are_said_and_all_images_have_the_time_of_recording(tmp_path: Path) -> None:
    ms = 1_000_000
    messages = []
    for i in range(3):
        at = START + 33 * i * ms
        colour = make.image("/cam/color/image_raw", 0, RGB, "rgb8")
        depth = make.image("/cam/depth", at - 33 * ms, np.full_like(MM, 500 + i), "16UC1")  # stamped a frame earlier
        messages += [(*m[:2], at, m[3]) for m in (make.info(at), colour, depth)]
    log = Log(record(tmp_path / "x", "mcap", messages))
    read = list(log)
    assert [f.stamp_ns for f in read] == [START + 33 * i * ms for i in range(3)]
    assert [round(1000 * float(f.depth[0, 0])) for f in read if f.depth is not None] == [500, 501, 502]
    (note,) = log.notes
    assert "stamps on /cam/color/image_raw are empty" in note and "time of recording" in note


def test_public_recordings_are_read_as_expected(shared_data: Path) -> None:
    folder = shared_data / "interop"
    depth = next(iter(Log(folder / "depth_65535/a.mcap"))).depth
    assert depth is not None and np.isnan(depth).any() and np.nanmax(depth) < 1.0
    log = Log(folder / "info_other_namespace/a.mcap")
    assert log.info_topic == "/cameras/main_info" and list(log)
    assert next(iter(Log(folder / "frame_id_slash/a.bag"))).frame_id == "camera_color_optical_frame"
    assert "--colour-topic" in Log(folder / "two_cameras/a.mcap").notes[0]
