"""Two processes over loopback: messages arrive whole, late joiners get the last, and a stuck one slows nobody."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest

from node.ros.bus import Bus
from node.ros.messages import HYPOTHESES, encode, header, hypotheses_from, hypotheses_message, make, register_service
from node.ros.settings import BusConfig
from tests.conftest import ROOT
from tests.node.peer import ADD, ADD_TEXT, IMAGE, SET, SET_TEXT
from tests.node.shapes import body_with_handle, free_port

WAIT_S = 30.0


def image(side: int = 64) -> Any:
    data = np.random.default_rng(side).integers(0, 256, 3 * side * side, dtype=np.uint8)
    return make(IMAGE, header=header(5, "cam"), height=side, width=side, encoding="rgb8", step=3 * side, data=data)


@pytest.fixture(scope="module")
def bus() -> Iterator[Bus]:
    """A bus that another process is connected to."""
    register_service(ADD, ADD_TEXT)
    register_service(SET, SET_TEXT)
    port = free_port()
    with Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",))) as bus:
        command = [sys.executable, "-m", "tests.node.peer", str(port)]
        with subprocess.Popen(command, cwd=ROOT, stdin=PIPE, stdout=PIPE, text=True) as peer:
            try:
                assert peer.stdout.readline() == "ready\n"
                yield bus
                peer.stdin.close()
                assert peer.wait(WAIT_S) == 0
            finally:
                peer.kill()


def test_a_message_comes_back_byte_for_byte(bus: Bus) -> None:
    sent, came, event = image(600), [], threading.Event()  # 1 MB: in many fragments

    def take(message: Any) -> None:
        came.append(message)
        event.set()

    bus.subscribe("/peer/echo", IMAGE, take)
    publisher = bus.publisher("/image", IMAGE)
    deadline = time.monotonic() + WAIT_S
    while not event.wait(0.2) and time.monotonic() < deadline:  # until both know of each other
        publisher.publish(sent)
    assert encode(came[0]) == encode(sent)


def test_a_late_joiner_gets_the_last_hypotheses(bus: Bus) -> None:
    came, event = [], threading.Event()

    def take(message: Any) -> None:
        came.append(message)
        event.set()

    bus.subscribe("/peer/hypotheses", HYPOTHESES, take, latched=True)
    assert event.wait(WAIT_S)
    expected = body_with_handle(stage=3)
    assert encode(came[-1]) == encode(hypotheses_message(expected))
    np.testing.assert_array_equal(hypotheses_from(came[-1]).opacity, expected.opacity)


def test_a_service_answers_and_refuses(bus: Bus) -> None:
    assert bus.call("/add", ADD, make(f"{ADD}_Request", a=2**40, b=-3), WAIT_S).sum == 2**40 - 3
    response = bus.call("/refuse", SET, make(f"{SET}_Request"), WAIT_S)
    assert not response.success and response.message == "there are no hypotheses yet; ask again later"


def test_the_graph_shows_both_nodes(bus: Bus) -> None:
    tokens = [token.split("/") for token in bus.graph()]
    assert {t[8] for t in tokens if t[5] == "NN"} == {"farside", "peer"}
    mine = {(t[5], t[9]) for t in tokens if t[8] == "peer" and t[5] != "NN"}
    assert mine >= {("MP", "%peer%hypotheses"), ("MS", "%image"), ("SS", "%add")}


def test_a_stuck_subscriber_stops_nobody(bus: Bus) -> None:
    publisher, message = bus.publisher("/stuck", IMAGE), image(600)
    deadline = time.monotonic() + WAIT_S
    while not publisher.wanted and time.monotonic() < deadline:
        time.sleep(0.05)
    assert publisher.wanted
    begun = time.monotonic()
    for _ in range(100):  # far more than sockets and queues hold
        assert publisher.publish(message)
    assert time.monotonic() - begun < 4.0  # 0.2 s or so; waiting for the stuck one takes 5 s, until it is cut off
    assert bus.call("/add", ADD, make(f"{ADD}_Request", a=1, b=1), WAIT_S).sum == 2
