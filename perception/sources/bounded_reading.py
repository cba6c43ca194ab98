"""Messages read with a bound on their parts: the messages within them, which are built one by one in Python.

A million of them, however short, take a minute and gigabytes. Arrays of numbers are not built so, and bounded by the
bytes that came; arrays of texts are built one by one, too, and bounded by the bytes alone (8 MB of them take 3 s). A
recording brings its own definitions, by which any message may have parts.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

MOST_PARTS = 100_000


class CountingStore(Typestore):
    """The types of another store, to deserialise one message: SerdeError beyond `most` parts. `named` stands behind
    the number in the error's line.
    """

    def __init__(self, types: Typestore, most: int = MOST_PARTS, named: str = "parts") -> None:
        self._types, self._most, self._named, self._count = types, most, named, 0
        self.max_sequence_length = types.max_sequence_length

    def get_msgdef(self, typename: str) -> Any:
        """How rosbags reads a type, which asks for the types within it in turn."""
        return _counted(self._types, typename)

    def count(self) -> None:
        """One part more."""
        self._count += 1
        if self._count > self._most:
            raise SerdeError(f"it has more than {self._most} {self._named}")


@lru_cache(512)  # not for ever: each recording has a store of its own
def _counted(types: Typestore, kind: str) -> Any:
    def counted(read: Callable) -> Callable:
        def one(data: memoryview, pos: int, cls: type, store: CountingStore) -> Any:
            store.count()
            return read(data, pos, cls, store)

        return one

    found = types.get_msgdef(kind)
    return replace(
        found,
        deserialize_cdr_le=counted(found.deserialize_cdr_le),
        deserialize_cdr_be=counted(found.deserialize_cdr_be),
        deserialize_ros1=counted(found.deserialize_ros1),
    )
