"""The bus: topics and services of ROS 2 on Zenoh, in the format of `rmw_zenoh_cpp` (`rmw_zenoh.py`), without ROS.

Closed by default: it listens on this machine alone, does not search by multicast, and connects only to configured
endpoints. Incoming messages are bounded in size, and for each sender in rate and queue length (`fair_queue.py`), so
that one that floods a topic or service keeps no other out. Faulty messages are counted, reported once, and skipped.
"""

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import product
from types import TracebackType
from typing import Any, Self

import zenoh
import zenoh.ext

from foundation.one_line import one_line
from node.ros.incoming import Incoming, read_tag
from node.ros.message_counts import MessageCounts, Rate
from node.ros.messages import decode, encode, make, type_hash
from node.ros.rmw_zenoh import Entity, RosNode, attachment, entity, gid, key, quality, why_apart
from node.ros.settings import BusConfig

_HEARTBEAT_S = 0.5  # lets a late subscriber notice that it missed a latched sample; as in rmw_zenoh_cpp
_OTHERS = 4096  # entities of other nodes that are compared with our own


@dataclass
class Publisher:
    """A topic to publish on."""

    name: str  # full
    kind: str
    latched: bool
    _publisher: Any
    _source: bytes
    _counts: MessageCounts
    _rate: Rate
    _max_bytes: int
    close: Callable[[], None]  # once: what is latched is no longer there for late subscribers
    _sequence: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def wanted(self) -> bool:
        """Whether there is a subscriber, or the topic is latched for late ones."""
        return self.latched or bool(self._publisher.matching_status.matching)

    def publish(self, message: Any) -> bool:
        """Send a message to the present subscribers, without waiting for them. False if it was not sent (`counts`).

        Raises ValueError if the message is of another type, or a field does not fit it.
        """
        if message.__msgtype__ != self.kind:
            raise ValueError(f"{self.name} carries {self.kind}, not {message.__msgtype__}")
        if not self._rate.allows():
            self._counts.add(self.name, "too_fast", "messages are published faster than max_rate; some are left out")
            return False
        data = encode(message)
        if len(data) > self._max_bytes:
            trouble = (
                f"a message of {len(data)} bytes is larger than max_message_bytes ({self._max_bytes}); it is left out"
            )
            self._counts.add(self.name, "too_large", trouble)
            return False
        with self._lock:  # numbers leave in order
            self._sequence += 1
            try:
                self._publisher.put(data, attachment=attachment(self._sequence, time.time_ns(), self._source))
            except zenoh.ZError as error:
                self._counts.add(self.name, "failed", one_line(error))
                return False
        self._counts.add(self.name, "sent")
        return True


class Bus:
    """A node on the bus: `with Bus(config) as bus: ...`. Names are ROS names: ~/own, relative, or /absolute.

    Raises OSError if an endpoint cannot be used, FileNotFoundError for a certificate that is not there.
    """

    def __init__(self, config: BusConfig | None = None, say: Callable[[str], None] | None = None) -> None:
        self.config = config or BusConfig()
        self.counts = MessageCounts(say or (lambda line: print(f"farside: {line}", file=sys.stderr)))
        self._entities = 0
        self._tokens: dict[str, Any] = {}  # our own, which a router does not report to us
        self._publishers: dict[str, Any] = {}  # by token
        self._meeting = threading.Lock()  # of who is there; held for moments, as zenoh's own threads take it
        self._others: dict[str, Entity] = {}  # of other nodes, by token
        self._clients: dict[tuple[str, str], bytes] = {}
        self._called = Counter[tuple[str, str]]()  # a client's requests are numbered
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        c = self.config
        with ExitStack() as stack:
            self._session = stack.enter_context(_open(c))
            self.node = RosNode(c.domain_id, str(self._session.zid()), c.namespace, c.name)
            where, met = f"@ros2_lv/{c.domain_id}/**", zenoh.handlers.Callback(self._meet, indirect=False)
            try:
                self._declare(self.node.token(0, "NN"))
                others = self._session.liveliness().declare_subscriber(where, met, history=True)
            except zenoh.ZError as error:  # the router is gone again
                raise OSError(f"the bus cannot open ({one_line(error)}); start the node again") from None
            stack.callback(others.undeclare)
            self._stack = stack.pop_all()  # after all that may fail: a failed start leaves no session open
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()  # ends the threads, too

    def publisher(self, name: str, kind: str, *, latched: bool = False, depth: int = 1) -> Publisher:
        """A topic to publish on. `latched` (TRANSIENT_LOCAL): late subscribers get the last `depth` messages."""
        name, where, token = self._entity("MP", name, kind, quality(depth, latched))
        drop = zenoh.CongestionControl.DROP  # rather than wait for a slow subscriber
        if latched:
            publisher: Any = zenoh.ext.declare_advanced_publisher(
                self._session,
                where,
                congestion_control=drop,
                cache=zenoh.ext.CacheConfig(depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
                publisher_detection=True,
            )
        else:
            publisher = self._session.declare_publisher(where, congestion_control=drop)

        self._publishers[token] = publisher  # or zenoh ends it

        def close() -> None:
            self._publishers.pop(token).undeclare()
            self._tokens.pop(token).undeclare()

        c, source = self.config, gid(token)
        rate = Rate(c.max_rate)
        return Publisher(name, kind, latched, publisher, source, self.counts, rate, c.max_message_bytes, close)

    def subscribe(
        self, name: str, kind: str, handler: Callable[[Any], object], *, latched: bool = False, depth: int = 5
    ) -> str:
        """Call `handler` with each message, in a thread of this subscription's own. Returns the full name.

        While it works, the newest `depth` messages of each sender wait and older ones are dropped. `latched`: the last
        messages sent before come first.
        """
        name, where, _ = self._entity("MS", name, kind, quality(depth, latched))

        def take(sample: Any, _: tuple[int, bytes]) -> None:
            handler(decode(sample.payload.to_bytes(), kind, self.config.max_parts))

        arrived = self._handle(name, depth, take)
        if latched:
            subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                self._session,
                where,
                arrived,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            subscriber = self._session.declare_subscriber(where, arrived)
        self._stack.callback(subscriber.undeclare)
        return name

    def serve(self, name: str, kind: str, handler: Callable[[Any], Any], *, depth: int = 10) -> str:
        """Answer a service's requests with `handler`, one at a time in a thread of its own. Returns the full name.

        The newest `depth` requests of each client wait; the clients take turns.
        An error in `handler` becomes a response with success = false, and the error's line as message, as far as the
        type has these.
        """
        name, where, _ = self._entity("SS", name, kind, quality(depth))
        own = vars(make(f"{kind}_Response"))

        def answer(query: Any, tag: tuple[int, bytes], response: Any) -> None:
            data = encode(response)
            if len(data) > self.config.max_message_bytes:
                raise ValueError(f"the answer has {len(data)} bytes, more than max_message_bytes allows; ask for less")
            query.reply(where, data, attachment=attachment(tag[0], time.time_ns(), tag[1]))
            self.counts.add(name, "sent")

        def take(query: Any, tag: tuple[int, bytes]) -> None:
            data = query.payload.to_bytes() if query.payload is not None else b""
            answer(query, tag, handler(decode(data, f"{kind}_Request", self.config.max_parts)))

        def refuse(query: Any, trouble: str) -> None:
            told = {name: value for name, value in (("success", False), ("message", trouble)) if name in own}
            try:
                if "success" not in told:
                    raise ValueError
                answer(query, read_tag(query), make(f"{kind}_Response", **told))
            except ValueError:  # its response cannot say so, or the query has no sender
                query.reply_err(trouble.encode())

        arrived = self._handle(name, depth, take, refuse)
        self._stack.callback(self._session.declare_queryable(where, arrived, complete=True).undeclare)
        return name

    def call(self, name: str, kind: str, request: Any, timeout_s: float = 5.0) -> Any:
        """Call a service and wait for its response. The request is repeated until the service exists.

        Raises TimeoutError if there is no answer in time, OSError if the service refuses.
        """
        name = self.node.resolve(name)
        with self._lock:
            if (name, kind) not in self._clients:
                self._clients[name, kind] = gid(self._entity("SC", name, kind, quality(10))[2])
            source = self._clients[name, kind]
            sequence = self._called[name, kind] = self._called[name, kind] + 1
        where = key(self.config.domain_id, name, kind, type_hash(kind))
        data, deadline = encode(request), time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            replies: Any = self._session.get(
                where,
                zenoh.handlers.FifoChannel(4),
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                payload=data,
                attachment=attachment(sequence, time.time_ns(), source),
                timeout=left,
            )
            for reply in replies:
                if reply.ok is not None:
                    return decode(reply.ok.payload.to_bytes(), f"{kind}_Response", self.config.max_parts)
                if (refusal := reply.err.payload.to_string()) != "Timeout":
                    raise OSError(f"{name} refused: {refusal}")
            time.sleep(min(0.05, max(0.0, left)))
        raise TimeoutError(
            f"{name} ({kind}) did not answer in {timeout_s:g} s; is its node up, on this domain and router?"
        )

    def graph(self, timeout_s: float = 1.0) -> list[str]:
        """The liveliness tokens of all nodes on this domain and of what they publish, take and serve."""
        replies: Any = self._session.liveliness().get(f"@ros2_lv/{self.config.domain_id}/**", timeout=timeout_s)
        return sorted({*self._tokens, *(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)})

    def _declare(self, token: str) -> None:
        self._tokens[token] = self._session.liveliness().declare_token(token)
        with self._meeting:
            others = list(self._others.values())
        self._compare([entity(token)], others)

    def _meet(self, sample: Any) -> None:
        """An entity of another node has come, or is gone."""
        token = str(sample.key_expr)
        other = entity(token)
        if other is None or other.zid == self.node.zid:
            return
        with self._meeting:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._others.pop(token, None)
                return
            if len(self._others) >= _OTHERS:
                return
            self._others[token] = other
            mine = [entity(token) for token in tuple(self._tokens)]
        self._compare(mine, [other])

    def _compare(self, mine: Sequence[Entity | None], others: Sequence[Entity]) -> None:
        """Say which others never hear ours, for their type has another hash."""
        for own, other in product(mine, others):
            if own is not None and (why := why_apart(own, other)):
                self.counts.add(own.topic, "other_type", why)

    def _entity(self, code: str, name: str, kind: str, qos: str) -> tuple[str, str, str]:
        """Announce a publisher, subscriber, service or client: its full name, key and token."""
        name, hashed = self.node.resolve(name), type_hash(kind)
        self._entities += 1
        token = self.node.token(self._entities, code, name, kind, hashed, qos)
        self._declare(token)
        return name, key(self.config.domain_id, name, kind, hashed), token

    def _handle(self, name: str, depth: int, take: Callable, refuse: Callable | None = None) -> zenoh.handlers.Callback:
        """Where zenoh puts what comes: a thread handles it until the bus ends; `refuse` answers a faulty query."""
        incoming = Incoming(name, depth, self.config, self.counts, take, refuse)
        self._stack.callback(incoming.close)
        return zenoh.handlers.Callback(incoming.arrive, indirect=False)


def _open(config: BusConfig) -> zenoh.Session:
    """Raises OSError naming the endpoint that cannot be used."""
    settings = json.dumps(config.settings())
    try:
        return zenoh.open(zenoh.Config.from_json5(settings))
    except zenoh.ZError as error:
        text = str(error)
        for endpoint in (*config.listen, *config.connect):
            if "Address already in use" in text and endpoint in text:
                raise OSError(
                    f"the bus cannot listen on {endpoint}: another program does; end it, or set another port in listen"
                ) from None
        reason = text.split(" at /")[0].strip()
        listen, connect = ", ".join(config.listen) or "nothing", ", ".join(config.connect) or "nothing"
        raise OSError(f"the bus cannot open (listen {listen}; connect {connect}): {' '.join(reason.split())}") from None
