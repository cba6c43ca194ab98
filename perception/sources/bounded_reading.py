"""Messages read with a bound on their parts: the messages and texts within them, which are built one by one in Python.

A million of them, however short, take a minute and gigabytes. Arrays of numbers are not built so, and bounded by the
bytes that came. A recording brings its own definitions, by which any message may have parts.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

MOST_PARTS = 100_000
_LONGEST_ARRAY = 10_000  # of parts, in a definition: rosbags writes a line of code for each


class CountingStore(Typestore):
    """The types of another store, to deserialise one message: SerdeError beyond `most` parts. `named` stands behind
    the number in the error's line.
    """

    def __init__(self, types: Typestore, most: int = MOST_PARTS, named: str = "parts") -> None:
        self._types, self._most, self._named, self._count = types, most, named, 0
        self.sequences: list[Iterator[bool]] = []  # of the messages being read: whether each one is of parts
        self.of_parts = False  # whether the latest one is

    def get_msgdef(self, typename: str) -> Any:
        """How rosbags reads a type, which asks for the types within it in turn."""
        return _counted(self._types, typename)

    @property
    def max_sequence_length(self) -> int:  # type: ignore[override]
        """Of the next sequence: rosbags looks at this once for each, before it is built."""
        self.of_parts = next(self.sequences[-1])
        return self.left if self.of_parts else self._types.max_sequence_length

    @property
    def left(self) -> int:
        """How many parts more there may be."""
        return self._most - self._count

    def count(self, parts: int = 1) -> None:
        """So many parts more."""
        self._count += parts
        if self._count > self._most:
            raise SerdeError(f"it has more than {self._most} {self._named}")


@lru_cache(512)  # not for ever: each recording has a store of its own
def _counted(types: Typestore, kind: str) -> Any:
    _check_arrays(types, kind)
    found = types.get_msgdef(kind)
    texts = [name for name, (node, inner) in found.fields if node in _SEVERAL and _is_text(inner[0])]
    of_parts = [not _is_number(inner[0]) for _, (node, inner) in found.fields if node == Nodetype.SEQUENCE]

    def counted(read: Callable) -> Callable:
        def one(data: memoryview, pos: int, cls: type, store: CountingStore) -> Any:
            store.count()
            store.sequences.append(iter(of_parts))
            try:
                message, pos = read(data, pos, cls, store)
            except SerdeError as error:
                said = str(error).split()
                if said[:3] == ["Invalid", "sequence", "length"] and store.of_parts and int(said[3]) > store.left:
                    store.count(int(said[3]))
                raise
            store.sequences.pop()
            store.count(sum(len(getattr(message, name)) for name in texts))
            return message, pos

        return one

    return replace(
        found,
        deserialize_cdr_le=counted(found.deserialize_cdr_le),
        deserialize_cdr_be=counted(found.deserialize_cdr_be),
        deserialize_ros1=counted(found.deserialize_ros1),
    )


_SEVERAL = (Nodetype.ARRAY, Nodetype.SEQUENCE)


def _is_text(description: Any) -> bool:
    return description[0] == Nodetype.BASE and description[1][0] == "string"


def _is_number(description: Any) -> bool:
    return description[0] == Nodetype.BASE and not _is_text(description)


def _check_arrays(types: Typestore, kind: str) -> None:
    """Raises SerdeError for a type that has, itself or within, a long array of parts."""
    waiting, seen = [kind], {kind}
    while waiting:
        name = waiting.pop()
        fields: Any = types.fielddefs[name][1]
        for field, (node, inner) in fields:
            of = inner[0] if node in _SEVERAL else (node, inner)
            if node == Nodetype.ARRAY and inner[1] > _LONGEST_ARRAY and not _is_number(of):
                raise SerdeError(f"its definition of {name} gives {field} {inner[1]} parts")
            if of[0] == Nodetype.NAME and of[1] not in seen:
                seen.add(of[1])
                waiting.append(of[1])
