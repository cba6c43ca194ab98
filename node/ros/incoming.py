"""What comes on one topic or service: judged, counted and handled in a thread of its own, the senders in turn."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from foundation.one_line import one_line
from node.ros.fair_queue import FairQueue
from node.ros.message_counts import MessageCounts, Rate, plainly
from node.ros.rmw_zenoh import read_attachment
from node.ros.settings import BusConfig

_SENDERS = 256  # whose rates and sequence numbers are remembered, the latest
_NEWCOMERS = 64.0  # senders that may come anew in a second: names are easily made up
_TOGETHER = 8.0  # times the rate of one sender: that of all

Tag = tuple[int, bytes]  # a sample's number and its sender's gid


class Incoming:
    """Give its `arrive` to zenoh. `take` handles an item; `refuse`, of a service, answers a faulty query."""

    def __init__(
        self,
        name: str,
        depth: int,
        config: BusConfig,
        counts: MessageCounts,
        take: Callable[[Any, Tag], object],
        refuse: Callable[[Any, str], object] | None = None,
    ) -> None:
        self._name, self._depth, self._config, self._counts = name, depth, config, counts
        self._take, self._refuse = take, refuse
        self._setting = "max_request_bytes" if refuse else "max_message_bytes"
        self._limit: int = getattr(config, self._setting)
        self._known: OrderedDict[bytes, _Sender] = OrderedDict()  # the latest last
        self._lock = threading.Lock()
        self._newcomers, self._together = Rate(_NEWCOMERS), Rate(_TOGETHER * config.max_rate)
        self._waiting: FairQueue[Any] = FairQueue(depth, depth * self._limit)
        self._thread = threading.Thread(target=self._loop, name=f"bus {name}", daemon=True)
        self._thread.start()

    def arrive(self, item: Any) -> None:
        """In zenoh's own thread: the sender's, which waits for it, so that a flood stays where it comes from."""
        sequence, sender = _tag_or_none(item)
        with self._lock:
            lost = self._lost(sender, sequence)
        if lost is None:  # outside the lock: what is said may wait for a slow terminal
            return self._turn_away(item)
        dropped = self._waiting.put(sender, item, _size(item))
        if self._refuse:
            for query in dropped:
                query.drop()  # its asker hears that there is no answer
        if lost + len(dropped):
            flood = f"requests of one client come faster than they are answered; its newest {self._depth} wait"
            self._counts.add(self._name, "dropped", flood if self._refuse and dropped else "", lost + len(dropped))

    def _lost(self, sender: bytes, sequence: int) -> int | None:
        """How many messages of the sender were lost before this one; None for a newcomer in a crowd of them.

        The first ones of a topic are no crowd: at a start all are new, and a latched message comes once. The caller
        holds the lock.
        """
        if sender not in self._known:
            if len(self._known) >= _NEWCOMERS and not self._newcomers.allows():
                return None
            if len(self._known) >= _SENDERS:
                self._known.popitem(last=False)
            self._known[sender] = _Sender(Rate(self._config.max_rate))
        self._known.move_to_end(sender)
        return self._known[sender].lost(sequence)

    def _turn_away(self, item: Any) -> None:
        if self._refuse:
            item.drop()
        crowd = f"more than {_NEWCOMERS:g} senders a second are new; does one make up names?"
        self._counts.add(self._name, "too_fast", crowd)

    def close(self) -> None:
        """End the thread, when it has handled what it has in hand; call it from any thread."""
        self._waiting.close()
        if self._thread is not threading.current_thread():
            self._thread.join(5.0)

    def _loop(self) -> None:
        for item in self._waiting:
            fate, trouble = self._judge(item)
            self._counts.add(self._name, fate, trouble)
            if self._refuse:
                try:
                    if trouble:
                        self._refuse(item, plainly(trouble))
                    item.drop()  # now, not when it is collected: the asker waits for the end of answers
                except Exception as error:  # the client is gone
                    self._counts.add(self._name, "failed", one_line(error))
            del item  # a large one is not kept until the next comes

    def _judge(self, item: Any) -> tuple[str, str]:
        """The fate of one item, and what was wrong with it."""
        try:
            tag = read_tag(item)
            if (size := _size(item)) > self._limit:
                return "too_large", f"a message of {size} bytes is larger than {self._setting} ({self._limit})"
            with self._lock:
                sender = self._known.get(tag[1])
            if sender is not None and not sender.rate.allows():
                return "too_fast", f"messages of one sender come faster than max_rate ({self._config.max_rate:g} Hz)"
            while not self._together.allows():  # the senders still take turns: what waits too long is dropped
                time.sleep(1.0 / (_TOGETHER * self._config.max_rate))
            self._take(item, tag)
        except ValueError as error:
            return "refused" if self._refuse else "malformed", one_line(error)
        except Exception as error:  # an error in a handler must not end the service
            return "failed", f"{type(error).__name__}: {one_line(error)}"
        return "received", ""


@dataclass
class _Sender:
    """How fast a sender's messages are handled, and the highest number that came of it."""

    rate: Rate
    last: int | None = None

    def lost(self, sequence: int) -> int:
        """How many numbers are left out before this one."""
        before = sequence if self.last is None else self.last
        self.last = max(sequence, before)
        return max(0, sequence - before - 1)


def read_tag(item: Any) -> Tag:
    """Number and sender of a sample or query. Raises ValueError if it carries none."""
    if item.attachment is None:
        raise ValueError("a message has no attachment; its sender does not speak as rmw_zenoh_cpp does")
    sequence, _, sender = read_attachment(item.attachment.to_bytes())
    return sequence, sender


def _tag_or_none(item: Any) -> Tag:
    """The same; number 0 and no name for all that carry none."""
    try:
        return read_tag(item)
    except ValueError:
        return 0, b""


def _size(item: Any) -> int:
    return len(item.payload) if item.payload is not None else 0
