"""Recording: frames and the results of inference in one MCAP file that `Log`, rosbags, ROS 2 and Foxglove read.

A thread encodes and writes, so that the caller does not wait for the disk. Data go to the system in whole chunks, at
least every `flush_s`: a killed process loses no more than that, and `Log` reads the rest.
"""

import queue
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any, Self

import cv2
import numpy as np
from jaxtyping import Float32, Shaped
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from foundation.one_line import one_line
from foundation.whole_file import whole_file
from perception.sources.frame import SATURATED, Frame, known_counts
from perception.sources.ros_images import MM, POSE_TOPIC
from perception.sources.schedule_entry import SCHEDULE_TOPIC, Scheduled
from perception.sources.settings import RecordConfig

_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_IMAGE, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_POSE, _STRING = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/String"
_COLOUR_OUT, _INFO_OUT, _LABEL_OUT = (f"/camera/color/{name}" for name in ("image_raw", "camera_info", "label"))
_DEPTH_OUT = "/camera/aligned_depth_to_color/image_raw"
_SECOND, _LAST = 1_000_000_000, 2**63 - 1  # ns
_COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@dataclass(frozen=True)
class _Raw:
    """One serialised message."""

    topic: str
    kind: str  # message type
    definition: str
    data: bytes
    stamp_ns: int


class Recorder:
    """Writes a new MCAP file (profile ros2) until `close`, which `with` calls.

    `frames` and `bytes` count what was written, and `dropped` the frames lost because the writer was behind (none with
    `wait`, which makes `write_frame` wait instead). If writing fails, for example on a full disk, `error` is one line,
    `on_error` is called with it (by the writer's thread), and later data are ignored. Data written before can be read.
    Raises OSError in one line if the file exists already or cannot be created.
    """

    def __init__(
        self,
        path: Path | str,
        config: RecordConfig | None = None,
        *,
        wait: bool = False,
        on_error: Callable[[str], None] | None = None,
    ) -> None:
        self.path, self.config = Path(path), config or RecordConfig()
        self.frames, self.dropped, self.bytes = 0, 0, 0
        self.error: str | None = None
        self._wait, self._on_error, self._closed = wait, on_error, False
        try:
            if not self.path.parent.exists():
                self.path.parent.mkdir(parents=True)
            self._stream = self.path.open("xb")
        except OSError as error:
            why = f"cannot be written ({error.strerror}); give another place"
            if self.path.exists():
                why = "is there already; give another name, or move the file"
            raise OSError(f"{self.path} {why}") from None
        self._writer = Writer(
            self._stream,
            chunk_size=self.config.chunk_bytes,
            compression=_COMPRESSIONS[self.config.compression],
            enable_data_crcs=True,
        )
        self._writer.start(profile="ros2", library="farside")
        self._log_ns = 0  # the latest time in the log
        self._stamp_ns = 0  # of the latest frame
        self._channels: dict[str, int] = {}  # by topic
        self._schemas: dict[str, int] = {}  # by message type
        self._types: dict[str, str] = {}  # message type of each topic that was handed over
        self._queue: queue.Queue[Frame | _Raw | None] = queue.Queue(self.config.waiting)
        # A daemon, for a program that ends without `close` must end all the same; the file is then as after a kill.
        self._thread = Thread(target=self._run, name=f"recorder of {self.path.name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def write_frame(self, frame: Frame) -> bool:
        """Queue a frame for writing. Its arrays must not change afterwards. Returns False if it was dropped.

        Standard deviations of the camera are not written: ROS messages have no field for them.
        Raises ValueError if a label does not fit 16 bits.
        """
        if frame.label is not None:
            low, high = int(frame.label.min()), int(frame.label.max())
            if low < 0 or high > 65535:
                raise ValueError(f"label ids run from {low} to {high}; a log holds 0 to 65535")
        return self._hand_over(frame, self._wait)

    def write_raw(self, topic: str, type_name: str, msgdef_text: str, cdr_bytes: bytes, stamp_ns: int) -> None:
        """Queue a message of any type ("package/msg/Name"), serialised as CDR. Waits while the writer is behind.

        `msgdef_text` is its definition with those it depends on, as MCAP's encoding "ros2msg" wants it. Raises
        ValueError where the topic holds another type.
        """
        if (known := self._types.setdefault(topic, type_name)) != type_name:
            raise ValueError(f"{self.path}: topic {topic} holds {known}, not {type_name}; use another topic")
        self._hand_over(_Raw(topic, type_name, msgdef_text, bytes(cdr_bytes), stamp_ns), wait=True)

    def write_schedule(self, entry: Scheduled) -> None:
        """Hand over an inference, for `farside replay --schedule` to repeat it; waits while the writer is behind."""
        data = bytes(_TYPES.serialize_cdr(_TYPES.types[_STRING](entry.to_json()), _STRING))
        self.write_raw(SCHEDULE_TOPIC, _STRING, _definition(_STRING), data, entry.stamp_ns)

    def close(self) -> None:
        """Write what waits, then the index and the footer; later calls are ignored. A second call does nothing."""
        if not self._closed:
            self._closed = True
            self._queue.put(None)
        self._thread.join()

    def _hand_over(self, item: Frame | _Raw, wait: bool) -> bool:
        while self.error is None and not self._closed:
            try:
                self._queue.put(item, block=wait, timeout=0.5)  # checks regularly whether another thread has closed it
                return True
            except queue.Full:
                if not wait:
                    self.dropped += 1
                    return False
        return False

    def _run(self) -> None:
        due, ended = time.monotonic() + self.config.flush_s, False
        while not ended:
            item: Frame | _Raw | tuple[()] | None = ()
            with suppress(queue.Empty):
                item = self._queue.get(timeout=self.config.flush_s)
            ended = item is None
            if self.error is not None:
                continue
            try:
                if isinstance(item, Frame):
                    self._follow(item.stamp_ns)
                    for message in _messages(item, self.config):
                        self._add(message)
                    self.frames += 1
                elif isinstance(item, _Raw):
                    self._add(item)
                if ended:
                    self._writer.finish()
                    self._stream.flush()
                elif time.monotonic() >= due:
                    self._writer.flush()
                    due = time.monotonic() + self.config.flush_s
                self.bytes = self._stream.tell()
            except Exception as error:  # no error here may end the program
                self._fail(error)
                if not isinstance(error, OSError):  # what waits to be written is whole
                    with suppress(Exception):
                        self._writer.finish()
                        self._stream.flush()
        with suppress(OSError):
            self._stream.close()

    def _follow(self, stamp_ns: int) -> None:
        """Log times only rise, as players take for granted, and after a clock was set back they do so as the stamps do,
        by a second a frame at most: were they all the same until it catches up, readers would hold all of it at once.
        """
        rise = min(max(stamp_ns - self._stamp_ns, 0), _SECOND)
        self._stamp_ns = stamp_ns
        if self._log_ns - stamp_ns > _SECOND:
            self._log_ns = min(self._log_ns + rise, _LAST)
        else:  # frames that overtake each other, or come after a message of a later stamp
            self._log_ns = max(self._log_ns, stamp_ns)

    def _add(self, message: _Raw) -> None:
        if message.topic not in self._channels:
            if message.kind not in self._schemas:
                self._schemas[message.kind] = self._writer.register_schema(
                    message.kind, "ros2msg", message.definition.encode()
                )
            metadata = {"offered_qos_profiles": ""}
            channel = self._writer.register_channel(message.topic, "cdr", self._schemas[message.kind], metadata)
            self._channels[message.topic] = channel
        self._log_ns = min(max(self._log_ns, message.stamp_ns), _LAST)
        self._writer.add_message(self._channels[message.topic], self._log_ns, message.data, message.stamp_ns)

    def _fail(self, error: Exception) -> None:
        reason = getattr(error, "strerror", None) or one_line(error)
        remedy = "make room or record elsewhere" if isinstance(error, OSError) else "the disk is not the cause"
        kept = "; what was written before can be read" if self.frames else ""
        self.error = f"{self.path}: recording ended at frame {self.frames} ({reason}); {remedy}{kept}"
        if self._on_error is not None:
            self._on_error(self.error)


def write_log(path: Path | str, frames: Iterable[Frame]) -> int:
    """Write frames to one small `.mcap` and return their number.

    Colour is PNG and depth whole millimetres. The file appears whole or not at all, in place of one that was there.
    Raises `ValueError` if there is no frame or a label does not fit 16 bits, OSError where writing fails.
    """
    path = Path(path)
    small = RecordConfig(colour="png", depth="millimetres", compression="zstd", chunk_bytes=1 << 18)
    with whole_file(path) as part:
        with Recorder(part, small, wait=True) as recorder:
            for frame in frames:
                recorder.write_frame(frame)
        if recorder.error is not None:
            raise OSError(recorder.error)
        if not recorder.frames:
            raise ValueError(f"{path}: there is no frame to write")
    return recorder.frames


def _definition(kind: str) -> str:
    return _TYPES.generate_msgdef(kind, ros_version=2)[0]


def _messages(frame: Frame, config: RecordConfig) -> Iterator[_Raw]:
    """The messages of one frame, its colour last: a reader then has all that belongs to it."""
    for topic, kind, message in _typed(frame, config):
        yield _Raw(topic, kind, _definition(kind), bytes(_TYPES.serialize_cdr(message, kind)), frame.stamp_ns)


def _typed(frame: Frame, config: RecordConfig) -> Iterator[tuple[str, str, Any]]:
    """(topic, message type, message) of one frame."""
    types = _TYPES.types
    time_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    stamp = time_type(*divmod(frame.stamp_ns, 1_000_000_000))
    header = header_type(stamp, frame.frame_id)

    def image(plane: Shaped[np.ndarray, "h w *c"], encoding: str) -> Any:
        plane = np.ascontiguousarray(plane)
        return types[_IMAGE](header, *plane.shape[:2], encoding, 0, plane.strides[0], plane.view(np.uint8).ravel())

    camera = frame.camera
    P = np.column_stack([camera.K, np.zeros(3)]).ravel()
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    size = (camera.height, camera.width)
    info = (camera.model, camera.distortion, camera.K.ravel(), np.eye(3).ravel(), P, 0, 0, roi)
    yield _INFO_OUT, _INFO, types[_INFO](header, *size, *info)
    if frame.T_world_camera is not None:
        T = np.asarray(frame.T_world_camera, np.float64)
        point = types["geometry_msgs/msg/Point"](*T[:3, 3].tolist())
        turn = types["geometry_msgs/msg/Quaternion"](*Rotation.from_matrix(T[:3, :3]).as_quat().tolist())
        yield POSE_TOPIC, _POSE, types[_POSE](header_type(stamp, "world"), types["geometry_msgs/msg/Pose"](point, turn))
    if frame.depth is not None:
        yield _DEPTH_OUT, _IMAGE, image(*_depth(frame.depth, config))
    if frame.label is not None:
        dtype, encoding = (np.uint8, "mono8") if frame.label.max() < 256 else (np.uint16, "16UC1")
        yield _LABEL_OUT, _IMAGE, image(frame.label.astype(dtype), encoding)
    if config.colour == "raw":
        yield _COLOUR_OUT, _IMAGE, image(frame.rgb, "rgb8")
        return
    options = [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality] if config.colour == "jpeg" else []
    data = cv2.imencode(f".{config.colour}", cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR), options)[1].ravel()
    form = f"rgb8; {config.colour} compressed bgr8"
    yield f"{_COLOUR_OUT}/compressed", _COMPRESSED, types[_COMPRESSED](header, form, data)


def _depth(depth: Float32[np.ndarray, "h w"], config: RecordConfig) -> tuple[Shaped[np.ndarray, "h w"], str]:
    """The samples and their encoding."""
    known = np.where(np.isnan(depth), np.float32(0.0), depth)
    counts = np.minimum(known * np.float32(1000.0) + np.float32(0.5), np.float32(SATURATED)).astype(np.uint16)
    counts = known_counts(counts)  # in counts, depth beyond 65.5 m is unknown
    if config.depth == "exact":
        return (counts, "16UC1") if np.array_equal(counts * MM, known) else (depth, "32FC1")
    return counts, "16UC1"
