"""What waits to be handled, fairly: each sender has a bounded queue of its own, and the senders take turns."""

import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from typing import Generic, TypeVar

SENDERS = 64  # that may wait at once

Item = TypeVar("Item")


class FairQueue(Generic[Item]):
    """Iterate over it for the items, one of each sender in turn, until it is closed.

    Each sender's newest `depth` items wait. All together have at most `max_bytes` (but one item always may wait), of at
    most SENDERS senders: beyond, the sender with the most bytes loses its oldest item, and a newcomer before who came
    first.
    """

    def __init__(self, depth: int, max_bytes: int) -> None:
        self._depth, self._max_bytes = depth, max_bytes
        self._waiting: OrderedDict[bytes, deque[tuple[Item, int]]] = OrderedDict()  # in the order of their turns
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, sender: bytes, item: Item, size: int) -> list[Item]:
        """Let an item of `size` bytes wait. Returns the items that are dropped for it, perhaps itself."""
        dropped: list[Item] = []
        with self._changed:
            if self._closed:
                return [item]
            self._waiting.setdefault(sender, deque()).append((item, size))
            self._bytes += size
            if len(self._waiting[sender]) > self._depth:
                dropped.append(self._oldest(sender))
            while len(self._waiting) > SENDERS or (self._bytes > self._max_bytes and self._several()):
                dropped.append(self._oldest(max(reversed(self._waiting), key=self._held)))
            self._changed.notify()
        return dropped

    def close(self) -> None:
        """End the iteration. What waits is forgotten."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Item]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                sender = next(iter(self._waiting))
                item = self._oldest(sender)
                if sender in self._waiting:
                    self._waiting.move_to_end(sender)
            yield item
            del item  # it may be large, and the next may not come for long

    def _oldest(self, sender: bytes) -> Item:
        queue = self._waiting[sender]
        item, size = queue.popleft()
        self._bytes -= size
        if not queue:
            del self._waiting[sender]
        return item

    def _held(self, sender: bytes) -> int:
        return sum(size for _, size in self._waiting[sender])

    def _several(self) -> bool:
        return len(self._waiting) > 1 or any(len(queue) > 1 for queue in self._waiting.values())
