"""`farside live`'s path under attack for M minutes: recorder, keeper, tracker with pretended inference, bus and page.

Rounds of 20 to 40 s (the first one a quarter of the whole), each a process of its own with a recording of its own, at
60 frames per second. In every round the camera is unplugged for moments and its clock jumps (a minute to either side),
a stranger floods the query service, and a planner asks it twice a second. A round ends orderly, by SIGKILL at a random
moment, or some time after its disk was full (a limit of the file's size, which the system enforces).

Each frame has its number in its depth. A frame is acknowledged when the recorder has taken it.

- lost: frames that were acknowledged but cannot be read afterwards, though they had SETTLED_S seconds to reach the file
  before the kill, or the recorder had counted them as written two chunks before the disk was full. Must be 0.
- unanswered: the planner's questions without an answer within 5 s. Must be 0.
- MB per 1000 frames: slope of the process's resident memory over the last two thirds of the first round.
- reader_peak: most resident memory of the process that reads the recordings, with all that it imports.
"""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.scenes.recording import noisy
from benchmarks.studies.bus import box_scene
from node.commands.keeper import Keeper
from node.commands.live import LiveNode, _close
from node.commands.options import LiveConfig
from node.ros.bus import Bus
from node.ros.messages import QUERY_REGION, encode, header, make, type_hash
from node.ros.publishers import Announcer
from node.ros.rmw_zenoh import attachment, key
from node.ros.services import Answers
from node.ros.settings import BusConfig
from node.viewer.page import Page
from perception.sources.frame import Frame
from perception.sources.reader import Reader
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.settings import RecordConfig

RATE = 60.0  # frames per second
SETTLED_S = 4.0  # flush_s, and what may wait for the writer on a busy machine
DISK_BYTES = 100_000_000
_CHUNKS = 28  # frames that two chunks (8 MB before compression) may hold: each has 0.6 MB of depth
_ROOT = Path(__file__).resolve().parent.parent.parent
_CORNER = make("geometry_msgs/msg/Point", x=0.1, y=0.1, z=0.1)
_ASK = make(f"{QUERY_REGION}_Request", header=header(0, "camera"), box_high=_CORNER)


@dataclass(frozen=True)
class Options(TableOptions):
    """The live path at speed with unplugging, floods, clock jumps, full disks and kills."""

    minutes: float = 10.0
    """How long; 1 with --quick."""
    seed: int = 0
    """Of what happens when."""


def main(options: Options) -> Summary:
    """Soak, check each recording, and sum up."""
    rng, total = random.Random(options.seed), Counter[str]()
    ends, slope = Counter[str](), 0.0
    total_s = 60.0 * (1.0 if options.quick else options.minutes)
    until = time.monotonic() + total_s
    options.out.mkdir(parents=True, exist_ok=True)
    while time.monotonic() < until:
        how = ("orderly", "killed", "full disk")[ends.total() % 3]
        seconds = rng.uniform(20.0, 40.0) if ends else max(20.0, 0.25 * total_s)
        seconds = min(seconds, max(10.0, until - time.monotonic()))
        found, memory = one_round(options.out / "soak.mcap", how, seconds, rng.randrange(2**31))
        ends[how] += 1
        total += Counter({name: 0 for name in found}) + Counter(found)
        if ends.total() == 1 and memory is not None:
            slope = memory
        say(f"round {ends.total()} ({how}, {seconds:.0f} s): " + ", ".join(f"{k} {v}" for k, v in found.items()))
    names = ("acknowledged", "read", "lost", "asked", "unanswered", "flood dropped", "unplugged", "clock jumps")
    rows = [Row("soak", how, "", "rounds", count, "", count) for how, count in ends.items()]
    rows += [Row("soak", "all rounds", "", name, total[name], "", ends.total()) for name in names]
    rows.append(Row("soak", "orderly", "first round", "memory_slope", slope, "MB/1000 frames", 1))
    peak = 1e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rows.append(Row("soak", "all rounds", "", "reader_peak", peak, "MB", ends.total()))
    if total["lost"] or total["unanswered"]:
        raise ValueError(f"{total['lost']} recorded frames are lost and {total['unanswered']} questions unanswered")
    return Summary(rows)


def one_round(path: Path, how: str, seconds: float, seed: int) -> tuple[dict[str, int], float | None]:
    """What was counted, and the slope of the memory (MB per 1000 frames)."""
    path.unlink(missing_ok=True)
    told = path.with_suffix(".acknowledged")
    told.unlink(missing_ok=True)
    code = f"from benchmarks.studies.soak import node; node({str(path)!r}, {how!r}, {seconds}, {seed})"
    killed_at, counts = float("inf"), Counter[str]()
    with ExitStack() as stack:
        child = stack.enter_context(_process(code))
        assert child.stdout is not None
        endpoint = child.stdout.readline().strip()
        if not endpoint.startswith("tcp/"):
            raise ValueError(f"the node did not start: {endpoint or 'it said nothing'}")
        stack.enter_context(_process(f"from benchmarks.studies.soak import flood; flood({endpoint!r})"))
        planner = stack.enter_context(Bus(BusConfig(name="planner", connect=(endpoint,)), lambda _: None))
        end = time.monotonic() + (seconds if how != "killed" else random.Random(seed).uniform(0.5, 1.0) * seconds)
        planner.call("/farside/query_region", QUERY_REGION, _ASK, 30.0)
        while time.monotonic() < end - 5.0 and child.poll() is None:
            counts["asked"] += 1
            try:
                planner.call("/farside/query_region", QUERY_REGION, _ASK, 5.0)
            except TimeoutError:
                counts["unanswered"] += 1
            time.sleep(0.5)
        if how == "killed":
            time.sleep(max(0.0, end - time.monotonic()))
            child.kill()
            killed_at = time.monotonic()
        last = child.stdout.read().splitlines()
        if child.wait(60.0) != (-signal.SIGKILL if how == "killed" else 0):
            raise ValueError(f"the node ended with {child.returncode} in a round that is {how}")
    memory = None
    if how != "killed":
        summary = json.loads(last[-1])
        memory = summary.pop("slope")
        counts.update(summary)
    acknowledged = [(int(n), float(at)) for n, at in (line.split() for line in told.read_text().splitlines())]
    there = {number_of(frame) for frame in Log(path)}
    settled = [n for n, at in acknowledged if at < killed_at - SETTLED_S]
    if how == "full disk":  # the chunk that did not fit is not held to be kept
        settled = settled[: max(0, counts["written"] - _CHUNKS)]
    lost = sum(n not in there for n in settled)
    return dict(counts) | {"acknowledged": len(acknowledged), "read": len(there), "lost": lost}, memory


def _process(code: str) -> Any:
    """A process that is killed at the end of the `with`."""
    stack = ExitStack()
    process = stack.enter_context(
        subprocess.Popen([sys.executable, "-c", code], cwd=_ROOT, stdout=subprocess.PIPE, text=True)
    )
    stack.callback(process.kill)

    class Held:
        def __enter__(self) -> subprocess.Popen[str]:
            return process

        def __exit__(self, *_: object) -> None:
            stack.close()

    return Held()


def node(record: str, how: str, seconds: float, seed: int) -> None:
    """The node of one round, in a process of its own. Prints its endpoint, and at the end its counts."""
    if how == "full disk":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))
    config = LiveConfig(seconds=seconds, record=Path(record), recording=RecordConfig(colour="jpeg"))
    camera, err = _Camera(seed), Console(stderr=True, quiet=True)
    with ExitStack() as stack:
        bus = stack.enter_context(Bus(BusConfig(listen=(f"tcp/127.0.0.1:{_free_port()}",)), lambda _: None))
        page, recorder = stack.enter_context(Page(0)), Recorder(record, config.recording)
        stack.callback(_close, recorder)
        announcer, reader = Announcer(bus), Reader(camera)
        acknowledge = stack.enter_context(Path(record).with_suffix(".acknowledged").open("w", buffering=1))
        taken = recorder.write_frame

        def write_frame(frame: Frame) -> bool:
            if not taken(frame):
                return False
            acknowledge.write(f"{number_of(frame)} {time.monotonic()}\n")
            return True

        recorder.write_frame = write_frame  # type: ignore[method-assign]
        keeper = Keeper(reader.listen("keeper"), recorder, announcer, lambda _: None)
        stack.callback(keeper.close)
        stack.enter_context(reader)
        keeper.thread.start()
        answers = Answers(announcer.node)
        live = LiveNode(config, _Tracker(), announcer, answers, reader, keeper, recorder, err)  # type: ignore[arg-type]
        answers.serve(bus)
        live.show = page.show
        print(bus.config.listen[0], flush=True)
        memory: list[tuple[int, float]] = []
        live._tell_status = _sampled(live._tell_status, memory, reader)  # type: ignore[method-assign]
        live.run(Console(quiet=True))
        counts = {"unplugged": camera.unplugged, "clock jumps": camera.jumps, "written": recorder.frames}
        counts["flood dropped"] = bus.counts.of("/farside/query_region").get("dropped", 0)
        if how == "full disk" and recorder.error is None:
            raise ValueError("the disk was not full")
    print(json.dumps(counts | {"slope": _slope(memory)}), flush=True)


def flood(endpoint: str) -> None:
    """Ask as fast as it goes, and wait for nothing."""
    data, where = bytes(encode(_ASK)), key(0, "/farside/query_region", QUERY_REGION, type_hash(QUERY_REGION))
    with Bus(BusConfig(name="stranger", connect=(endpoint,))) as bus:
        for number in range(1, 10**9):
            tag = attachment(number, 0, b"f" * 16)
            bus._session.get(where, lambda _: None, payload=data, attachment=tag, timeout=1.0)
            if number % 20 == 0:
                time.sleep(0.01)  # 2000 a second: the planner and the node share these cores


def number_of(frame: Frame) -> int:
    """The number in a frame's first two depths (whole millimetres, which a recording keeps exactly)."""
    assert frame.depth is not None
    thousands, ones = np.rint(1000.0 * frame.depth[0, :2]).astype(int) - 1
    return int(1000 * thousands + ones)


class _Camera:
    """Numbered frames; unplugged for moments, with a clock that jumps to either side."""

    live = True

    def __init__(self, seed: int) -> None:
        self._rng, self._closed = random.Random(seed), False
        self.notes: list[str] = []
        self.unplugged = self.jumps = 0

    def close(self) -> None:
        self._closed = True

    def __iter__(self) -> Iterator[Frame]:
        pictures, ahead, number = noisy(30), 0, 0
        while not self._closed:
            number += 1
            what = self._rng.random()
            if what < 1 / (10 * RATE):
                self.unplugged += 1
                time.sleep(self._rng.uniform(0.2, 2.0))
            elif what < 2 / (10 * RATE):
                self.jumps += 1
                ahead += round(self._rng.uniform(-60e9, 60e9))
            frame = pictures[number % len(pictures)]
            assert frame.depth is not None
            depth = frame.depth.copy()
            depth[0, :2] = 0.001 * (1 + np.array(divmod(number, 1000)))
            yield replace(frame, depth=depth, stamp_ns=time.time_ns() + ahead)
            time.sleep(1.0 / RATE)


class _Tracker:
    """Stands for inference: every object has an answer at once, which is settled."""

    def __init__(self) -> None:
        self._answer = box_scene(16)

    def look(self, frame: Frame, found: Any) -> Any:
        h = replace(self._answer, stamp_ns=frame.stamp_ns, frame_id=frame.frame_id, object_id=found.id)
        return SimpleNamespace(object_id=found.id, hypotheses=h, settled=True, segment=found)

    def infer(self, look: Any) -> None:
        """Nothing more."""


def _sampled(tell: Any, memory: list[tuple[int, float]], reader: Reader) -> Any:
    """`tell`, which also notes the frames so far and the resident memory (MB)."""

    def sample() -> None:
        tell()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        memory.append((reader.counts().received, 1e-6 * pages * os.sysconf("SC_PAGE_SIZE")))

    return sample


def _slope(memory: list[tuple[int, float]]) -> float:
    """MB per 1000 frames after the first third."""
    frames, held = np.array(memory[len(memory) // 3 :]).T
    return float(1000.0 * np.polyfit(frames, held, 1)[0])


def _free_port() -> int:
    import socket

    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])
