"""A log comes back as it was written; a damaged or unfit one says so in one line."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.open_source import open_source
from perception.sources.recorder import write_log
from perception.sources.recording import Log

REAL = Path(__file__).parents[3] / "../shared/data/ros1_bag/aruco_images.bag"
CAMERA = Camera(64, 48, np.array([[90.0, 0.0, 31.0], [0.0, 91.0, 23.0], [0.0, 0.0, 1.0]]), np.full(5, 0.01))
START = 1_700_000_000_123_456_789


def frames(count: int = 3, label: bool = True) -> list[Frame]:
    rng = np.random.default_rng(0)
    out = []
    for i in range(count):
        rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        depth = rng.uniform(0.3, 5.0, (48, 64)).astype(np.float32)
        depth[rng.random((48, 64)) < 0.2] = np.nan
        ids = rng.integers(0, 9 if i % 2 else 900, (48, 64)).astype(np.int32) if label else None
        out.append(Frame(rgb, depth, CAMERA, label=ids, stamp_ns=START + i * 33_333_333, frame_id="camera_color"))
    return out


def same(read: list[Frame], written: list[Frame]) -> None:
    assert len(read) == len(written) > 0
    for a, b in zip(read, written, strict=True):
        assert (a.stamp_ns, a.frame_id) == (b.stamp_ns, b.frame_id)
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_allclose(a.depth, b.depth, atol=0.000501)  # whole millimetres; NaN stays NaN
        np.testing.assert_array_equal(a.label, b.label)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
        np.testing.assert_array_equal(a.camera.distortion, b.camera.distortion)


def says(path: Path, *parts: str, **options: Any) -> None:
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        list(Log(path, **options))
    assert "\n" not in str(caught.value)
    for part in (path.name, *parts):
        assert part in str(caught.value)


Message = tuple[str, str, int, Any]


def record(path: Path, kind: str, messages: list[Message]) -> Path:
    """Messages (topic, type, stamp, message) into a recording of one of the three kinds."""
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_JAZZY)
    if kind == "bag":
        writer: Any = Writer1(path)
    else:
        writer = Writer2(
            path, version=9, storage_plugin=StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        )
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, stamp, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            serialize = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
            writer.write(connections[topic], stamp, serialize(message, msgtype))
    return path


def maker(kind: str) -> Any:
    """Functions that make (topic, type, stamp, message) in ROS 1 or ROS 2."""
    t = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_JAZZY).types

    def header(stamp: int, frame: str = "cam") -> Any:
        time = t["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))
        return t["std_msgs/msg/Header"](*([0] if kind == "bag" else []), stamp=time, frame_id=frame)

    class Make:
        @staticmethod
        def image(
            topic: str, stamp: int, array: np.ndarray, encoding: str, big: int = 0, pad: int = 0, frame: str = "cam"
        ) -> Message:
            rows = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
            rows = np.pad(rows, ((0, 0), (0, pad)))
            image = t["sensor_msgs/msg/Image"]
            size = array.shape[:2]
            return (
                topic,
                "sensor_msgs/msg/Image",
                stamp,
                image(header(stamp, frame), *size, encoding, big, rows.shape[1], rows.ravel()),
            )

        @staticmethod
        def compressed(topic: str, stamp: int, data: np.ndarray, form: str) -> Message:
            name = "sensor_msgs/msg/CompressedImage"
            return topic, name, stamp, t[name](header(stamp), form, data)

        @staticmethod
        def info(
            stamp: int,
            fx: float = 90.0,
            topic: str = "/cam/camera_info",
            size: tuple[int, int] = (48, 64),
            frame: str = "cam",
        ) -> Message:
            name = "sensor_msgs/msg/CameraInfo"
            K = np.array([fx, 0, 31, 0, 91, 23, 0, 0, 1.0])
            roi = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            P = np.insert(K, [3, 6, 9], 0.0)
            return (
                topic,
                name,
                stamp,
                t[name](header(stamp, frame), *size, "plumb_bob", np.zeros(5), K, np.eye(3).ravel(), P, 0, 0, roi),
            )

    return Make


MS = 1_000_000
RGB = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
MM = np.random.default_rng(2).integers(0, 4000, (48, 64), dtype=np.uint16)


def test_a_given_calibration_needs_no_camera_info(tmp_path: Path) -> None:
    make = maker("mcap")
    messages = [make.image("/cam/color/image", 10, RGB, "rgb8"), make.image("/cam/depth/image", 10, MM, "16UC1")]
    bare = record(tmp_path / "bare", "mcap", messages)
    told = record(tmp_path / "told", "mcap", [make.info(5), *messages])
    for log in (open_source(bare, CAMERA), Log(told, camera=CAMERA)):
        (frame,) = log
        assert frame.camera is CAMERA and np.array_equal(frame.rgb, RGB) and frame.depth is not None
    (frame,) = Log(told)
    assert frame.camera.K[0, 0] == 90.0


@pytest.mark.parametrize("label", [True, False])
def test_what_is_written_is_read(tmp_path: Path, label: bool) -> None:
    path = tmp_path / "a.mcap"
    assert write_log(path, frames(label=label)) == 3
    log = Log(path)
    if label:
        same(list(log), frames())
        same(list(log), frames())  # a second pass reads the same
    else:
        assert [f.label for f in log] == [None] * 3
    assert log.notes == []
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert len(list(open_source(path))) == 3


def test_writing_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def broken() -> Any:
        yield frames()[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_log(tmp_path / "a.mcap", broken())
    with pytest.raises(ValueError, match="no frame"):
        write_log(tmp_path / "a.mcap", [])
    assert list(tmp_path.iterdir()) == []


def test_frames_without_depth_or_in_world_pass(tmp_path: Path) -> None:
    frame = Frame(RGB, None, CAMERA, stamp_ns=START, frame_id="cam")
    write_log(tmp_path / "a.mcap", [frame])
    log = Log(tmp_path / "a.mcap")
    (read,) = log
    assert read.depth is None and "no depth" in log.notes[0]


def test_a_log_cut_short_gives_what_is_there(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    written = frames(60)
    write_log(whole, written)
    data = whole.read_bytes()
    size = int(len(data) * 0.7)
    cut.write_bytes(data[:size])
    log = Log(cut)
    read = list(log)
    assert 10 < len(read) < 60
    same(read, written[: len(read)])
    assert f"cut.mcap is cut short at byte {size}; " in log.notes[0] and "messages recovered" in log.notes[0]
    bag = tmp_path / "killed"  # a recorder that was killed leaves a folder without metadata.yaml
    bag.mkdir()
    cut.rename(bag / "killed_0.mcap")
    assert len(list(Log(bag))) == len(read)


def test_damage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_log(path, frames(60))
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:200])
    says(path, "no readable message")
    path.write_bytes(b"")
    says(path, "no readable message")
    path.write_bytes(b"hello" * 100)
    says(path, "no readable message")
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    path.write_bytes(data)
    says(path, "damaged")
    bag = tmp_path / "b.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    says(bag, "rosbag reindex")
    says(tmp_path / "none.mcap", "does not exist")
    (tmp_path / "text.txt").write_text("x")
    says(tmp_path / "text.txt", "cannot be read as a recording")
    (tmp_path / "empty").mkdir()
    says(tmp_path / "empty", "neither")


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "bag"])
def test_every_kind_of_recording_reads(tmp_path: Path, kind: str) -> None:
    make = maker(kind)
    path = record(
        tmp_path / ("x.bag" if kind == "bag" else "x"),
        kind,
        [
            make.info(START),
            make.image("/cam/rgb/image_raw", START + MS, RGB, "rgb8", pad=8),
            make.image("/cam/depth/image_raw", START + 4 * MS, MM, "16UC1"),
            make.image("/cam/segmentation/image_raw", START + 4 * MS, (MM % 5).astype(np.uint8), "8UC1"),
        ],
    )
    (frame,) = Log(path)
    assert frame.stamp_ns == START + MS and frame.frame_id == "cam"
    np.testing.assert_array_equal(frame.rgb, RGB)
    np.testing.assert_allclose(np.nan_to_num(frame.depth), MM * 1e-3, atol=1e-6)
    np.testing.assert_array_equal(frame.label, MM % 5)
    assert frame.camera.K[0, 0] == 90.0


@pytest.mark.parametrize(
    ("encoding", "array"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, RGB[..., :1]])),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., :1]])),
    ],
)
def test_every_colour_encoding_reads(tmp_path: Path, encoding: str, array: np.ndarray) -> None:
    make = maker("mcap")
    (frame,) = Log(record(tmp_path / "x", "mcap", [make.info(START), make.image("/cam/image", START, array, encoding)]))
    np.testing.assert_array_equal(frame.rgb, RGB)


def test_every_depth_encoding_reads(tmp_path: Path) -> None:
    make = maker("mcap")
    png = cv2.imencode(".png", MM)[1].ravel()
    jpeg = make.compressed("/cam/image/compressed", START, cv2.imencode(".jpg", RGB[..., ::-1])[1].ravel(), "jpeg")
    for i, depth in enumerate(
        [
            make.image("/cam/depth", START, MM, "16UC1"),
            make.image("/cam/depth", START, MM.byteswap(), "16UC1", big=1),
            make.image("/cam/depth", START, MM, "mono16"),
            make.image("/cam/depth", START, MM.astype(np.float32) * np.float32(1e-3), "32FC1"),
            make.compressed("/cam/depth/compressed", START, png, "16UC1; png"),
            make.compressed("/cam/depth", START, np.append(np.zeros(12, np.uint8), png), "16UC1; compressedDepth png"),
        ]
    ):
        (frame,) = Log(record(tmp_path / f"{i}", "mcap", [make.info(START), jpeg, depth]))
        np.testing.assert_allclose(np.nan_to_num(frame.depth), MM * 1e-3, atol=1e-6)
        assert np.abs(frame.rgb.astype(int) - RGB).mean() < 60  # JPEG of noise


def test_colour_takes_the_nearest_depth_and_the_latest_camera(tmp_path: Path) -> None:
    make = maker("mcap")
    messages = []
    for i in range(50):  # colour every 33 ms, depth every 11 ms and 3 ms late
        messages.append(make.image("/cam/image", START + 33 * i * MS, RGB, "rgb8"))
        for j in range(3):
            k = 3 * i + j
            messages.append(make.image("/cam/depth", START + (11 * k + 3) * MS, np.full_like(MM, 500 + k), "16UC1"))
        if i in (5, 20):
            messages.append(make.info(START + (33 * i + 1) * MS, fx=100.0 + i))
    read = list(Log(record(tmp_path / "x", "mcap", sorted(messages, key=lambda m: m[2]))))
    assert [round(float(f.depth[0, 0]) * 1000) for f in read] == [500 + 3 * i for i in range(50)]
    assert [f.camera.K[0, 0] for f in read] == [105.0] * 21 + [120.0] * 29


def test_streams_that_do_not_pair_are_named(tmp_path: Path) -> None:
    make = maker("mcap")
    late = [
        make.info(START),
        make.image("/cam/image", START, RGB, "rgb8"),
        make.image("/cam/depth", START + 35 * MS, MM, "16UC1"),
    ]
    path = record(tmp_path / "x", "mcap", late)
    says(path, "within 10 ms", "35.0 ms away")
    assert len(list(Log(path, tolerance_ns=40 * MS))) == 1
    log = Log(record(tmp_path / "y", "mcap", [*late, make.image("/cam/image", START + 36 * MS, RGB, "rgb8")]))
    assert len(list(log)) == 1
    assert "1 colour images without depth" in log.notes[-1]


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    make = maker("mcap")
    colour, depth = make.image("/cam/image", START, RGB, "rgb8"), make.image("/cam/depth", START, MM, "16UC1")
    says(record(tmp_path / "a", "mcap", [colour, depth]), "no camera_info")
    says(record(tmp_path / "b", "mcap", [make.info(START), depth]), "no colour image", "/cam/depth (16UC1)")
    says(record(tmp_path / "c", "mcap", [make.info(START)]), "no colour image", "none")
    small = make.image("/cam/depth", START, MM[:24, :32], "16UC1")
    says(record(tmp_path / "d", "mcap", [make.info(START), colour, small]), "32x24", "64x48", "aligned")
    odd = make.image("/cam/image", START, MM, "16SC1")
    says(record(tmp_path / "e", "mcap", [make.info(START), odd]), "16SC1")
    wrong = make.info(START, size=(480, 640))
    says(record(tmp_path / "f", "mcap", [wrong, colour]), "640x480", "64x48")
    says(record(tmp_path / "g", "mcap", [make.info(START, fx=0.0), colour]), "camera_info", "positive focal")
    colour[3].data = colour[3].data[:100]
    says(record(tmp_path / "h", "mcap", [make.info(START), colour]), "100 bytes")


@pytest.mark.skipif(not REAL.exists(), reason="../shared/data/ros1_bag is not beside this checkout")
def test_the_real_bag_reads() -> None:
    log = Log(REAL)
    (frame,) = log
    assert frame.rgb.shape == (960, 1280, 3) and frame.depth is None
    assert frame.camera.distortion.any()
    assert "no depth" in log.notes[0]


@pytest.mark.parametrize(("field", "kind"), [("width", "CameraInfo"), ("is_bigendian", "Image")])
def test_a_damaged_definition_is_named(tmp_path: Path, field: str, kind: str) -> None:
    path = tmp_path / "a.mcap"
    write_log(path, frames())
    data = path.read_bytes()
    assert field.encode() in data
    spoilt = data.replace(f" {field}\n".encode(), f" {field[:-1]}_\n".encode())
    path.write_bytes(spoilt)
    says(path, "damaged", f"definition of sensor_msgs/msg/{kind} lacks {field}")
