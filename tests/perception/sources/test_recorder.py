"""A recording gives back what was handed over, is read by others, and survives a kill and a full disk."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from calibration.camera import Camera
from perception.sources.frame import Frame
from perception.sources.recorder import Recorder, write_log
from perception.sources.recording import Log
from perception.sources.ros_images import MM
from perception.sources.settings import RecordConfig

ROOT = Path(__file__).parents[3]
K = np.array([[90.0, 0.0, 31.0], [0.0, 91.0, 23.0], [0.0, 0.0, 1.0]])
RATIONAL = Camera(64, 48, K, np.linspace(-0.2, 0.3, 8), "rational_polynomial")
START = 1_700_000_000_123_456_789


def frame(i: int, unit: float = 0.0, label: bool = True, pose: bool = True) -> Frame:
    """Noise; the depth in whole millimetres, or with `unit` in units of that (m)."""
    rng = np.random.default_rng(i)
    counts = rng.integers(0, 60_000, (48, 64), dtype=np.uint16)
    depth = counts.astype(np.float32) * np.float32(unit) if unit else counts * MM
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.1 * i, 0.2, -0.3]).as_matrix()
    T[:3, 3] = [0.1 * i, -2.0, 0.5]
    return Frame(
        rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
        depth,
        RATIONAL,
        label=rng.integers(0, 900 if i % 2 else 9, (48, 64)).astype(np.int32) if label else None,
        stamp_ns=START + i * 33_333_333,
        frame_id="camera_color",
        T_world_camera=T if pose else None,
    )


def record(path: Path, frames: list[Frame], config: RecordConfig | None = None) -> Recorder:
    with Recorder(path, config, wait=True) as recorder:
        assert all(recorder.write_frame(f) for f in frames)
    assert recorder.error is None and (recorder.frames, recorder.dropped) == (len(frames), 0)
    assert recorder.bytes == path.stat().st_size
    return recorder


def same(read: Frame, written: Frame) -> None:
    """Bit for bit, but for the rotation, which a quaternion keeps to rounding."""
    assert (read.stamp_ns, read.frame_id, read.camera.model) == (
        written.stamp_ns,
        written.frame_id,
        written.camera.model,
    )
    for name in ("rgb", "depth", "label"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    np.testing.assert_array_equal(read.camera.K, written.camera.K)
    np.testing.assert_array_equal(read.camera.distortion, written.camera.distortion)
    if written.T_world_camera is None:
        assert read.T_world_camera is None
    else:
        np.testing.assert_array_equal(read.T_world_camera[:, 3], written.T_world_camera[:, 3])
        np.testing.assert_allclose(read.T_world_camera, written.T_world_camera, atol=1e-12)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("colour", ["raw", "png"])
@pytest.mark.parametrize("unit", [0.0, 0.0001])
def test_a_round_trip_is_exact(tmp_path: Path, colour: str, compression: str, unit: float) -> None:
    frames = [frame(i, unit) for i in range(4)]
    record(tmp_path / "new" / "a.mcap", frames, RecordConfig(colour, compression=compression))
    log = Log(tmp_path / "new" / "a.mcap")
    for a, b in zip(log, frames, strict=True):
        same(a, b)
    assert log.notes == []


def test_what_comes_after_the_end_is_ignored(tmp_path: Path) -> None:
    recorder = record(tmp_path / "a.mcap", [frame(0)], RecordConfig(waiting=1))
    assert not any(recorder.write_frame(frame(i)) for i in range(3)) and recorder.dropped == 0
    for _ in range(3):  # more than may wait
        recorder.write_raw("/x", "std_msgs/msg/String", "string data", b"\0\1\0\0", START)
    assert len(list(Log(tmp_path / "a.mcap"))) == 1


def test_what_a_frame_lacks_stays_absent(tmp_path: Path) -> None:
    bare = Frame(frame(0).rgb, None, RATIONAL, stamp_ns=START, frame_id="cam")
    record(tmp_path / "bare.mcap", [bare])
    (read,) = Log(tmp_path / "bare.mcap")
    assert (read.depth, read.label, read.T_world_camera) == (None, None, None)
    mixed = [frame(0), frame(1, pose=False, label=False), frame(2), frame(3, pose=False)]
    record(tmp_path / "mixed.mcap", mixed)
    for a, b in zip(Log(tmp_path / "mixed.mcap"), mixed, strict=True):
        same(a, b)


def test_jpeg_and_millimetres_are_near(tmp_path: Path) -> None:
    smooth = replace(frame(0, 0.0001), rgb=np.tile(np.arange(64, dtype=np.uint8)[None, :, None] * 3, (48, 1, 3)))
    record(tmp_path / "a.mcap", [smooth], RecordConfig("jpeg", depth="millimetres"))
    (read,) = Log(tmp_path / "a.mcap")
    assert np.abs(read.rgb.astype(int) - smooth.rgb).max() < 10
    far = smooth.depth < 0.0005
    np.testing.assert_allclose(read.depth[~far], smooth.depth[~far], atol=0.000501)
    assert np.isnan(read.depth[far]).all()


def test_others_read_it(tmp_path: Path) -> None:
    """rosbags with its own types, and mcap's own reader with its check sums."""
    path, written = tmp_path / "a.mcap", [frame(i) for i in range(3)]
    record(path, written)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        counts = {c.topic: 0 for c in reader.get_summary().channels.values()}
        for _, channel, message in reader.iter_messages():
            counts[channel.topic] += 1
            assert message.log_time in [f.stamp_ns for f in written]
    assert set(counts.values()) == {3} and len(counts) == 5
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        got: dict[tuple[str, int], Any] = {
            (c.topic, i): bag.deserialize(raw, c.msgtype) for i, c, raw in _numbered(bag)
        }
    image, depth = got["/camera/color/image_raw", 1], got["/camera/aligned_depth_to_color/image_raw", 1]
    assert (image.encoding, image.header.frame_id, image.height, image.width) == ("rgb8", "camera_color", 48, 64)
    np.testing.assert_array_equal(image.data.reshape(48, 64, 3), written[1].rgb)
    np.testing.assert_array_equal(depth.data.view(np.uint16).reshape(48, 64) * MM, np.nan_to_num(written[1].depth))
    info, pose = got["/camera/color/camera_info", 1], got["/camera/color/pose", 1]
    assert (info.distortion_model, info.d.tolist()) == ("rational_polynomial", RATIONAL.distortion.tolist())
    assert pose.header.frame_id == "world" and pose.pose.position.x == 0.1
    assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == written[1].stamp_ns


def _numbered(bag: AnyReader) -> Iterator[tuple]:
    seen: dict[str, int] = {}
    for connection, _, raw in bag.messages():
        yield seen.get(connection.topic, 0), connection, raw
        seen[connection.topic] = seen.get(connection.topic, 0) + 1


def test_messages_of_any_type_lie_beside_the_frames(tmp_path: Path) -> None:
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "farside_msgs/msg/Example"
    store.register(get_types_from_msg("std_msgs/Header header\nfloat32[] weights\nuint8[] opacity", kind))
    types, text = store.types, store.generate_msgdef(kind, ros_version=2)[0]
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](17, 5), "cam")
    opacity = np.random.default_rng(0).integers(0, 256, 100_000, dtype=np.uint8)
    data = store.serialize_cdr(types[kind](header, np.float32([0.25, 0.75]), opacity), kind)
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        recorder.write_frame(frame(0))
        recorder.write_raw("/farside/hypotheses", kind, text, data, START)
        with pytest.raises(ValueError, match="topic /farside/hypotheses holds farside_msgs/msg/Example"):
            recorder.write_raw("/farside/hypotheses", "std_msgs/msg/String", "string data", data, START)
    with AnyReader([path]) as bag:  # it learns the type from the file
        (connection,) = [c for c in bag.connections if c.topic == "/farside/hypotheses"]
        ((_, stamp, raw),) = bag.messages([connection])
        message: Any = bag.deserialize(raw, kind)
    assert stamp == START and bytes(raw) == bytes(data)
    np.testing.assert_array_equal(message.opacity, opacity)
    assert message.weights.tolist() == [0.25, 0.75] and message.header.stamp.sec == 17
    same(next(iter(Log(path))), frame(0))


ENDLESS = """
import sys
import time
from perception.sources.recorder import RecordConfig, Recorder
from tests.perception.sources.test_recorder import frame
with Recorder(sys.argv[1], RecordConfig(flush_s=0.1), wait=True) as recorder:
    flushed = 0
    for i in range(100_000):
        recorder.write_frame(frame(i))
        time.sleep(0.01)
        if recorder.bytes > flushed:  # a chunk has gone to the system
            flushed = recorder.bytes
            print(recorder.frames, flush=True)
"""


def test_a_killed_recording_is_readable(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    with subprocess.Popen([sys.executable, "-c", ENDLESS, path], cwd=ROOT, stdout=subprocess.PIPE, text=True) as child:
        written = [int(child.stdout.readline()) for _ in range(5)]
        child.send_signal(signal.SIGKILL)
    assert child.returncode == -signal.SIGKILL
    log = Log(path)
    read = [got.stamp_ns for got in log]
    assert len(read) >= written[-3] > 0  # what was written two flushes ago is there for certain
    assert read == [START + i * 33_333_333 for i in range(len(read))]
    assert "killed.mcap is cut short at byte" in log.notes[0]
    same(list(log)[-1], frame(len(read) - 1))


def test_a_flip_of_a_bit_ends_what_is_recovered(tmp_path: Path) -> None:
    """Of a cut file nothing is read beyond a chunk whose check sum fails, even where nothing is compressed."""
    path = tmp_path / "a.mcap"
    record(path, [frame(i) for i in range(8)], RecordConfig(compression="none", chunk_bytes=1))
    data = bytearray(path.read_bytes()[:-8])
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    read = list(Log(path))
    assert 2 < len(read) < 6
    for i, got in enumerate(read):
        same(got, frame(i))


@contextmanager
def no_file_beyond(size: int) -> Iterator[None]:
    """The system refuses to let any file grow larger, as it does when a disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def fails(path: Path, said: str) -> None:
    told: list[str] = []
    config = RecordConfig(compression="none", chunk_bytes=1, waiting=2)
    with Recorder(path, config, wait=True, on_error=told.append) as recorder:
        for i in range(100):
            recorder.write_frame(frame(i))  # goes on as if nothing had happened
        recorder.write_raw("/x", "std_msgs/msg/String", "string data", b"\0\1\0\0", START)
    assert told == [recorder.error] and "\n" not in recorder.error
    assert str(path) in recorder.error and said in recorder.error and "make room" in recorder.error
    assert not recorder.write_frame(frame(0))
    recorder.close()
    log = Log(path)
    read = list(log)
    assert 10 < len(read) <= recorder.frames < 100 and "cut short" in log.notes[0]
    for i, got in enumerate(read):
        same(got, frame(i))


def test_a_disk_that_refuses_ends_the_recording_alone(tmp_path: Path) -> None:
    with no_file_beyond(500_000):
        fails(tmp_path / "a.mcap", "File too large")
        with pytest.raises(OSError, match="File too large"):
            write_log(tmp_path / "b.mcap", [frame(i) for i in range(60)])
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_full_disk_ends_the_recording_alone(tmp_path: Path) -> None:
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("may not mount a small disk here")
    try:
        fails(tmp_path / "a.mcap", os.strerror(28))  # ENOSPC
    finally:
        subprocess.run(["umount", tmp_path], check=True)


def test_a_name_that_no_message_holds_is_no_matter_of_room(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with Recorder(path, wait=True) as recorder:
        recorder.write_frame(frame(0))
        recorder.write_frame(replace(frame(1), frame_id="\udcff"))
    assert recorder.error is not None and "the disk is not the cause" in recorder.error
    assert "make room" not in recorder.error and len(list(Log(path))) == 1


def test_what_cannot_be_begun_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, [frame(0)])
    before = path.read_bytes()
    with pytest.raises(OSError, match=r"a\.mcap is there already; give another name"):
        Recorder(path)
    assert path.read_bytes() == before
    with pytest.raises(OSError, match=r"b\.mcap cannot be written \(Not a directory\)"):
        Recorder(path / "b.mcap")
    for wrong in ({"jpeg_quality": 0}, {"flush_s": 0.0}, {"waiting": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            RecordConfig(**wrong)
    many = np.linspace(0, 70000, 48 * 64).astype(np.int32).reshape(48, 64)
    with Recorder(tmp_path / "c.mcap") as recorder, pytest.raises(ValueError, match="label ids run from 0 to 70000"):
        recorder.write_frame(replace(frame(0), label=many))


def test_a_slow_disk_drops_frames_and_counts_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mcap"
    config = RecordConfig("png", waiting=2)
    real, gate = cv2.imencode, Event()
    monkeypatch.setattr(cv2, "imencode", lambda *a: (gate.wait(), real(*a))[1])
    with Recorder(path, config) as recorder:
        kept = [i for i in range(20) if recorder.write_frame(frame(i))]
        gate.set()
    assert 2 <= len(kept) <= 4 and recorder.dropped == 20 - len(kept) and recorder.frames == len(kept)
    assert [f.stamp_ns for f in Log(path)] == [frame(i).stamp_ns for i in kept]
