"""CDR bytes read with a bound on the parts of a message: the messages within it, which are built one by one in Python.

A million of them, however short, take a minute and gigabytes. Arrays of numbers are not built so, and bounded by the
bytes that came.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore


class CountingStore(Typestore):
    """The types of another store, for one call of `deserialize_cdr`: SerdeError beyond `most` parts."""

    def __init__(self, types: Typestore, most: int) -> None:
        self._types, self._most, self._count = types, most, 0
        self.max_sequence_length = types.max_sequence_length

    def get_msgdef(self, typename: str) -> Any:
        """How rosbags reads a type, which asks for the types within it in turn."""
        return _counted(self._types, typename)

    def count(self) -> None:
        """One part more."""
        self._count += 1
        if self._count > self._most:
            raise SerdeError(f"it has more than {self._most} parts (max_parts)")


@cache
def _counted(types: Typestore, kind: str) -> Any:
    def counted(read: Callable) -> Callable:
        def one(data: memoryview, pos: int, cls: type, store: CountingStore) -> Any:
            store.count()
            return read(data, pos, cls, store)

        return one

    found = types.get_msgdef(kind)
    le, be = counted(found.deserialize_cdr_le), counted(found.deserialize_cdr_be)
    return replace(found, deserialize_cdr_le=le, deserialize_cdr_be=be)
