"""One that floods the bus keeps nobody else out, and costs bounded memory."""

import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest
import zenoh

from node.ros.bus import Bus
from node.ros.fair_queue import SENDERS, FairQueue
from node.ros.messages import encode, make, register_service, type_hash
from node.ros.rmw_zenoh import attachment, key
from node.ros.settings import BusConfig
from tests.conftest import ROOT
from tests.node.peer import IMAGE, SET, SET_TEXT
from tests.node.shapes import free_port

WAIT_S = 20.0
TEXT = "std_msgs/msg/String"
# A stranger that sends as fast as it can: `python -c FLOOD PORT`.
FLOOD = f"""
import itertools, json, sys, zenoh
from node.ros.messages import encode, make, register_service, type_hash
from node.ros.rmw_zenoh import attachment, key
from node.ros.settings import BusConfig
from tests.node.peer import SET, SET_TEXT
register_service(SET, SET_TEXT)
config = BusConfig(connect=("tcp/127.0.0.1:" + sys.argv[1],)).settings()
service, topic = key(0, "/set", SET, type_hash(SET)), key(0, "/words", "{TEXT}", type_hash("{TEXT}"))
request, words = bytes(encode(make(SET + "_Request"))), bytes(encode(make("{TEXT}", data="flood")))
with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
    print("ready", flush=True)
    for sequence in itertools.count(1):
        tag = attachment(sequence, 0, b"f" * 16)
        session.get(service, zenoh.handlers.RingChannel(1), payload=request, attachment=tag, timeout=1.0)
        session.put(topic, words, attachment=tag)
"""


@contextmanager
def flood(port: int) -> Iterator[None]:
    command = [sys.executable, "-c", FLOOD, str(port)]
    with subprocess.Popen(command, cwd=ROOT, stdout=PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            yield
        finally:
            process.kill()


def test_one_client_floods_and_another_is_answered() -> None:
    """Every call, and every message at a fair pace; the flood is limited, counted and said in a line."""
    register_service(SET, SET_TEXT)
    port, said, came = free_port(), list[str](), Counter[str]()

    def answer(request: Any) -> Any:
        time.sleep(0.02)  # as a question about a scene takes
        return make(f"{SET}_Response", success=True)

    with (
        Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",)), said.append) as bus,
        Bus(BusConfig(name="planner", connect=(f"tcp/127.0.0.1:{port}",))) as planner,
    ):
        bus.serve("/set", SET, answer)
        bus.subscribe("/words", TEXT, lambda message: came.update([message.data]))
        publisher = planner.publisher("/words", TEXT)
        assert planner.call("/set", SET, make(f"{SET}_Request"), WAIT_S).success
        with flood(port):
            deadline = time.monotonic() + WAIT_S
            while not bus.counts.of("/set").get("dropped") and time.monotonic() < deadline:
                time.sleep(0.02)
            for number in range(20):
                assert planner.call("/set", SET, make(f"{SET}_Request"), 3.0).success
                publisher.publish(make(TEXT, data=str(number)))
            deadline = time.monotonic() + WAIT_S
            while sum(came[str(n)] for n in range(20)) < 20 and time.monotonic() < deadline:
                time.sleep(0.02)
        counts = bus.counts.all()
    assert all(came[str(number)] == 1 for number in range(20))
    assert counts["/set"]["dropped"] > 0
    assert counts["/words"].get("too_fast", 0) + counts["/words"].get("dropped", 0) > 0
    assert any("/set: requests of one client come faster than they are answered" in line for line in said)


@pytest.mark.parametrize("size", [64_000_001, 200_000_000])
def test_a_large_image_passes_and_one_beyond_the_limit_is_refused_unread(size: int) -> None:
    """Colour of 3840 x 2160 pixels has 25 MB; the limit is 64 MB. The line names the topic, the size and the limit."""
    port, said, came = free_port(), list[str](), list[Any]()
    pixels = np.zeros((2160, 3840, 3), np.uint8)
    image = make(IMAGE, height=2160, width=3840, encoding="rgb8", step=3 * 3840, data=pixels.ravel())
    with (
        Bus(BusConfig(listen=(f"tcp/127.0.0.1:{port}",)), said.append) as bus,
        Bus(BusConfig(name="camera", connect=(f"tcp/127.0.0.1:{port}",))) as camera,
    ):
        bus.subscribe("/image", IMAGE, came.append)
        where = key(0, "/image", IMAGE, type_hash(IMAGE))
        block, deadline = zenoh.CongestionControl.BLOCK, time.monotonic() + WAIT_S

        def send(data: bytes) -> None:
            camera._session.put(where, data, attachment=attachment(1, 0, b"x" * 16), congestion_control=block)

        while not came and time.monotonic() < deadline:  # until both know of each other
            send(bytes(encode(image)))
            time.sleep(0.2)
        assert came[0].data.size == pixels.size
        send(bytes(size))
        while not bus.counts.of("/image").get("too_large") and time.monotonic() < deadline:
            time.sleep(0.05)
    (line,) = (line for line in said if "larger" in line)
    assert line.startswith(f"/image: a message of {size} bytes is larger than max_message_bytes (64000000)")


def test_the_senders_take_turns() -> None:
    queue: FairQueue[str] = FairQueue(3, 10**6)
    dropped = [item for n in range(10) for item in queue.put(b"a", f"a{n}", 1)]
    assert dropped == [f"a{n}" for n in range(7)]
    assert queue.put(b"b", "b0", 1) == queue.put(b"c", "c0", 1) == queue.put(b"c", "c1", 1) == []
    items = iter(queue)
    assert [next(items) for _ in range(6)] == ["a7", "b0", "c0", "a8", "c1", "a9"]
    threading.Timer(0.05, queue.close).start()
    assert list(items) == [] and queue.put(b"a", "late", 1) == ["late"]


@pytest.mark.parametrize("seed", range(20))
def test_what_waits_is_bounded(seed: int) -> None:
    """Whatever comes: what is put is taken once or dropped once, and what waits stays within each of the limits."""
    rng = random.Random(seed)
    queue: FairQueue[int] = FairQueue(4, 1000)
    items, waiting, sizes = iter(queue), dict[int, bytes](), dict[int, int]()
    for number in range(2000):
        sender, size = b"%d" % rng.choice([0, 0, rng.randrange(200)]), rng.choice([1, 10, 900, 2000])
        waiting[number], sizes[number] = sender, size
        for gone in queue.put(sender, number, size):
            del waiting[gone]
        per_sender = Counter(waiting.values())
        assert max(per_sender.values(), default=0) <= 4 and len(per_sender) <= SENDERS
        assert len(waiting) == 1 or sum(sizes[n] for n in waiting) <= 1000
        if waiting and rng.random() < 0.2:
            del waiting[next(items)]


def test_a_crowd_of_names_does_not_push_out_who_waits() -> None:
    """A name is easily made up: of many newcomers the last ones are dropped."""
    queue: FairQueue[bytes] = FairQueue(2, 10**6)
    assert queue.put(b"planner", b"planner", 10) == []
    dropped = [item for n in range(1000) for item in queue.put(b"%d" % n, b"%d" % n, 10)]
    assert len(dropped) == 1001 - SENDERS and next(iter(queue)) == b"planner"


def test_a_flood_of_faulty_requests_is_answered_with_what_is_wrong() -> None:
    register_service(SET, SET_TEXT)
    with Bus(BusConfig(max_rate=5.0), list[str]().append) as bus:
        bus.serve("/set", SET, lambda request: make(f"{SET}_Response", success=True))
        where, tag = key(0, "/set", SET, type_hash(SET)), attachment(1, 0, b"a" * 16)
        asked: dict[str, Any] = {
            "payload": bytes(encode(make(f"{SET}_Request"))),
            "target": zenoh.QueryTarget.ALL_COMPLETE,
        }

        def answer(tag: bytes) -> bytes:
            (reply,) = bus._session.get(where, **asked, attachment=tag)
            assert reply.ok is not None
            return reply.ok.payload.to_bytes()

        assert b"messages of one sender come faster than max_rate (5 Hz)" in [answer(tag) for _ in range(8)][-1]
        assert b"faster" not in answer(attachment(1, 0, b"b" * 16))
