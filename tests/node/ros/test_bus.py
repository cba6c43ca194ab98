"""The bus in one process: closed by default, bounded, and not shaken by what is wrong."""

import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from node.commands.config_file import load_config
from node.ros.bus import Bus
from node.ros.messages import encode, make, register_service, type_hash
from node.ros.rmw_zenoh import RosNode, attachment, gid, key, read_attachment
from node.ros.settings import BusConfig
from tests.node.peer import SET, SET_TEXT
from tests.node.shapes import free_port

TEXT = "std_msgs/msg/String"
GID = bytes(range(16))


def until(condition: Callable[[], object], seconds: float = 20.0) -> bool:
    """Whether it holds once: a router's answer may lack a node that the one before had."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.02)
    return False


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def bus(said: list[str]) -> Iterator[Bus]:
    """A bus that takes messages of at most 1000 bytes, and says what is wrong into `said`."""
    with Bus(BusConfig(max_message_bytes=1000, max_request_bytes=100), said.append) as bus:
        yield bus


def text(data: str) -> Any:
    return make(TEXT, data=data)


@pytest.mark.parametrize(
    ("token", "expected"),
    [
        ("@ros2_lv/0/a1b2/0/0/NN/%/%/n", "a6b35e3459529eb468afb74a01a80ef1"),
        (
            "@ros2_lv/3/a1b2/0/7/MP/%/%robot/farside/%robot%image/sensor_msgs::msg::dds_::Image_/RIHS01_00/::,10:,:,:,,",
            "7b88349068d0f625835b5e3f02955eab",
        ),
        ("x" * 300, "5435c87d60b4d1a57abcd72aea375212"),
    ],
)
def test_a_gid_is_the_hash_of_the_token(token: str, expected: str) -> None:
    """XXH3 of 128 bits, the low half first, each half little-endian, as rmw_zenoh_cpp has it."""
    assert gid(token).hex() == expected


def test_names_are_those_of_ros() -> None:
    node = RosNode(3, "a1b2", "/robot", "farside")
    assert node.resolve("~/hypotheses") == "/robot/farside/hypotheses"
    assert (node.resolve("tf"), node.resolve("/tf")) == ("/robot/tf", "/tf")
    for name in ("", "a b", "~", "/a//b", "a/", "9a", "é"):
        with pytest.raises(ValueError, match="is no ROS name"):
            node.resolve(name)
    kind, hashed = "sensor_msgs/msg/Image", "RIHS01_00"
    assert key(3, "/robot/image", kind, hashed) == "3/robot/image/sensor_msgs::msg::dds_::Image_/RIHS01_00"
    token = node.token(7, "MP", "/robot/image", kind, hashed, "::,10:,:,:,,")
    expected = (
        "@ros2_lv/3/a1b2/0/7/MP/%/%robot/farside/%robot%image/sensor_msgs::msg::dds_::Image_/RIHS01_00/::,10:,:,:,,"
    )
    assert token == expected
    assert RosNode(0, "a1b2", "/", "n").token(0, "NN") == "@ros2_lv/0/a1b2/0/0/NN/%/%/n"


def test_an_attachment_has_33_bytes_and_comes_back() -> None:
    data = attachment(5, 10**18, GID)
    assert data == (5).to_bytes(8, "little") + (10**18).to_bytes(8, "little") + b"\x10" + GID
    assert read_attachment(data) == (5, 10**18, GID)
    with pytest.raises(ValueError, match="the attachment has 32 bytes"):
        read_attachment(data[:-1])


def test_what_leaves_is_what_ros_expects(bus: Bus) -> None:
    """The sample's key is the topic's, its bytes the message's, and its sender the entity that the graph shows."""
    came: list[zenoh.Sample] = []
    bus._session.declare_subscriber("0/**", came.append)
    publisher = bus.publisher("~/words", TEXT, depth=3)
    before = time.time_ns()
    publisher.publish(text("a"))
    publisher.publish(text("b"))
    assert until(lambda: len(came) == 2)
    assert str(came[0].key_expr) == f"0/farside/words/std_msgs::msg::dds_::String_/{type_hash(TEXT)}"
    assert [sample.payload.to_bytes() for sample in came] == [encode(text("a")), encode(text("b"))]
    token = next(t for t in bus.graph() if "/MP/" in t)
    assert token.endswith(f"/MP/%/%/farside/%farside%words/std_msgs::msg::dds_::String_/{type_hash(TEXT)}/::,3:,:,:,,")
    for i, sample in enumerate(came, 1):
        sequence, sent, sender = read_attachment(sample.attachment.to_bytes())
        assert sequence == i and before <= sent <= time.time_ns() and sender == gid(token)


def test_what_is_wrong_is_counted_and_said_once(bus: Bus, said: list[str]) -> None:
    """Bytes that are no message, too many of them, no attachment, gaps: the good ones still arrive, in order."""
    came: list[str] = []
    bus.subscribe("/t", TEXT, lambda message: came.append(message.data), depth=50)
    where = key(0, "/t", TEXT, type_hash(TEXT))
    good = bytes(encode(text("good")))
    big = bytes(encode(text("x" * 2000)))
    for sequence, data in enumerate([good, b"", b"\x00\x01\x00\x00\xff\xff\xff\xff", good[:-3], big, big, good], 1):
        bus._session.put(where, data, attachment=attachment(sequence, 0, GID))
    bus._session.put(where, good)
    bus._session.put(where, good, attachment=attachment(12, 0, GID))
    counts = {"received": 3, "malformed": 4, "too_large": 2, "dropped": 4}
    assert until(lambda: bus.counts.of("/t") == counts), bus.counts.of("/t")
    assert came == ["good"] * 3
    lines = "\n".join(sorted(said))  # of the two senders, either may be handled first
    assert len(said) == 2 and "larger than max_message_bytes (1000)" in lines
    assert "bytes are no std_msgs/msg/String" in lines or "has no attachment" in lines


def test_a_handler_that_fails_is_called_again(bus: Bus, said: list[str]) -> None:
    came: list[str] = []

    def take(message: Any) -> None:
        came.append(message.data)
        raise RuntimeError("broken")

    bus.subscribe("/t", TEXT, take, depth=5)
    publisher = bus.publisher("/t", TEXT)
    assert publisher.publish(text("a")) and publisher.publish(text("b"))
    assert until(lambda: came == ["a", "b"])
    assert until(lambda: bus.counts.of("/t") == {"sent": 2, "failed": 2})
    assert said == ["/t: RuntimeError: broken (further ones are only counted)"]


def test_a_slow_handler_misses_messages_and_holds_up_nobody(bus: Bus) -> None:
    entered, gate, came = threading.Event(), threading.Event(), []

    def take(message: Any) -> None:
        entered.set()
        gate.wait(20.0)
        came.append(message.data)

    bus.subscribe("/t", TEXT, take, depth=2)
    publisher = bus.publisher("/t", TEXT)
    for i in range(50):
        assert publisher.publish(text(str(i)))
        assert entered.wait(20.0)
    gate.set()
    assert until(lambda: came[-1:] == ["49"])
    assert until(lambda: bus.counts.of("/t") == {"sent": 50, "received": 3, "dropped": 47}), bus.counts.of("/t")
    assert came == ["0", "48", "49"]


def test_what_leaves_is_bounded_too(bus: Bus, said: list[str]) -> None:
    publisher = bus.publisher("/t", TEXT)
    with pytest.raises(ValueError, match="/t carries std_msgs/msg/String, not std_msgs/msg/Header"):
        publisher.publish(make("std_msgs/msg/Header"))
    with pytest.raises(ValueError, match="std_msgs/msg/String cannot be written"):
        publisher.publish(text(5))
    assert not publisher.publish(text("x" * 2000))
    assert sum(publisher.publish(text("a")) for _ in range(1000)) < 1000
    counts = bus.counts.of("/t")
    assert counts["too_large"] == 1 and counts["too_fast"] + counts["sent"] == 1000 and len(said) == 2


def test_services_refuse_what_they_cannot_answer(bus: Bus) -> None:
    register_service(SET, SET_TEXT)

    def answer(request: Any) -> Any:
        if request.data:
            raise RuntimeError("broken")
        return make(f"{SET}_Response", success=True, message="x" * 2000)

    bus.serve("~/set", SET, answer)
    too_long = bus.call("~/set", SET, make(f"{SET}_Request"))
    assert not too_long.success and "ask for less" in too_long.message
    broken = bus.call("~/set", SET, make(f"{SET}_Request", data=True))
    assert not broken.success and broken.message == "RuntimeError: broken"
    where = key(0, "/farside/set", SET, type_hash(SET))
    big = list(bus._session.get(where, payload=b"\x00" * 101, attachment=attachment(9, 0, b"b" * 16)))
    assert b"larger than max_request_bytes (100)" in big[0].ok.payload.to_bytes()
    for payload, tag in (
        (b"\x00", attachment(1, 0, GID)),
        (None, attachment(2, 0, GID)),
        (b"\x00\x01\x00\x00\x00", None),
    ):
        replies = list(bus._session.get(where, payload=payload, attachment=tag, target=zenoh.QueryTarget.ALL_COMPLETE))
        assert len(replies) == 1 and (replies[0].ok is None) == (tag is None)
    assert bus.counts.of("/farside/set") == {"refused": 4, "failed": 1, "too_large": 1, "sent": 5}


def test_a_service_that_is_not_there_or_not_known(bus: Bus) -> None:
    register_service(SET, SET_TEXT)
    with pytest.raises(
        TimeoutError, match=r"^/nobody \(std_srvs/srv/SetBool\) did not answer in 0.3 s; is its node up"
    ):
        bus.call("/nobody", SET, make(f"{SET}_Request"), timeout_s=0.3)
    with pytest.raises(ValueError, match="the type 'std_srvs/srv/Unheard' is unknown"):
        bus.serve("/nobody", "std_srvs/srv/Unheard", lambda request: request)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"domain_id": 233}, "domain_id is 233; give 0 to 232"),
        ({"name": "a/b"}, "name is 'a/b'"),
        ({"namespace": "robot"}, "namespace is 'robot'"),
        ({"listen": ("udp/127.0.0.1:7",)}, "endpoint 'udp/127.0.0.1:7' is not"),
        ({"listen": ("tls/127.0.0.1:7",)}, "tls_ca is missing"),
        ({"allowed": ("robot",)}, "every endpoint must be tls"),
        ({"mode": "client"}, "mode client needs connect"),
        ({"max_rate": 0.0}, "greater than 0"),
    ],
)
def test_configuration_is_checked(changes: dict, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        BusConfig(**changes)


def test_configuration_is_read_from_yaml(tmp_path: Path) -> None:
    (tmp_path / "bus.yaml").write_text("domain_id: 3\nlisten: [tcp/127.0.0.1:7448]\nconnect: [tcp/127.0.0.1:7447]\n")
    config = load_config(tmp_path / "bus.yaml", BusConfig)
    assert config == BusConfig(3, listen=("tcp/127.0.0.1:7448",), connect=("tcp/127.0.0.1:7447",))


def test_closed_by_default() -> None:
    settings = BusConfig().settings()
    assert settings["listen"]["endpoints"] == ["tcp/127.0.0.1:0"] and settings["connect"]["endpoints"] == []
    assert not settings["scouting"]["multicast"]["enabled"]


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_nodes_meet_at_a_router(mode: str) -> None:
    """As on a ROS 2 machine: everybody knows only the router."""
    register_service(SET, SET_TEXT)
    here = f"tcp/127.0.0.1:{free_port()}"
    router = BusConfig(listen=(here,)).settings() | {"mode": "router"}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(router))):
        with Bus(BusConfig(connect=(here,))) as bus, Bus(BusConfig(name="b", connect=(here,), mode=mode)) as other:
            bus.serve("/set", SET, lambda request: make(f"{SET}_Response", success=True))
            bus.publisher("/latched", TEXT, latched=True).publish(text("last"))
            assert other.call("/set", SET, make(f"{SET}_Request"), 20.0).success
            came: list[str] = []
            other.subscribe("/latched", TEXT, lambda message: came.append(message.data), latched=True)
            assert until(lambda: came == ["last"])
            if mode == "client":  # a peer hears of another whenever the router's gossip has let them meet
                nodes = {bus.node.token(0, "NN"), other.node.token(0, "NN")}
                assert until(lambda: nodes <= set(other.graph())), nodes - set(other.graph())


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(
    ("hashed", "why"),
    [
        ("TypeHashNotSupported", "has no hash of std_msgs/msg/String, as nodes of ROS 2 Humble"),
        (
            "RIHS01_0123456789abcdef",
            "has another definition of std_msgs/msg/String (RIHS01_01234567, here",
        ),
        (type_hash(TEXT), ""),
    ],
)
def test_who_cannot_be_heard_is_named(said: list[str], hashed: str, why: str, first: bool) -> None:
    """A peer with another hash of our type would never be heard; whoever comes first, it is said once."""
    here = f"tcp/127.0.0.1:{free_port()}"
    with Bus(BusConfig(listen=(here,)), said.append) as bus, Bus(BusConfig(name="x", connect=(here,))) as other:
        driver = RosNode(0, str(other._session.zid()), "/robot", "driver")
        if not first:
            bus.subscribe("/words", TEXT, print)
        codes = ("MP", "MP", "MS")  # a subscriber's definition does not matter to a subscriber
        for number, code in enumerate(codes, 9):
            other._declare(driver.token(number, code, "/words", TEXT, hashed, "::,7:,:,:,,"))
        assert until(lambda: len(bus._others) == 3)
        if first:
            bus.subscribe("/words", TEXT, print)
        assert bus.counts.of("/words").get("other_type", 0) == (2 if why else 0)
        for token in [token for token in other._tokens if "/driver/" in token]:
            other._tokens.pop(token).undeclare()
        assert until(lambda: not bus._others)
    assert len(said) == bool(why) and all(f"/words: node /robot/driver {why}" in line for line in said)


def certificates(folder: Path, *names: str) -> None:
    """A certificate authority ca.pem, and NAME.pem with NAME.key that it signed, for 127.0.0.1."""

    def openssl(*arguments: str) -> None:
        subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)

    new_key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    openssl("req", "-x509", *new_key, "-keyout", "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=authority")
    (folder / "san.txt").write_text("subjectAltName=IP:127.0.0.1\n")
    for name in names:
        openssl("req", *new_key, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2", "-extfile", "san.txt")
        openssl("x509", "-req", "-in", f"{name}.csr", *signed, "-out", f"{name}.pem")


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to make certificates with")
def test_only_allowed_certificates_are_heard(tmp_path: Path) -> None:
    certificates(tmp_path, "farside", "planner", "stranger")
    port = free_port()

    def config(name: str, **changes) -> BusConfig:
        files = {"tls_ca": tmp_path / "ca.pem", "tls_key": tmp_path / f"{name}.key"}
        return BusConfig(name=name, tls_certificate=tmp_path / f"{name}.pem", **files, **changes)

    here = f"tls/127.0.0.1:{port}"
    came: list[str] = []
    register_service(SET, SET_TEXT)
    with Bus(config("farside", listen=(here,), allowed=("planner",))) as bus:
        bus.subscribe("/t", TEXT, lambda message: came.append(message.data))
        bus.serve("/set", SET, lambda request: make(f"{SET}_Response", success=True))
        latched = bus.publisher("/latched", TEXT, latched=True)
        latched.publish(text("last"))
        with Bus(config("planner", connect=(here,), listen=())) as planner:
            assert planner.call("/set", SET, make(f"{SET}_Request"), 20.0).success
            last: list[str] = []
            planner.subscribe("/latched", TEXT, lambda message: last.append(message.data), latched=True)
            assert until(lambda: last == ["last"])
            publisher = planner.publisher("/t", TEXT)
            assert until(lambda: publisher.wanted and publisher.publish(text("planner")) and "planner" in came)
        with Bus(config("stranger", connect=(here,), listen=())) as stranger:
            assert until(lambda: stranger._session.info.peers_zid())
            stranger.publisher("/t", TEXT).publish(text("stranger"))
            with pytest.raises(TimeoutError):
                stranger.call("/set", SET, make(f"{SET}_Request"), 0.5)
    assert set(came) == {"planner"}
    with pytest.raises(FileNotFoundError, match=r"absent\.pem: no such file"):
        Bus(config("absent", listen=(here,))).__enter__()
