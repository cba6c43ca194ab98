"""What `farside view --live` shows: the objects of one frame at a time, each as it was last told."""

from dataclasses import replace

import pytest

from node.__main__ import main
from node.commands.view_live import Shown, camera_topics
from tests.node.mugs import table_frame
from tests.node.shapes import body_with_handle


def test_a_scene_is_of_one_frame_and_an_object_in_it_is_the_newest() -> None:
    first = body_with_handle()
    second = replace(first, object_id=first.object_id + 1)
    shown = Shown()
    assert shown.take(first) == [first]
    assert shown.take(second) == [first, second]
    better = replace(first, stage=first.stage + 1)
    assert set(map(id, shown.take(better))) == {id(better), id(second)}
    later = replace(second, stamp_ns=second.stamp_ns + 1)
    assert shown.take(later) == [later]


def test_the_view_is_the_frame_of_the_scene() -> None:
    table = replace(table_frame(), label=None, depth=None, T_world_camera=None)
    h = replace(body_with_handle(), stamp_ns=table.stamp_ns, frame_id=table.frame_id)
    shown = Shown()
    assert shown.view() is None
    shown.take(h)
    shown.keep([replace(table, stamp_ns=table.stamp_ns + 1)])
    assert shown.view() is None
    shown.keep([replace(table, frame_id="another")])
    assert shown.view() is None
    shown.keep([table])
    view = shown.view()
    assert view is not None and view.frame is table and view.segments == {}  # by itself nothing is found in it


def test_a_node_tells_its_camera_under_its_own_name() -> None:
    topics = camera_topics("/arm/farside")
    assert topics.colour == "/arm/farside/color/image_raw" and topics.depth == "/arm/farside/depth/image_raw"
    assert topics.info == "/arm/farside/color/camera_info"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "give either FILE"),
        (["a.npz", "--live", "tcp/127.0.0.1:1"], "give either FILE"),
        (["--live", "tcp/127.0.0.1:1", "--out", "a.png"], "omit it with --live"),
        (["--live", "udp/127.0.0.1:1"], "'udp/127.0.0.1:1' is not tcp/address:port"),
    ],
)
def test_what_cannot_be_viewed_is_one_line(arguments: list[str], says: str, capsys: pytest.CaptureFixture) -> None:
    assert main(["view", *arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith("farside: error: ") and said.count("\n") == 1 and says in said
