"""Boxes of another node's detector choose what is inferred, in the picture of their stamp and frame."""

import re
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.detections import DETECTIONS_IN, boxes_of, kept_ids
from node.ros.messages import frame_messages, header, make
from node.ros.settings import BusConfig, TopicConfig
from node.ros.topic_source import TopicSource
from perception.observation.segmentation import label_boxes, segment
from perception.sources.frame import Frame
from tests.node.mugs import table_frame

START = 1_700_000_000_000_000_000
SIZE = (640, 480)


def detection(x: float, y: float, across: float, down: float, score: float | None = 0.9, turn: float = 0.0) -> Any:
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id="cup", score=score or 0.0)
    results = [make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis)] if score is not None else []
    centre = make("vision_msgs/msg/Pose2D", position=make("vision_msgs/msg/Point2D", x=x, y=y), theta=turn)
    box = make("vision_msgs/msg/BoundingBox2D", center=centre, size_x=across, size_y=down)
    return make("vision_msgs/msg/Detection2D", results=results, bbox=box)


def detections(*found: Any, stamp: int = START, frame: str = "cam") -> Any:
    return make(DETECTIONS_IN, header=header(stamp, frame), detections=list(found))


def about(frame: Frame, object_id: int) -> Any:
    """A tight box about an object of the frame's label map."""
    v, u = np.nonzero(frame.label == object_id)
    across, down = np.ptp(u) + 1.0, np.ptp(v) + 1.0
    return detection(u.min() + across / 2, v.min() + down / 2, across, down)


def test_boxes_are_a_little_wider_and_inside_the_picture() -> None:
    found = boxes_of(detections(detection(100, 80, 40, 20), detection(0, 470, 100, 100)), "cam", SIZE, 0.3)
    assert found == [(76, 66, 124, 94), (0, 412, 58, 480)]


def test_the_surest_are_first_and_doubtful_ones_do_not_count() -> None:
    few = [detection(100, 80, 10, 10, 0.4), detection(300, 80, 10, 10, 0.8), detection(500, 80, 10, 10, 0.2)]
    few += [detection(50, 80, 10, 10, None), detection(60, 80, 0, 10), detection(900, 80, 10, 10)]
    assert [box[0] for box in boxes_of(detections(*few), "cam", SIZE, 0.3)] == [41, 291, 91]  # no score: sure


def test_a_turned_box_gives_the_upright_one_about_it() -> None:
    (box,) = boxes_of(detections(detection(100, 100, 60, 20, turn=np.pi / 2)), "/cam".removeprefix("/"), SIZE, 0.3)
    assert box == (86, 65, 114, 135)


def test_other_frames_and_senseless_boxes_are_refused() -> None:
    assert (
        boxes_of(detections(frame="/cam"), "cam", SIZE, 0.3) == boxes_of(detections(frame=""), "cam", SIZE, 0.3) == []
    )
    with pytest.raises(ValueError, match="detections are of frame 'left', colour of 'cam'"):
        boxes_of(detections(frame="left"), "cam", SIZE, 0.3)
    with pytest.raises(ValueError, match="give finite pixels"):
        boxes_of(detections(detection(float("nan"), 0, 1, 1)), "cam", SIZE, 0.3)


@pytest.fixture(scope="module")
def table() -> Frame:
    return replace(table_frame(), stamp_ns=START, frame_id="cam")


def test_what_is_in_a_box_is_the_object(table: Frame) -> None:
    message = detections(about(table, 1), detection(20, 20, 30, 30))
    boxes = boxes_of(message, "cam", table.rgb.shape[1::-1], 0.3)
    label, why = label_boxes(replace(table, label=None), boxes)
    true = table.label == 1
    assert set(np.unique(label)) == {0, 1} and len(why) == 1 and "nothing that stands" in why[0]
    assert (true & (label == 1)).sum() / (true | (label == 1)).sum() > 0.8
    (only,) = segment(replace(table, label=label))
    assert only.id == 1


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus(BusConfig(), lambda line: None) as bus:
        yield bus


def test_pictures_are_paired_with_their_detections(bus: Bus, table: Frame) -> None:
    """Those without are passed over, and those of another camera are named."""
    names = {"color/image_raw": "/c", "depth/image_raw": "/d", "color/camera_info": "/i"}
    source = TopicSource(bus, TopicConfig(colour="/c", depth="/d", info="/i", detections="/found", end_s=20.0))
    kinds = {name: f"sensor_msgs/msg/{'CameraInfo' if name.endswith('info') else 'Image'}" for name in names}
    senders = {name: bus.publisher(names[name], kind) for name, kind in kinds.items()}
    found = bus.publisher("/found", DETECTIONS_IN)
    frames = iter(source)

    def say(i: int) -> Frame:
        frame = replace(table, stamp_ns=START + i * 33_000_000, label=None)
        for name, message in frame_messages(frame).items():
            senders[name].publish(message)
        deadline = time.monotonic() + 20.0  # a few wait, and the oldest are dropped
        while (
            any(bus.counts.of(name).get("received", 0) <= i for name in names.values()) and time.monotonic() < deadline
        ):
            time.sleep(0.005)
        return frame

    sent = [say(i) for i in range(4)]
    found.publish(detections(about(table, 1), stamp=sent[1].stamp_ns))
    found.publish(detections(about(table, 1), about(table, 2), stamp=sent[3].stamp_ns))
    got = next(frames)
    while got.stamp_ns != sent[3].stamp_ns:
        assert got.stamp_ns == sent[1].stamp_ns
        got = next(frames)
    assert set(np.unique(got.label)) - {0}
    np.testing.assert_array_equal(got.rgb, table.rgb)
    found.publish(detections(about(table, 1), stamp=say(4).stamp_ns, frame="left"))
    found.publish(detections(about(table, 1), stamp=say(5).stamp_ns))
    assert next(frames).stamp_ns == START + 5 * 33_000_000
    assert any("detections are of frame 'left'" in note for note in source.notes)
    assert source.skipped >= 2 and source.dropped == 0  # pictures 0 and 2 have no detections
    found.publish(detections(stamp=say(6).stamp_ns))
    gone = next(frames)
    assert gone.stamp_ns == START + 6 * 33_000_000 and gone.label is not None and not gone.label.any()
    with pytest.raises(ValueError, match="the label map names no objects"):
        segment(gone)
    source.close()


@pytest.mark.parametrize(
    ("late_ns", "says"),
    [
        (14_000_000, r"within 10 ms \(the nearest is 1[49].0 ms away\); have the detector copy header.stamp"),
        (-3_600_000_000_000, r"\(the nearest is 36\d\d\d\d\d.0 ms away\); .* more than 60 images late, raise waiting"),
    ],
)
def test_stamps_that_pair_with_no_picture_are_said(bus: Bus, table: Frame, late_ns: int, says: str) -> None:
    """How far apart they are, and what to do, whether the pictures wait still or were given up."""
    topics = TopicConfig(colour="/c", depth=None, info="/i", detections="/found", silence_s=0.5, end_s=2.0)
    source, found = TopicSource(bus, topics), bus.publisher("/found", DETECTIONS_IN, depth=10)
    colour, info = bus.publisher("/c", "sensor_msgs/msg/Image"), bus.publisher("/i", "sensor_msgs/msg/CameraInfo")
    for i in range(4):
        frame = replace(table, stamp_ns=START + i * 33_000_000, label=None)
        messages = frame_messages(frame)
        info.publish(messages["color/camera_info"])
        colour.publish(messages["color/image_raw"])
        found.publish(detections(about(table, 1), stamp=frame.stamp_ns + late_ns))
        time.sleep(0.02)
    assert list(source) == []
    (note,) = source.notes
    assert note.startswith("no frame for ") and "nothing on /found has the stamp of a colour image" in note
    assert re.search(says, note), note


def test_a_thing_keeps_its_id_whatever_its_score() -> None:
    left, right, other = (10, 10, 60, 60), (200, 10, 260, 60), (400, 10, 460, 60)
    first = kept_ids([left, right], {})
    assert first == [1, 2]
    last = dict(zip(first, [left, right], strict=True))
    moved = (204, 14, 262, 66)
    assert kept_ids([moved, left, other], last) == [2, 1, 3]
    assert kept_ids([other], last) == [3]  # not the number of what is not seen now
    assert kept_ids([], last) == []
