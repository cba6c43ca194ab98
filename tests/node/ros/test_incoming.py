"""One peer that makes up senders costs a bounded rate, and does not push out those who were there before."""

import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from node.ros.incoming import Incoming, Tag
from node.ros.message_counts import MessageCounts
from node.ros.rmw_zenoh import attachment
from node.ros.settings import BusConfig


def sample(sender: bytes, sequence: int = 1) -> Any:
    """What zenoh gives, as far as it is looked at."""
    data = attachment(sequence, 0, sender.rjust(16, b"0"))
    return SimpleNamespace(attachment=SimpleNamespace(to_bytes=lambda: data), payload=b"words")


class Taken:
    """Takes what comes on a topic, and counts."""

    def __init__(self, max_rate: float, depth: int = 10) -> None:
        self.said: list[str] = []
        self.counts = MessageCounts(self.said.append)
        self.senders: list[bytes] = []
        self.lock = threading.Lock()
        self.incoming = Incoming("/t", depth, BusConfig(max_rate=max_rate), self.counts, self.take)

    def take(self, item: Any, tag: Tag) -> None:
        with self.lock:
            self.senders.append(tag[1])

    def wait(self, count: int) -> None:
        deadline = time.monotonic() + 20.0
        while len(self.senders) < count and time.monotonic() < deadline:
            time.sleep(0.005)


@pytest.fixture
def taken() -> Any:
    made: list[Taken] = []

    def make(max_rate: float, depth: int = 10) -> Taken:
        made.append(Taken(max_rate, depth))
        return made[-1]

    yield make
    for each in made:
        each.incoming.close()


def test_made_up_names_are_turned_away_and_said_once(taken: Any) -> None:
    t = taken(1000.0)
    t.incoming.arrive(sample(b"planner"))
    for n in range(2000):
        t.incoming.arrive(sample(b"%d" % n))
    assert t.counts.of("/t")["too_fast"] > 1500
    t.incoming.arrive(sample(b"planner", 2))  # who was there before is known still
    t.wait(2)
    deadline = time.monotonic() + 20.0
    while t.senders.count(b"planner".rjust(16, b"0")) < 2 and time.monotonic() < deadline:
        time.sleep(0.005)
    assert t.senders.count(b"planner".rjust(16, b"0")) == 2
    assert sum("are new; does one make up names" in line for line in t.said) == 1


def test_all_senders_together_have_a_rate(taken: Any) -> None:
    """Each of many within its own rate: of all together no more than 8 times that, after a first burst of as many."""
    t = taken(10.0)
    started = time.monotonic()
    for n in range(60):
        for sequence in (1, 2):
            t.incoming.arrive(sample(b"%d" % n, sequence))
    t.wait(120)
    assert len(t.senders) == 120  # late, and none is lost
    assert time.monotonic() - started > 0.9 * (120 - 80) / 80


def test_the_latest_senders_are_remembered(taken: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("node.ros.incoming._SENDERS", 4)
    t = taken(1000.0)
    for n in range(20):
        t.incoming.arrive(sample(b"steady", n + 1))
        t.incoming.arrive(sample(b"%d" % n))
    known = set(t.incoming._known)
    assert len(known) == 4 and b"steady".rjust(16, b"0") in known
