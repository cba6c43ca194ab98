"""A camera driver's topics become Frames, exactly; what does not fit is left out and said."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.messages import header, make
from node.ros.settings import BusConfig, TopicConfig
from node.ros.topic_source import TopicSource
from perception.sources.frame import Frame

WIDTH, HEIGHT, MS = 32, 24, 1_000_000
COLOUR, DEPTH, INFO = "/cam/color/image_raw", "/cam/depth/image_raw", "/cam/color/camera_info"
START = 1_700_000_000_000_000_000


def picture(seed: int, shape: tuple[int, ...] = (HEIGHT, WIDTH, 3)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def image(stamp: int, array: np.ndarray, encoding: str, frame: str = "cam_optical") -> Any:
    return make(
        "sensor_msgs/msg/Image",
        header=header(stamp, frame),
        height=array.shape[0],
        width=array.shape[1],
        encoding=encoding,
        step=array.strides[0],
        data=np.ascontiguousarray(array).view(np.uint8).ravel(),
    )


class Driver:
    """Publishes as a camera driver does."""

    def __init__(self, bus: Bus) -> None:
        self.colour = bus.publisher(COLOUR, "sensor_msgs/msg/Image")
        self.packed = bus.publisher(f"{COLOUR}/compressed", "sensor_msgs/msg/CompressedImage")
        self.depth = bus.publisher(DEPTH, "sensor_msgs/msg/Image")
        self.info = bus.publisher(INFO, "sensor_msgs/msg/CameraInfo")

    def say_info(self, width: int = WIDTH, frame: str = "cam_optical") -> None:
        K = np.array([30.0, 0, 15.5, 0, 30.0, 11.5, 0, 0, 1])
        P = np.array([40.0, 0, 15.5, 0, 0, 40.0, 11.5, 0, 0, 0, 1, 0])
        d = np.array([0.1, 0, 0, 0, 0])
        size: dict = {"height": HEIGHT, "width": width}
        size |= {"distortion_model": "plumb_bob", "d": d, "k": K, "p": P}
        self.info.publish(make("sensor_msgs/msg/CameraInfo", header=header(START, frame), **size))

    def say(self, i: int, late_ns: int = 0, shape: tuple[int, ...] = (HEIGHT, WIDTH, 3)) -> None:
        stamp = START + i * 33 * MS
        self.colour.publish(image(stamp, picture(i, shape), "rgb8"))
        self.depth.publish(image(stamp + late_ns, np.full((HEIGHT, WIDTH), 500 + i, np.uint16), "16UC1"))


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus(BusConfig(), lambda line: None) as bus:
        yield bus


def wait_for(bus: Bus, count: int) -> None:
    """Until so many images of each kind were taken."""
    deadline = time.monotonic() + 20.0
    while min(bus.counts.of(name).get("received", 0) for name in (COLOUR, DEPTH)) < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def config(**changes) -> TopicConfig:
    return TopicConfig(**{"colour": COLOUR, "depth": DEPTH, "info": INFO, "end_s": 10.0, **changes})


def test_frames_are_what_the_driver_sent(bus: Bus) -> None:
    source, driver = TopicSource(bus, config()), Driver(bus)
    frames = iter(source)
    driver.say_info()
    for i in range(3):
        driver.say(i, late_ns=4 * MS)
        frame = next(frames)
        assert (frame.stamp_ns, frame.frame_id) == (START + i * 33 * MS, "cam_optical")
        np.testing.assert_array_equal(frame.rgb, picture(i))
        np.testing.assert_allclose(frame.depth, 0.5 + 0.001 * i, rtol=1e-6)
        assert frame.camera.K[0, 0] == 30.0 and frame.camera.distortion[0] == 0.1
    source.close()
    assert list(frames) == [] and source.notes == [] and source.dropped == 0
    assert source.live


def test_compressed_and_rectified_without_depth(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(colour=f"{COLOUR}/compressed", depth=None, rectified=True)), Driver(bus)
    driver.say_info()
    png = cv2.imencode(".png", picture(5)[..., ::-1])[1].ravel()
    packed = make(
        "sensor_msgs/msg/CompressedImage",
        header=header(START, "cam_optical"),
        format="rgb8; png compressed bgr8",
        data=png,
    )
    driver.packed.publish(packed)
    frame = next(iter(source))
    np.testing.assert_array_equal(frame.rgb, picture(5))
    assert frame.depth is None and frame.camera.K[0, 0] == 40.0 and not frame.camera.distortion.any()


def test_a_colour_without_its_depth_is_dropped(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(waiting=2, end_s=0.5)), Driver(bus)
    driver.say_info()
    for i in range(6):
        driver.say(i, late_ns=15 * MS)  # 15 ms to its own and 18 ms to the next
        wait_for(bus, i + 1)
    assert list(source) == [] and source.dropped == 6
    assert "dropped for want of depth within 10 ms (the nearest was 15.0 ms" in source.notes[0]
    assert source.notes[0].endswith(" times)")


def test_only_the_newest_frame_waits(bus: Bus) -> None:
    source, driver = TopicSource(bus, config()), Driver(bus)
    driver.say_info()
    deadline = time.monotonic() + 20.0  # what comes before it is not counted
    while source._info is None and time.monotonic() < deadline:
        time.sleep(0.01)
    for i in range(5):
        driver.say(i)
        wait_for(bus, i + 1)
    assert next(iter(source)).stamp_ns == START + 4 * 33 * MS
    deadline = time.monotonic() + 20.0  # an older one may still be in the making
    while source.skipped < 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert source.skipped == 4


def test_an_older_frame_that_is_made_late_is_not_given_after_a_newer_one(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colour and depth have threads of their own: one may be quicker with its frame."""
    source, driver = TopicSource(bus, config(end_s=1.0)), Driver(bus)
    made, hold, held = TopicSource._frame, threading.Event(), threading.Event()

    def slow(self: TopicSource, stamp: int, *others: Any) -> Frame:
        if stamp == START:
            held.set()
            assert hold.wait(20.0)
        return made(self, stamp, *others)

    monkeypatch.setattr(TopicSource, "_frame", slow)
    driver.say_info()
    driver.say(0)
    assert held.wait(20.0)
    with source._changed:  # what the other thread would do meanwhile
        source._order += 1
        source._made = source._order
    hold.set()
    assert list(source) == [] and source.skipped == 1


@pytest.mark.parametrize("wrong", ["image", "info"])
def test_a_wrong_size_is_said(bus: Bus, wrong: str) -> None:
    source, driver = TopicSource(bus, config(end_s=0.6)), Driver(bus)
    driver.say_info(WIDTH if wrong == "image" else 2 * WIDTH)
    driver.say(0, shape=(HEIGHT, WIDTH // 2, 3) if wrong == "image" else (HEIGHT, WIDTH, 3))
    assert list(source) == []
    sizes = "16x24" if wrong == "image" else "64x24"
    assert len(source.notes) == 1 and sizes in source.notes[0] and source.notes[0].startswith("frames are left out: ")


def test_silence_is_said_with_the_topics_that_are_missing(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(silence_s=0.3, end_s=0.8)), Driver(bus)
    driver.say_info()
    assert list(source) == []
    assert len(source.notes) == 1
    assert f"nothing came on {COLOUR}, {DEPTH}; is the driver up" in source.notes[0]


def test_configuration_is_checked() -> None:
    with pytest.raises(ValueError, match="silence_s be positive"):
        TopicConfig(silence_s=0.0)
    with pytest.raises(ValueError, match="/farside/uncertainty, whose name says uncertainty"):
        TopicConfig(depth="/farside/uncertainty")


@pytest.mark.parametrize(
    ("frame", "values", "parts"),
    [
        ("cam_depth", 0.5, ("'cam_depth'", "'cam_optical'", "not aligned", "aligned: true")),
        ("cam_optical", 500.0, ("median is 500 m", DEPTH)),
        ("cam_optical", -0.5, ("100% of its values are negative", DEPTH)),
    ],
)
def test_what_is_no_depth_of_this_camera_is_refused(bus: Bus, frame: str, values: float, parts: tuple) -> None:
    source, driver = TopicSource(bus, config(end_s=0.6)), Driver(bus)
    driver.say_info()
    for i in range(2):
        driver.colour.publish(image(START + i * MS * 33, picture(i), "rgb8"))
        depth = np.full((HEIGHT, WIDTH), values, np.float32)
        driver.depth.publish(image(START + i * MS * 33, depth, "32FC1", frame))
    assert list(source) == [] and len(source.notes) == 1
    for part in ("frames are left out", *parts):
        assert part in source.notes[0]


def test_depth_that_is_said_to_be_aligned_is_taken(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(aligned=True)), Driver(bus)
    driver.say_info()
    driver.colour.publish(image(START, picture(0), "rgb8"))
    driver.depth.publish(image(START, np.full((HEIGHT, WIDTH), 500, np.uint16), "16UC1", "cam_depth"))
    assert next(iter(source)).depth is not None and source.notes == []


def test_camera_info_of_another_camera_is_refused(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(end_s=0.6)), Driver(bus)
    driver.say_info(frame="other")
    driver.say(0)
    assert list(source) == []
    for part in (INFO, "'other'", COLOUR, "'cam_optical'", "another camera's"):
        assert part in source.notes[0]


@pytest.mark.parametrize(("topic", "focal"), [("/cam/image_rect_color", 40.0), ("/cam/corrected/image", 30.0)])
def test_a_rectified_topic_has_the_camera_of_p(bus: Bus, topic: str, focal: float) -> None:
    source, driver = TopicSource(bus, config(colour=topic, depth=None)), Driver(bus)
    driver.say_info()
    bus.publisher(topic, "sensor_msgs/msg/Image").publish(image(START, picture(0), "rgb8"))
    camera = next(iter(source)).camera
    assert camera.K[0, 0] == focal and camera.distortion.any() == (focal == 30.0)


def test_empty_stamps_become_the_time_of_arrival_and_are_said(bus: Bus) -> None:
    source, driver = TopicSource(bus, config(tolerance_ms=2000.0)), Driver(bus)
    driver.say_info()
    before = time.time_ns()
    for _ in range(2):  # depth that arrives before its colour is paired when the next depth comes
        driver.colour.publish(image(0, picture(0), "rgb8"))
        driver.depth.publish(image(0, np.full((HEIGHT, WIDTH), 500, np.uint16), "16UC1"))
        time.sleep(0.05)
    frame = next(iter(source))
    assert before <= frame.stamp_ns <= time.time_ns() and frame.depth is not None
    assert len(source.notes) == 2 and f"stamps on {COLOUR} are empty" in " ".join(source.notes)
