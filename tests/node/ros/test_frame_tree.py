"""Frames lie where /tf and /tf_static put them at the picture's time; what these do not say is refused in one line."""

import time
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from node.ros.bus import Bus
from node.ros.frame_tree import KEPT_NS, TRANSFORMS, FrameTree, plain
from node.ros.messages import header, make, pose
from node.ros.settings import BusConfig

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000


def place(x: float, turn: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
    T[:3, 3] = [x, 0.2, -0.1]
    return T


def frames(*links: tuple[str, str, np.ndarray], stamp: int = START) -> Any:
    """A TFMessage of (parent, child, p_parent = T @ p_child)."""
    transforms = []
    for parent, child, T in links:
        at = pose(T)
        moved = make("geometry_msgs/msg/Vector3", x=at.position.x, y=at.position.y, z=at.position.z)
        transform = make("geometry_msgs/msg/Transform", translation=moved, rotation=at.orientation)
        transforms.append(
            make(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp, parent),
                child_frame_id=child,
                transform=transform,
            )
        )
    return make(TRANSFORMS, transforms=transforms)


def test_frames_are_chained_through_their_common_one() -> None:
    tree = FrameTree()
    a, b, c = place(1.0, 0.3), place(2.0, -1.0), place(0.5, 2.0)
    tree.take(frames(("/base_link", "arm", a), ("base_link", "head", b)))
    tree.take(frames(("head", "/camera", c)), static=True)
    expected = np.linalg.inv(b @ c) @ a
    np.testing.assert_allclose(tree.T("camera", "arm", START), expected, atol=1e-12)
    np.testing.assert_allclose(tree.T("arm", "camera", START), np.linalg.inv(expected), atol=1e-12)
    np.testing.assert_allclose(tree.T("camera", "camera", START), np.eye(4))
    assert tree.knows("base_link") and not tree.knows("map") and plain("/base_link") == "base_link"


def test_what_lies_above_the_common_frame_does_not_matter() -> None:
    tree = FrameTree()
    tree.take(frames(("map", "base_link", place(5.0)), stamp=START - 60 * SECOND))
    tree.take(frames(("base_link", "camera", place(1.0))), static=True)
    np.testing.assert_allclose(tree.T("base_link", "camera", START), place(1.0), atol=1e-12)
    with pytest.raises(ValueError, match=r"no place of frame 'base_link' within 0\.1 s of the picture's time"):
        tree.T("camera", "map", START)


def test_a_moving_frame_is_where_it_was_between_two_messages() -> None:
    tree = FrameTree()
    for step, (x, turn) in enumerate([(0.0, 0.0), (1.0, 0.2)]):
        tree.take(frames(("base", "camera", place(x, turn)), stamp=START + step * SECOND))
    np.testing.assert_allclose(
        tree.T("base", "camera", START + SECOND // 4), place(0.25, 0.05), atol=2e-4
    )  # a chord for an arc
    np.testing.assert_allclose(tree.T("base", "camera", START - SECOND // 20), place(0.0), atol=1e-12)
    with pytest.raises(ValueError, match="do the clocks of camera and robot agree"):
        tree.T("base", "camera", START - SECOND)


def test_a_pinned_time_is_kept_though_the_frame_moves_on() -> None:
    tree = FrameTree()
    tree.take(frames(("base", "camera", place(1.0))))
    tree.pin(START)
    for step in range(1, 40):
        tree.take(frames(("base", "camera", place(1.0 + step)), stamp=START + step * SECOND // 2))
    assert 39 * SECOND // 2 > KEPT_NS
    np.testing.assert_allclose(tree.T("base", "camera", START), place(1.0), atol=1e-12)
    tree.pin(START + 19 * SECOND)
    with pytest.raises(ValueError, match="no place of frame 'camera'"):
        tree.T("base", "camera", START)
    tree.take(frames(("base", "camera", place(7.0)), stamp=START - 60 * SECOND))  # a recording that began again
    np.testing.assert_allclose(tree.T("base", "camera", START - 60 * SECOND), place(7.0), atol=1e-12)


def test_a_circle_and_an_unknown_frame_end_in_one_line() -> None:
    tree = FrameTree()
    tree.take(frames(("a", "b", place(1.0)), ("b", "a", place(1.0))))
    for frame in ("c", ""):
        with pytest.raises(ValueError, match=f"frame_id is '{frame}', which /tf does not connect to 'a'"):
            tree.T("a", frame, START)


def test_a_wrong_transform_costs_itself_alone() -> None:
    tree = FrameTree()
    message = frames(("base", "bad", place(1.0)), ("base", "good", place(2.0)))
    message.transforms[0].transform.rotation.w += 0.5
    with pytest.raises(ValueError, match="the transform of frame 'bad' is left out"):
        tree.take(message)
    np.testing.assert_allclose(tree.T("base", "good", START), place(2.0), atol=1e-12)
    assert not tree.knows("bad")


def test_it_listens_to_both_topics() -> None:
    with Bus(BusConfig()) as bus:
        static = bus.publisher("/tf_static", TRANSFORMS, latched=True)
        static.publish(frames(("base", "camera", place(1.0))))  # before the tree is there
        tree = FrameTree(bus)
        bus.publisher("/tf", TRANSFORMS).publish(frames(("map", "base", place(2.0))))
        deadline = time.monotonic() + 20.0
        while not (tree.knows("map") and tree.knows("camera")) and time.monotonic() < deadline:
            time.sleep(0.02)
        np.testing.assert_allclose(tree.T("map", "camera", START), place(2.0) @ place(1.0), atol=1e-12)


def test_equal_stamps_take_no_room_and_the_last_counts() -> None:
    tree = FrameTree()
    for n in range(50):
        tree.take(frames(("base_link", "arm", place(float(n)))))
    assert len(tree._edges["arm"].stamps) == 1
    np.testing.assert_allclose(tree.T("base_link", "arm", START)[0, 3], 49.0)


def test_the_node_s_own_objects_are_no_frames_of_the_robot() -> None:
    with Bus(BusConfig()) as bus:
        tree = FrameTree(bus)
        tree.take(frames(("camera", "farside/object_1", place(1.0)), ("base_link", "camera", place(0.0))))
        assert tree.knows("camera") and not tree.knows("farside/object_1")
