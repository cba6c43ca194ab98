"""Scene: the hypotheses of all objects of one frame. Queries ask all of them together."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import overload

from perception.answers.hypotheses import Hypotheses


@dataclass(frozen=True, eq=False)
class Scene(Sequence[Hypotheses]):
    """The objects of a frame, in the order in which they were inferred; a sequence of `Hypotheses`."""

    objects: tuple[Hypotheses, ...]
    left_out: Mapping[int, str] = field(default_factory=dict)  # why an object has no hypotheses, by its id

    @overload
    def __getitem__(self, index: int) -> Hypotheses: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Hypotheses, ...]: ...
    def __getitem__(self, index: int | slice) -> Hypotheses | tuple[Hypotheses, ...]:
        return self.objects[index]

    def __len__(self) -> int:
        return len(self.objects)

    def __iter__(self) -> Iterator[Hypotheses]:
        return iter(self.objects)

    def by_id(self, object_id: int) -> Hypotheses:
        """The object of this id. Raises `ValueError` that lists the ids."""
        for h in self.objects:
            if h.object_id == object_id:
                return h
        why = self.left_out.get(object_id, f"its objects: {', '.join(str(h.object_id) for h in self) or 'none'}")
        raise ValueError(f"the scene has no object {object_id}; {why}")
