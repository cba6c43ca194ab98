"""`farside live`: frames in from a camera, hypotheses out to the bus, the page and a recording, until Ctrl-C.

Three threads run in parallel and do not wait for each other. A reader takes every frame from the camera. A keeper
records every frame and publishes it on the bus. This thread infers from the newest frame.
"""

import math
import time
from collections.abc import Callable
from contextlib import ExitStack

from rich.console import Console

from calibration.camera_file import read_camera
from calibration.pose_files import read_mounting
from node.commands.keeper import Keeper
from node.commands.options import LiveConfig
from node.ros.bus import Bus
from node.ros.clock import Clock
from node.ros.frame_tree import FrameTree
from node.ros.messages import HYPOTHESES, definition, encode, hypotheses_message
from node.ros.parameters import flat, serve_parameters
from node.ros.publishers import Announcer
from node.ros.scene_messages import DiagnosticStatus, Level
from node.ros.services import Answers
from node.ros.topic_source import TopicSource
from node.ros.type_descriptions import serve_type_descriptions
from perception.answers.hypotheses import Hypotheses
from perception.inference.inference import Inference
from perception.inference.limits import Callbacks, Limits
from perception.inference.scene import estimate_scene
from perception.inference.schedule import config_hash, scheduled
from perception.inference.tracker import Change, Look, Tracker
from perception.inference.warm_up import warm_up
from perception.observation.seen_surface import is_gone
from perception.observation.segmentation import Segment, segment
from perception.sources.frame import Frame, Source
from perception.sources.open_source import open_source
from perception.sources.playback import Playback
from perception.sources.reader import Reader
from perception.sources.recorder import Recorder
from perception.sources.recording import Log
from perception.sources.topic_names import TopicNames
from probnerf.prior.checkpoint import load_prior
from probnerf.types import StopReason

HYPOTHESES_TOPIC = "/farside/hypotheses"
STATUS_S = 1.0  # between diagnostics


def live(config: LiveConfig, out: Console, err: Console) -> None:
    """Run the node until Ctrl-C, `config.seconds`, or the source's end.

    Raises OSError, ValueError or FileNotFoundError in one line for a missing source, an endpoint or port in use, or a
    file that cannot be written; at the end also if the recording broke off. A fault of one frame is reported once and
    counted.
    """
    mounting = None if config.hand_eye is None else read_mounting(config.hand_eye)
    tracker = Tracker(load_prior(config.prior), config.controller, config.track, config.seed)
    with ExitStack() as stack:
        bus = stack.enter_context(Bus(config.bus, lambda text: err.print(text, highlight=False, soft_wrap=True)))
        source = _open(config, bus)
        page = None
        if config.page is not None:
            from node.viewer.page import Page  # viser takes a second to import

            page = stack.enter_context(Page(config.page, config.token))
        recorder = None  # last, after all that may fail: a failed start leaves no file
        if config.record is not None:
            recorder = Recorder(config.record, config.recording)
            stack.callback(_close, recorder)
        clock = Clock(bus, config.bus.use_sim_time)
        announcer = Announcer(bus, config.planner, clock)
        reader = Reader(source)
        keeper = Keeper(
            reader.listen("keeper"),
            recorder,
            None if config.source == "topic" else announcer,
            lambda text: bus.counts.add("camera", "failed", text),
        )
        stack.callback(keeper.close)  # when the reader is closed, and what waits is written
        with err.status("compiling; from the second start on it takes seconds"):
            warm_up(tracker)  # before the first frame: its stalls would hold up the reader
        stack.enter_context(reader)
        keeper.thread.start()
        frames = FrameTree(bus)
        answers = Answers(announcer.node, config.planner, frames, clock)
        node = LiveNode(config, tracker, announcer, answers, reader, keeper, recorder, err)
        if mounting is not None:
            frames.mount(bus, mounting)
            node.placed = mounting.camera
        answers.serve(bus)
        serve_parameters(bus, flat(config) | {"use_sim_time": config.bus.use_sim_time})
        serve_type_descriptions(bus)
        if page is not None:
            node.show = page.show
            out.print(f"{page.address} shows it", highlight=False, soft_wrap=True)
        where = ", ".join((*config.bus.listen, *config.bus.connect))
        out.print(f"{announcer.node} is up on {where}; Ctrl-C ends it", highlight=False, soft_wrap=True)
        try:
            node.run(out)
        except KeyboardInterrupt:
            pass
        counts = reader.counts()
    out.print(node.tally(), highlight=False, soft_wrap=True)
    for note in counts.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if recorder is not None and recorder.error is not None:
        raise OSError(recorder.error)


def _open(config: LiveConfig, bus: Bus) -> Source:
    if config.source == "topic":
        return TopicSource(bus, config.topic, config.segment)
    camera = None if config.camera is None else read_camera(config.camera)
    source = open_source(config.source, camera, TopicNames(config.colour_topic, config.depth_topic), config.oak)
    return Playback(source, config.pace) if isinstance(source, Log) else source


def _close(recorder: Recorder) -> None:
    """End the recording; one without a frame leaves no file."""
    recorder.close()
    if not recorder.frames:
        recorder.path.unlink(missing_ok=True)


class LiveNode:
    """Infers from the newest frame and publishes the results."""

    def __init__(
        self,
        config: LiveConfig,
        tracker: Tracker,
        announcer: Announcer,
        answers: Answers,
        reader: Reader,
        keeper: Keeper,
        recorder: Recorder | None,
        err: Console,
    ) -> None:
        self.config, self.tracker, self.announcer, self.reader = config, tracker, announcer, reader
        self.keeper, self.recorder, self.err = keeper, recorder, err
        self.answers = answers
        self.show: Callable[..., None] | None = None
        self.placed: str | None = None  # frame of the camera that --hand-eye places
        self.frames = self.inferences = self.answered = 0
        self._scene: dict[int, Hypotheses] = {}
        self._seen: dict[int, tuple[Frame, Segment]] = {}  # the scene's objects, when last seen
        self._said: dict[str, int] = {}  # what went wrong, and how often
        self._hash = config_hash(config.controller, config.segment, config.track)
        self._told = 0.0
        self._recording_told = False
        self._until = math.inf  # on time.monotonic()'s clock

    def run(self, out: Console) -> None:
        """Until the source or the time ends. Raises what the source raised."""
        self._until = time.monotonic() + (math.inf if self.config.seconds is None else self.config.seconds)
        while time.monotonic() < self._until:
            frame = self.reader.newest(timeout=0.2)
            self._tell_status()
            if frame is None:
                if self.reader.over:
                    return
                continue
            if not self._kept(frame):
                continue
            self.frames += 1
            try:
                self.take(frame, out)
            except ValueError as error:
                self._trouble(str(error))

    def _kept(self, frame: Frame) -> bool:
        """Whether the recording has the frame. A frame that the recording dropped is not used for inference."""
        until = time.monotonic() + 0.5
        while not self.keeper.has(frame) and time.monotonic() < until:
            time.sleep(0.005)
        return self.keeper.has(frame)

    def take(self, frame: Frame, out: Console) -> None:
        """Process one frame: first publish its objects' present hypotheses, then infer what the frame adds."""
        if self.placed not in (None, frame.frame_id):
            self._trouble(f"--hand-eye places {self.placed!r}, but pictures are of {frame.frame_id!r}: correct it")
        if self.config.source == "topic":  # publish again the driver's frames that are inferred from
            self.announcer.frame(frame)
        try:
            segments = segment(frame, None, self.config.segment)
        except ValueError as error:
            self._trouble(str(error))
            return self._take_away(frame)
        if segments.doubt:
            self._trouble(segments.doubt)
        for it in segments.left_out:
            self._trouble(f"object {it.id} is left out: {it.reason}")
        looks: list[tuple[Segment, Look]] = []
        for found in segments:
            try:
                if (look := self.tracker.look(frame, found)) is not None:
                    looks.append((found, look))
            except ValueError as error:
                self._trouble(f"object {found.id}: {error}")
        if not looks:
            return self._take_away(frame)
        ids = {look.object_id: found for found, look in looks}
        self._seen = {name: (frame, found) for name, found in ids.items()}
        self._scene = {look.object_id: look.hypotheses for _, look in looks if look.hypotheses is not None}
        if self._scene:
            self._publish(frame, ids)
        for _, look in looks:
            if look.settled:
                self.tracker.infer(look)
        waiting = {look.object_id: look for _, look in looks if not look.settled}
        if (now := time.monotonic()) >= self._until:
            return

        def answered(h: Hypotheses) -> None:
            self._scene[h.object_id] = h
            self._publish(frame, ids)
            self._tell_status()

        def start(found: Segment, deadline: float | None) -> Inference:
            return self.tracker.begin(waiting[found.id], Limits(deadline), Callbacks(on_answer=answered))

        interrupted = False
        every = [look.segment for look in waiting.values()]
        deadline = min(now + len(every) * self.config.budget, self._until)
        for found, result in estimate_scene(every, start, deadline):
            if isinstance(result, ValueError):
                self._trouble(f"object {found.id}: {result}")
                continue
            look = waiting[found.id]
            update = self.tracker.keep(look, result)
            self.inferences += 1
            h = update.hypotheses
            self._record(h, look)
            news = {Change.NEW: "first seen", Change.MOVED: "has moved: inference restarted"}
            news |= {Change.VIEW: "seen from another side", Change.CONTINUED: "sampling went on"}
            out.print(
                f"object {h.object_id} {news[update.change]}: {h.result} at stage {h.stage},"
                f" effective hypotheses {h.effective_hypotheses:.1f}, error {h.monte_carlo_error:.3f}",
                highlight=False,
                soft_wrap=True,
            )
            interrupted |= h.result == StopReason.INTERRUPTED
        if interrupted:  # the sampler caught a Ctrl-C meant for the whole node
            raise KeyboardInterrupt

    def _take_away(self, frame: Frame) -> None:
        """Take from the scene what a picture of no object shows to be gone; one that shows nothing takes nothing."""
        seen = ((name, *self._seen[name]) for name in self._scene)
        kept = {name: self._scene[name] for name, before, it in seen if not is_gone(before, it.mask, frame)}
        if len(kept) < len(self._scene):  # which planners must hear
            self._scene = kept
            self._publish(frame, {})

    def _publish(self, frame: Frame, segments: dict[int, Segment]) -> None:
        objects = list(self._scene.values())
        self.answers.update(objects)
        self.announcer.scene(objects, frame.camera, self.config.controller.infer.method)
        self.answered += bool(objects)
        if self.show is not None and objects:
            from node.viewer.scene3d import CameraView

            try:
                self.show(objects, CameraView(frame, segments))
            except Exception as error:  # inference and the bus go on without the page
                self._trouble(f"the page does not show this scene: {error or type(error).__name__}")

    def _record(self, h: Hypotheses, look: Look) -> None:
        if self.recorder is None:
            return
        if h.stage > 0 or h.result == StopReason.CONVERGED:  # not a mere guess, which the next frame does better
            self.recorder.write_schedule(scheduled(h, self._hash, "tracked" if look.builds_on else "fresh"))
        data = bytes(encode(hypotheses_message(h, self.config.controller.infer.method)))
        self.recorder.write_raw(HYPOTHESES_TOPIC, HYPOTHESES, definition(HYPOTHESES), data, h.stamp_ns)

    def _trouble(self, text: str) -> None:
        """Print a problem with a frame once, and count it."""
        kind = "".join(c for c in text if not c.isdigit())
        self._said[kind] = self._said.get(kind, 0) + 1
        if self._said[kind] == 1:
            self.err.print(f"note: {text}", highlight=False, soft_wrap=True)

    def _tell_status(self) -> None:
        if self.recorder is not None and self.recorder.error is not None and not self._recording_told:
            self._recording_told = True
            self.err.print(f"recording has ended: {self.recorder.error}", highlight=False, soft_wrap=True)
        now = time.monotonic()
        if now - self._told < STATUS_S:
            return
        self._told = now
        counts = self.reader.counts()
        level: Level = "error" if counts.error else "stale" if counts.rate < 0.2 else "ok"
        values: dict[str, object] = {"received": counts.received, "rate_hz": round(counts.rate, 2)}
        values |= {f"dropped for {name}": n for name, n in counts.dropped.items()}
        message = counts.error or (
            counts.notes[-1] if counts.notes else "frames come" if counts.received else "no frame yet"
        )
        statuses = [DiagnosticStatus("farside: camera", level, message, values)]
        if self.recorder is not None:
            r = self.recorder
            level = "error" if r.error else "ok"
            recorded = {"frames": r.frames, "dropped": r.dropped, "bytes": r.bytes}
            statuses.append(DiagnosticStatus("farside: recording", level, r.error or "recording", recorded))
        self.announcer.status(list(self._scene.values()), statuses)

    def tally(self) -> str:
        """What was done, in one line."""
        counts = self.reader.counts()
        dropped = ", ".join(f"{n} dropped for {name}" for name, n in counts.dropped.items() if name != "newest")
        text = f"{counts.received} frames, {self.frames} looked at, {self.inferences} inferred, {self.answered} answers"
        text += f"; {dropped}" if dropped else ""
        if self.recorder is not None:
            text += f"; {self.recorder.path}: {self.recorder.frames} frames, {self.recorder.dropped} dropped"
        return text
