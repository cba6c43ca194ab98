"""Pairing of streams by stamp: each leading item with the nearest one of every partner stream."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

_RESTART_NS = 200_000_000  # more than messages that overtake each other
Lead = TypeVar("Lead")
Partner = TypeVar("Partner")


@dataclass(eq=False)
class _Waiting(Generic[Partner]):
    """A partner that may still be wanted."""

    stamp_ns: int
    item: Partner
    used: bool = False


@dataclass(frozen=True, eq=False)
class Match(Generic[Lead, Partner]):
    """An item of the leading stream and, by partner stream, its partner."""

    lead: Lead
    partners: dict[str, Partner | None]  # None: there was none within the tolerance
    gaps_ns: dict[str, float]  # to the nearest; inf if there was none


class StampMatcher(Generic[Lead, Partner]):
    """For each item of a leading stream, the item nearest in stamp of every partner stream, within a tolerance.

    Stamps rise within a stream, so a partner no older than the leading item ends its search; without one it waits for
    `waiting` more leading items at most. Where a stream falls by more than `_RESTART_NS` (a clock set back, a
    simulation begun anew), all that waits is matched among itself, and nothing from before is kept. Of each partner
    stream `kept` items may wait (None: any number). A partner may match two leading items. `unused` counts, by stream,
    dropped partners that matched none.
    """

    def __init__(self, streams: Sequence[str], tolerance_ns: int, waiting: int = 30, kept: int | None = None) -> None:
        if tolerance_ns < 0 or waiting < 1 or (kept is not None and kept < 1):
            raise ValueError(f"tolerance {tolerance_ns} ns, waiting {waiting}, kept {kept}: give 0 or more, 1 or more")
        self.tolerance_ns = tolerance_ns
        self.unused = dict.fromkeys(streams, 0)
        self._most_waiting, self._most_kept = waiting, kept
        self._leads: deque[tuple[int, Lead]] = deque()
        self._newest: float = float("-inf")  # stamp of the leading stream
        self._partners: dict[str, deque[_Waiting[Partner]]] = {stream: deque() for stream in streams}

    def push_lead(self, stamp_ns: int, item: Lead) -> list[Match[Lead, Partner]]:
        """Add an item of the leading stream. Returns the matches that it settles."""
        before: list[Match[Lead, Partner]] = []
        if stamp_ns < self._newest - _RESTART_NS:
            before = self.rest()
            for stream, queue in self._partners.items():
                if queue and abs(queue[-1].stamp_ns - stamp_ns) > _RESTART_NS:  # it has not begun anew yet
                    self._clear(stream)
        self._newest = stamp_ns
        self._leads.append((stamp_ns, item))
        return before + self._settled()

    def push_partner(self, stream: str, stamp_ns: int, item: Partner) -> list[Match[Lead, Partner]]:
        """Add an item of a partner stream. Returns the matches that it settles."""
        queue, before = self._partners[stream], list[Match[Lead, Partner]]()
        if queue and stamp_ns < queue[-1].stamp_ns - _RESTART_NS:
            before = self.rest()
            self._clear(stream)
        queue.append(_Waiting(stamp_ns, item))
        settled = before + self._settled()
        while self._most_kept is not None and len(queue) > self._most_kept:
            self._forget(stream)
        return settled

    def rest(self) -> list[Match[Lead, Partner]]:
        """What still waits, when nothing more will come."""
        return [self._take() for _ in range(len(self._leads))]

    def _settled(self) -> list[Match[Lead, Partner]]:
        settled = []
        while self._leads and (
            len(self._leads) > self._most_waiting
            or all(q and q[-1].stamp_ns >= self._leads[0][0] for q in self._partners.values())
        ):
            settled.append(self._take())
        return settled

    def _take(self) -> Match[Lead, Partner]:
        stamp, lead = self._leads.popleft()
        partners: dict[str, Partner | None] = {}
        gaps: dict[str, float] = {}
        for stream, queue in self._partners.items():
            while len(queue) > 1 and queue[0].stamp_ns < stamp - self.tolerance_ns:
                self._forget(stream)
            best = min(queue, key=lambda w: abs(w.stamp_ns - stamp), default=None)
            gaps[stream] = abs(best.stamp_ns - stamp) if best else float("inf")
            partners[stream] = None
            if best and gaps[stream] <= self.tolerance_ns:
                best.used = True
                partners[stream] = best.item
        return Match(lead, partners, gaps)

    def _clear(self, stream: str) -> None:
        while self._partners[stream]:
            self._forget(stream)

    def _forget(self, stream: str) -> None:
        self.unused[stream] += not self._partners[stream].popleft().used
