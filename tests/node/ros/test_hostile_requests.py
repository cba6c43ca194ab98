"""What a stranger may ask, whatever it is, is answered or refused, costs little, and keeps no other from an answer."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
from rich.console import Console

from node.__main__ import main
from node.ros.bus import Bus
from node.ros.frame_tree import FrameTree
from node.ros.message_counts import MOST_WORDS
from node.ros.messages import NEXT_VIEW, QUERY_REGION, header, make, pose, type_hash
from node.ros.parameters import MOST_NAMES, serve_parameters
from node.ros.planner_messages import ESDF
from node.ros.rmw_zenoh import attachment, key
from node.ros.services import MAX_BOXES, SWEPT, Answers
from node.ros.settings import BusConfig
from node.ros.type_descriptions import GET_TYPE_DESCRIPTION, serve_type_descriptions
from perception.sources.settings import SHIPPED_LOG
from tests.node.ros.test_frame_tree import frames, place
from tests.node.ros.test_planner_services import esdf
from tests.node.ros.test_services import ask, box, oriented
from tests.node.shapes import RIGHT, body_with_handle

CDR = b"\x00\x01\x00\x00"
SERVICES = {
    "query_region": QUERY_REGION,
    "next_view": NEXT_VIEW,
    "get_esdf_and_gradient": ESDF,
    "get_type_description": GET_TYPE_DESCRIPTION,
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
}
FAR = 1e300


def closed(line: str) -> None:
    raise BrokenPipeError("nobody reads what is said")


@pytest.fixture
def bus() -> Iterator[Bus]:
    """A node with all its services, that knows one body and cannot say a word."""
    answers = Answers(frames=FrameTree())
    answers.update([h := body_with_handle()])
    answers.frames.take(frames(("far", h.frame_id, place(FAR))), static=True)
    with Bus(BusConfig(), closed) as bus:
        answers.serve(bus)
        serve_parameters(bus, {"bus.name": "farside", "bus.domain_id": 0, "seed": 7})
        serve_type_descriptions(bus)
        yield bus


def call(bus: Bus, name: str, request: Any) -> Any:
    return bus.call(f"~/{name}", SERVICES[name], request, 30.0)


def test_words_of_a_stranger_are_repeated_harmlessly(bus: Bus) -> None:
    """No control character, no markup, no megabyte; and where nobody can be told, the service goes on."""
    refused = call(bus, "query_region", ask("[/x]\x1b[2J" + 100_000 * "y", **box(*RIGHT)))
    assert not refused.success and refused.message.startswith("frame_id is '[/x]")
    assert len(refused.message) < MOST_WORDS + 10 and refused.message.isprintable()
    assert call(bus, "query_region", ask(**box(*RIGHT))).p_free == pytest.approx(0.3)


def test_the_node_prints_names_as_they_are(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def say(config: Any, out: Console, err: Console) -> None:
        out.print("frame [/a]")
        err.print("frame [/b] of [red]")

    monkeypatch.setattr("node.commands.live.live", say)
    assert main(["live", str(SHIPPED_LOG)]) == 0
    assert tuple(capsys.readouterr()) == ("frame [/a]\n", "frame [/b] of [red]\n")


@pytest.mark.parametrize("name", SERVICES)
def test_bytes_that_are_no_request_are_refused(bus: Bus, name: str) -> None:
    """Cut short, counts beyond all memory, texts that are none, the other byte order: refused at once."""
    where, random = key(0, f"/farside/{name}", SERVICES[name], type_hash(SERVICES[name])), np.random.default_rng(0)
    bodies = [b"", CDR[:3], CDR, CDR + 4 * b"\xff", CDR + 8 * b"\xff", CDR + 400 * b"\xff", b"\x00\x00" + 64 * b"\x01"]
    bodies += [CDR + b"\x05\x00\x00\x00\xc3\x28\xff\xfe\x00" + 40 * b"\x00", CDR + 12 * b"\x00" + 60 * b"\xff"]
    bodies += [CDR + random.integers(0, 256, size, np.uint8).tobytes() for size in (7, 33, 1000)]
    begun = time.monotonic()
    for number, body in enumerate(bodies, start=1):
        replies: Any = bus._session.get(
            where,
            zenoh.handlers.FifoChannel(4),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            payload=body,
            attachment=attachment(number, 0, 16 * b"a"),
            timeout=20.0,
        )
        assert all(reply.err is None or "Timeout" not in reply.err.payload.to_string() for reply in replies), body
    assert time.monotonic() - begun < 20.0
    good = make(f"{SERVICES[name]}_Request")
    try:
        call(bus, name, good)
    except OSError as error:
        assert "refused" in str(error)


def points(count: int, at: float = 0.0) -> list[Any]:
    return [make("geometry_msgs/msg/Point", x=at)] * count


def edges(count: int, size: float = 0.01) -> list[Any]:
    return [make("geometry_msgs/msg/Vector3", x=size, y=size, z=size)] * count


def to_clear(count: int, at: float = 0.0, size: float = 0.01, radius: float = 0.01) -> dict[str, Any]:
    boxes = {"aabbs_to_clear_min_m": points(count, at), "aabbs_to_clear_size_m": edges(count, size)}
    return boxes | {"spheres_to_clear_center_m": points(1), "spheres_to_clear_radius_m": np.float32([radius])}


@pytest.mark.parametrize(
    ("request_", "complaint"),
    [
        (esdf("object", **to_clear(10_000)), f"10001 shapes are to be cleared; give at most {MAX_BOXES}"),
        (esdf("object", **to_clear(1, at=np.nan)), "not finite, or beyond"),
        (esdf("object", **to_clear(1, size=np.inf)), "not finite, or beyond"),
        (esdf("object", **to_clear(1, radius=np.nan)), "not finite, or beyond"),
        (esdf("far"), "whose origin /tf puts beyond"),
    ],
)
def test_distances_are_bounded(request_: Any, complaint: str) -> None:
    answers = Answers(frames=FrameTree())
    answers.update([h := body_with_handle()])
    answers.frames.take(frames(("far", h.frame_id, place(FAR))), static=True)
    assert answers.distances(esdf("object", **to_clear(MAX_BOXES - 1))).success
    with pytest.raises(ValueError, match=complaint):
        answers.distances(request_)


def test_regions_and_views_as_far_as_numbers_go(bus: Bus) -> None:
    wide = call(bus, "query_region", ask(**box((-1e6, -1e6, -1e6), (1e6, 1e6, 1e6))))
    assert wide.success and wide.p_free == 0.0 and 0.99 < wide.outside_fraction < 1.0
    hair = call(bus, "query_region", ask(kind=SWEPT, boxes=[oriented(np.eye(4), (1e-300, 1e-300, 1e6))]))
    assert hair.success and hair.p_free == 0.0 and 0.99 < hair.outside_fraction < 1.0
    T = np.eye(4)
    T[0, 3] = FAR
    for request, complaint in (
        (ask(**box((-FAR, 0, 0), (FAR, 1, 1))), "not finite, or beyond"),
        (ask("far", **box(*RIGHT)), "a box's pose is not finite"),
        (ask(**box((np.nan, 0, 0), (1, 1, 1))), "not finite"),
        (ask(kind=SWEPT, boxes=10_000 * [oriented(np.eye(4), (0.01, 0.01, 0.01))]), "there are 10000 boxes; give 1 to"),
    ):
        refused = call(bus, "query_region", request)
        assert not refused.success and complaint in refused.message
    for frame, candidates in (("object", [pose(T)]), ("far", [])):
        request = make(f"{NEXT_VIEW}_Request", header=header(0, frame), candidates=candidates)
        refused = call(bus, "next_view", request)
        assert not refused.success and "beyond 1e+06 m" in refused.message


def test_parameters_are_asked_for_by_the_name_alone(bus: Bus) -> None:
    """Unknown names, wrong kinds and repeated prefixes have an answer; many thousand names have none."""

    def asked(name: str, **fields: Any) -> Any:
        return call(bus, name, make(f"{SERVICES[name]}_Request", **fields))

    strange = ["", "bus", "bus.", "[/x]", "\x00", "seed " * 1000]
    assert [value.type for value in asked("get_parameters", names=strange).values] == [0] * len(strange)
    assert asked("list_parameters", prefixes=["bus", "bus", "bus.name"]).result.names == ["bus.domain_id", "bus.name"]
    value = make("rcl_interfaces/msg/ParameterValue", type=77, integer_value=-1)
    change = make("rcl_interfaces/msg/Parameter", name="nothing", value=value)
    for results in (
        asked("set_parameters", parameters=[change]).results,
        [asked("set_parameters_atomically", parameters=[change]).result],
    ):
        assert [it.successful for it in results] == [False]
    many = {"get_parameters": "names", "list_parameters": "prefixes", "set_parameters": "parameters"}
    for name, field in many.items():
        entries = [change if field == "parameters" else "x"] * (MOST_NAMES + 1)
        with pytest.raises(OSError, match=f"{field} has {MOST_NAMES + 1} entries; give at most {MOST_NAMES}"):
            asked(name, **{field: entries})
