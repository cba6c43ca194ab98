"""A reader holds up no camera, loses nothing silently, and pairs streams by their stamps."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from perception.sources.frame import Frame, StillSource
from perception.sources.reader import Reader
from perception.sources.stamp_matcher import Match, StampMatcher
from perception.sources.time_limit import within
from tests.perception.recorded import RecordedImages, some_frames

FRAME = some_frames(1)[0]
MS = 1_000_000


class Fed:
    """A live source that gives a frame for each stamp that the test puts in, and then what `end` is."""

    live = True

    def __init__(self, end: Exception | None = None) -> None:
        self.notes = ["fed by a test"]
        self.end = end
        self._stamps: list[int] = []
        self._over = False
        self._put = threading.Condition()

    def put(self, *stamps: int, over: bool = False) -> None:
        with self._put:
            self._stamps += stamps
            self._over |= over
            self._put.notify_all()

    def close(self) -> None:
        self.put(over=True)

    def __iter__(self) -> Iterator[Frame]:
        while True:
            with self._put:
                self._put.wait_for(lambda: bool(self._stamps) or self._over)
                if not self._stamps:
                    break
                stamp = self._stamps.pop(0)
            yield replace(FRAME, stamp_ns=stamp)
        if self.end is not None:
            raise self.end


def received(reader: Reader, count: int) -> None:
    """Wait until so many frames have come."""
    deadline = time.monotonic() + 10.0
    while reader.counts().received < count:
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_the_newest_frame_wins_and_the_others_are_counted() -> None:
    source = Fed()
    with Reader(source) as reader:
        assert reader.newest(0.01) is None
        source.put(1, 2, 3)
        received(reader, 3)
        assert reader.newest(0.0).stamp_ns == 3
        assert reader.newest(0.01) is None  # handed out once
        source.put(4)
        assert reader.newest(5.0).stamp_ns == 4
        counts = reader.counts()
    assert counts.received == 4 and counts.dropped == {"newest": 2} and not counts.ended
    assert counts.notes == ("fed by a test",) and counts.error is None


def test_a_listener_gets_every_frame_in_order() -> None:
    source = Fed()
    with Reader(source) as reader:
        listener = reader.listen("recording")
        source.put(*range(50), over=True)
        assert [frame.stamp_ns for frame in listener] == list(range(50))
        assert listener.ended and listener.take(0.0) is None
        assert reader.counts().dropped == {"newest": 49, "recording": 0}


def test_a_consumer_that_has_stopped_holds_nobody_up() -> None:
    """Frames that a listener has no room for are dropped for it alone; what waits is the oldest, without a gap."""
    source = Fed()
    with Reader(source) as reader:
        stopped, eager = reader.listen("stopped", size=5), reader.listen("eager", size=100)
        source.put(*range(100))
        received(reader, 100)
        assert reader.counts().dropped == {"newest": 99, "stopped": 95, "eager": 0}
        assert [stopped.take(0.0).stamp_ns for _ in range(5)] == list(range(5))
        assert [eager.take(0.0).stamp_ns for _ in range(100)] == list(range(100))
        eager.close()
        source.put(100)
        received(reader, 101)
        assert eager.take(5.0) is None and eager.ended
        assert stopped.take(5.0).stamp_ns == 100


def test_a_source_s_exception_reaches_every_consumer_after_the_last_frame() -> None:
    source = Fed(end=OSError("webcam:0 gives no more pictures;\n check its cable"))
    with Reader(source) as reader:
        listener = reader.listen("recording")
        source.put(1, 2, over=True)
        assert [listener.take(5.0).stamp_ns for _ in range(2)] == [1, 2]
        with pytest.raises(OSError, match="no more pictures"):
            listener.take(5.0)
        assert reader.newest(5.0).stamp_ns == 2
        for _ in range(2):
            with pytest.raises(OSError, match="no more pictures"):
                reader.newest(5.0)
        counts = reader.counts()
    assert counts.ended and counts.error == "webcam:0 gives no more pictures; check its cable"


def test_a_source_that_ends_ends_the_reader() -> None:
    frames = tuple(replace(FRAME, stamp_ns=i) for i in range(3))
    with Reader(StillSource(frames, ["a note"])) as reader:
        stamps = []
        while (frame := reader.newest()) is not None:
            stamps.append(frame.stamp_ns)
    assert stamps[-1] == 2 and reader.counts().ended and reader.counts().notes == ("a note",)


def test_closing_wakes_who_waits_and_ends_the_thread() -> None:
    before = set(threading.enumerate())
    source = Fed()
    with Reader(source) as reader:
        listener = reader.listen("recording")
        got: list[Frame | None] = []
        waiting = [
            threading.Thread(target=lambda take=take: got.append(take())) for take in (reader.newest, listener.take)
        ]
        for thread in waiting:
            thread.start()
        begun = time.monotonic()
    for thread in waiting:
        thread.join(5.0)
    assert got == [None, None] and time.monotonic() - begun < 2.0
    assert set(threading.enumerate()) == before


def test_a_source_that_does_not_end_is_left_behind_with_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()

    class Stuck(Fed):
        def __iter__(self) -> Iterator[Frame]:
            release.wait(10.0)
            yield FRAME

    monkeypatch.setattr("perception.sources.reader._CLOSING_S", 0.05)
    with Reader(Stuck()) as reader:
        pass
    assert "the source did not end within 0.05 s; its thread is left behind" in reader.counts().notes
    release.set()
    reader._thread.join(5.0)
    assert reader.counts().received == 0  # what comes after closing is nobody's


def test_the_rate_is_that_of_the_frames_and_falls_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("perception.sources.reader.time.monotonic", lambda: now[0])
    source = Fed()
    with Reader(source) as reader:
        assert reader.counts().rate == 0.0
        for i in range(40):
            now[0] = i / 30.0
            source.put(i)
            while reader.counts().received <= i:
                threading.Event().wait(0.0005)
        assert reader.counts().rate == pytest.approx(30.0)
        now[0] += 10.0
        assert reader.counts().rate <= 0.2


def test_two_listeners_of_one_name_are_refused() -> None:
    with Reader(Fed()) as reader:
        reader.listen("recording")
        for name in ("recording", "newest"):
            with pytest.raises(ValueError, match=f"a listener named '{name}' is there already"):
                reader.listen(name)
        with pytest.raises(ValueError, match="keeps 0 frames"):
            reader.listen("other", size=0)


def test_an_oak_camera_is_read_and_its_loss_published() -> None:
    from perception.sources.oak import OakConfig, OakSource

    sent = some_frames(8)
    images = RecordedImages([sent[:4], sent[4:]])
    with Reader(OakSource(images, OakConfig(silence_s=0.8, retry_s=0.02))) as reader:
        listener = reader.listen("recording")
        assert [listener.take(10.0).stamp_ns for _ in sent] == [frame.stamp_ns for frame in sent]
        assert reader.counts().notes == ("recorded: lost once, back now; last: recorded gave no frame for 0.8 s",)
        begun = time.monotonic()
    assert time.monotonic() - begun < 2.0 and images.closed == [1, 2]


def test_what_takes_too_long_is_left_behind() -> None:
    closed: list[int] = []

    def seven() -> int:
        time.sleep(0.2)
        return 7

    assert within(5.0, lambda: 3, "late", late=closed.append) == 3
    with pytest.raises(ZeroDivisionError):
        within(5.0, lambda: 1 // 0, "late")
    with pytest.raises(OSError, match="late"):
        within(0.02, seven, "late", late=closed.append)
    deadline = time.monotonic() + 10.0
    while not closed:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert closed == [7]


def depths(matches: list[Match[int, str]]) -> list[tuple[int, str | None]]:
    return [(match.lead, match.partners["depth"]) for match in matches]


def matcher(waiting: int = 30) -> StampMatcher:
    return StampMatcher(("depth",), 10 * MS, waiting, waiting)


def test_streams_pair_by_the_nearest_stamp() -> None:
    pairs = matcher()
    assert pairs.push_lead(0, 0) == []
    assert depths(pairs.push_partner("depth", 0, "0")) == [(0, "0")]  # equal stamps pair at once
    assert pairs.push_partner("depth", 25 * MS, "25") == []
    assert pairs.push_partner("depth", 31 * MS, "31") == []
    assert pairs.push_lead(33 * MS, 33) == []  # the next depth may be nearer
    assert depths(pairs.push_partner("depth", 36 * MS, "36")) == [(33, "31")]
    assert pairs.unused == {"depth": 0}
    assert pairs.push_lead(80 * MS, 80) == []
    (none,) = pairs.push_partner("depth", 100 * MS, "100")  # 20 ms is too far
    assert depths([none]) == [(80, None)] and none.gaps_ns["depth"] == 20 * MS
    assert pairs.unused == {"depth": 2}  # 25 and 36


def test_pairs_do_not_depend_on_which_stream_comes_first() -> None:
    early, late, got = matcher(), matcher(), []
    for i in range(20):
        assert early.push_partner("depth", i * 33 * MS + 2 * MS, i) == []
        assert late.push_lead(i * 33 * MS, i) == []
    for i in range(20):
        got.append((early.push_lead(i * 33 * MS, i), late.push_partner("depth", i * 33 * MS + 2 * MS, i)))
    assert [(depths(a), depths(b)) for a, b in got] == [([(i, i)], [(i, i)]) for i in range(20)]


def test_a_stream_without_its_partners_is_bounded_and_counted() -> None:
    pairs = matcher()
    given_up = [match for i in range(1000) for match in pairs.push_lead(i * 33 * MS, i)]
    assert depths(given_up) == [(i, None) for i in range(1000 - 30)]
    assert depths(pairs.push_partner("depth", 999 * 33 * MS, "999"))[-1] == (999, "999")  # and pairs come again
    pairs = matcher()
    assert not any(pairs.push_partner("depth", i * 33 * MS, str(i)) for i in range(1000))
    assert pairs.unused == {"depth": 1000 - 30}
    assert depths(pairs.push_lead(999 * 33 * MS, 999)) == [(999, "999")]


def test_a_stream_that_has_no_partners_waits_for_none() -> None:
    alone: StampMatcher[int, str] = StampMatcher((), 0)
    assert [match.lead for match in alone.push_lead(5, 7)] == [7]


def test_pairing_recovers_from_a_clock_that_is_set_back() -> None:
    pairs, got = matcher(), []
    for start in (10_000 * MS, 0):
        for i in range(100):
            pairs.push_lead(start + i * 33 * MS, i)
            got += depths(pairs.push_partner("depth", start + i * 33 * MS, i))
    got = [pair for pair in got if pair[1] is not None]
    assert got[:100] == [(i, i) for i in range(100)] and got[-60:] == [(i, i) for i in range(40, 100)]


def test_a_matcher_refuses_senseless_bounds() -> None:
    with pytest.raises(ValueError, match="tolerance -1 ns"):
        StampMatcher(("depth",), -1)
