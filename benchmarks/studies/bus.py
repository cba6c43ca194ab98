"""The bus between two processes over loopback: round trips, service answers, images per second, a stuck subscriber."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from subprocess import PIPE
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from node.ros.bus import Bus
from node.ros.messages import QUERY_REGION, header, image_message, make
from node.ros.parameters import serve_parameters
from node.ros.services import POINTS, Answers
from node.ros.settings import BusConfig
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from probnerf.rendering.occupancy import voxel_centres
from probnerf.types import StopReason

_IMAGE = "sensor_msgs/msg/Image"
_GET = "rcl_interfaces/srv/GetParameters"
_ROOT = Path(__file__).resolve().parent.parent.parent
_WAIT_S = 30.0
_FAST = 1e6  # messages per second: no limit


@dataclass(frozen=True)
class Options(TableOptions):
    """Times of the bus between two processes on this machine."""

    points: int = 1000
    """That a query_region request asks about."""
    hypotheses: int = 48
    """In the scene that is asked, of 64 voxels an axis."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    points, hypotheses = options.points, options.hypotheses
    trips = 100 if options.quick else 1000
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{s.getsockname()[1]}"
    times: dict[str, Float[np.ndarray, n]] = {}
    with Bus(BusConfig(listen=(endpoint,), max_rate=_FAST), say) as bus:
        with _peer(endpoint, "echo", points, hypotheses):
            for name, side in (("1 kB", 18), ("1 MB", 578)):
                times[f"round trip, {name}"] = _round_trips(bus, _image(side, side), trips)
            names = make(f"{_GET}_Request", names=["images"])
            times["service, one parameter"] = _times(lambda: bus.call("/echo/get_parameters", _GET, names), trips)
            ask = make(
                f"{QUERY_REGION}_Request",
                header=header(0, "object"),
                kind=POINTS,
                points=np.random.default_rng(0).uniform(-0.1, 0.1, 3 * points),
            )
            region = f"service, query_region of {points} points"
            times[region] = _times(
                lambda: bus.call("/echo/query_region", QUERY_REGION, ask, _WAIT_S), max(20, trips // 10)
            )
            sent, received, seconds = _throughput(bus, trips)
        with _peer(endpoint, "stuck", 1, 1) as process:
            publisher = bus.publisher("/image", _IMAGE)
            _until(lambda: publisher.wanted)
            picture = _image(640, 480)
            os.kill(process.pid, signal.SIGSTOP)  # it reads nothing any more
            try:
                times["publish 0.9 MB to a stuck subscriber"] = _times(lambda: publisher.publish(picture), trips // 2)
            finally:
                os.kill(process.pid, signal.SIGCONT)
    rows = []
    for condition, ms in times.items():
        for metric, value in (("median", np.median(ms)), ("p99", np.quantile(ms, 0.99)), ("max", ms.max())):
            rows.append(Row("bus", "zenoh, tcp", condition, metric, float(value), "ms", len(ms)))
    condition = "640x480 RGB as fast as they go"
    rows.append(Row("bus", "zenoh, tcp", condition, "received", received / seconds, "1/s", received))
    rows.append(Row("bus", "zenoh, tcp", condition, "lost", 1.0 - received / sent, "", sent))
    return Summary(rows, picture=lambda: _draw(times))


@contextmanager
def _peer(endpoint: str, name: str, points: int, hypotheses: int) -> Iterator[subprocess.Popen]:
    """Another process on the bus, which runs `peer`."""
    code = f"from benchmarks.studies.bus import peer; peer({endpoint!r}, {name!r}, {points}, {hypotheses})"
    with subprocess.Popen([sys.executable, "-c", code], cwd=_ROOT, stdin=PIPE, stdout=PIPE, text=True) as process:
        try:
            assert process.stdin is not None and process.stdout is not None
            if process.stdout.readline() != "ready\n":
                raise ChildProcessError("the benchmark's other process did not start; see above for its error")
            yield process
            process.stdin.close()
            process.wait(_WAIT_S)
        finally:
            process.kill()


def peer(endpoint: str, name: str, points: int, hypotheses: int) -> None:
    """The other process: echoes /ping, counts /image, and answers services, until its standard input ends."""
    counts: dict[str, Any] = {"images": 0, "seconds": 0.0}
    first = [0.0]

    def count(_: Any) -> None:
        now = time.perf_counter()
        if not counts["images"]:
            first[0] = now
        counts["images"] += 1
        counts["seconds"] = now - first[0]

    with Bus(BusConfig(name=name, connect=(endpoint,), max_rate=_FAST), say) as bus:
        answers = Answers()
        answers.update([box_scene(hypotheses)])
        answers.serve(bus)
        serve_parameters(bus, counts)
        pong = bus.publisher("/pong", _IMAGE)
        bus.subscribe("/ping", _IMAGE, pong.publish)
        bus.subscribe("/image", _IMAGE, count, depth=10)
        print("ready", flush=True)
        sys.stdin.read()


def box_scene(count: int, grid: int = 64) -> Hypotheses:
    """Boxes of random sizes."""
    rng = np.random.default_rng(0)
    half = rng.uniform(0.2, 0.8, (count, 3))
    centres = voxel_centres(grid)
    T = np.eye(4)
    T[2, 3] = 0.5
    return Hypotheses(
        stamp_ns=0,
        frame_id="camera",
        object_id=1,
        label="",
        object_frame=ObjectFrame(T, 0.15, np.array([0.0, 0.0, 1.0, -0.6]), 0.05, 0.1),
        T_world_camera=None,
        opacity=np.stack([255 * (np.abs(centres) < h).all(axis=-1) for h in half]).astype(np.uint8),
        pose=np.zeros((count, 5), np.float32),
        weights=np.full(count, 1.0 / count),
        population=np.arange(count) % 4,
        seen=centres[..., 0] > 0,
        inside_view=True,
        out_of_model=False,
        stage=1,
        monte_carlo_error=0.0,
        prior_hash="",
        seed=0,
        diagnostics=AnswerDiagnostics(),
        result=StopReason.STAGES,
    )


def _image(width: int, height: int) -> Any:
    return image_message(1, "camera", np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8), "rgb8")


def _times(act: Callable[[], object], count: int) -> Float[np.ndarray, "n"]:
    """Milliseconds of each of `count` runs, after one that is not counted."""
    act()
    found = []
    for _ in range(count):
        begun = time.perf_counter()
        act()
        found.append(1e3 * (time.perf_counter() - begun))
    return np.array(found)


def _round_trips(bus: Bus, message: Any, count: int) -> Float[np.ndarray, "n"]:
    arrival = threading.Event()
    bus.subscribe("/pong", _IMAGE, lambda _: arrival.set())
    publisher = bus.publisher("/ping", _IMAGE)
    _until(lambda: publisher.wanted)
    _until(lambda: publisher.publish(message) and arrival.wait(0.2))  # and /pong is known over there

    def trip() -> None:
        arrival.clear()
        publisher.publish(message)
        if not arrival.wait(_WAIT_S):
            raise TimeoutError("an image did not come back from the benchmark's other process")

    time.sleep(0.5)  # what is still on its way comes home
    return _times(trip, count)


def _throughput(bus: Bus, count: int) -> tuple[int, int, float]:
    """Images sent, received, and the seconds from the first to the last that was received."""
    publisher, picture = bus.publisher("/image", _IMAGE), _image(640, 480)
    _until(lambda: publisher.wanted)
    for _ in range(count):
        publisher.publish(picture)
    time.sleep(1.0)
    request = make(f"{_GET}_Request", names=["images", "seconds"])
    images, seconds = bus.call("/echo/get_parameters", _GET, request, _WAIT_S).values
    return count, images.integer_value, max(seconds.double_value, 1e-9)


def _until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + _WAIT_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError("the benchmark's other process was not found on the bus")
        time.sleep(0.01)


def _draw(times: dict[str, Float[np.ndarray, "n"]]) -> Figure:
    """Share of the runs that took at most so long."""
    figure = Figure(figsize=(8, 6.5), layout="constrained")
    ax = figure.subplots()
    for name, ms in times.items():
        ax.plot(np.sort(ms), np.linspace(0, 1, len(ms)), label=f"{name}: median {np.median(ms):.2g} ms")
    ax.set(xscale="log", xlabel="ms", ylabel="share of runs", title="Bus between two processes, loopback TCP")
    figure.legend(loc="outside lower center")
    ax.grid(alpha=0.3)
    return figure
