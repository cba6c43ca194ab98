"""Messages of ROS 2 as on the wire: types and their hashes, CDR, and Hypotheses to a message and back.

The types of `launch/farside_msgs` are registered from those very files, so that this node and a ROS 2 workspace that
builds them cannot differ. A message is an object with its fields by name; arrays of numbers are NumPy arrays. Poses are
geometry_msgs: metres and unit quaternions.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, Shaped
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from foundation.one_line import one_line
from node.ros.foreign_types import MESSAGES, SERVICES
from perception.answers.diagnostics import AnswerDiagnostics
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from perception.sources.bounded_reading import MOST_PARTS, CountingStore
from perception.sources.frame import Frame
from probnerf.types import StopReason

_HERE = Path(__file__).resolve()
# Installed they lie inside this package, in a checkout where a ROS workspace takes them from.
_PLACES = (_HERE.parents[1] / "farside_msgs", _HERE.parents[2] / "launch" / "farside_msgs")
FOLDER = next((folder for folder in _PLACES if folder.is_dir()), _PLACES[0])
HYPOTHESES = "farside_msgs/msg/ShapeHypotheses"
QUERY_REGION = "farside_msgs/srv/QueryRegion"
NEXT_VIEW = "farside_msgs/srv/NextView"
EVENT = """service_msgs/ServiceEventInfo info
{name}_Request[<=1] request
{name}_Response[<=1] response
"""


@cache
def types() -> Typestore:
    """All types of ROS 2 Jazzy, of farside_msgs, and of `foreign_types`.

    Raises FileNotFoundError if the definitions are absent.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    store.fielddefs = _mended(store.fielddefs)
    if not (FOLDER / "package.xml").is_file():
        raise FileNotFoundError(f"{FOLDER} is missing; install Farside again")
    for path in sorted(FOLDER.glob("msg/*.msg")):
        _register(store, f"{FOLDER.name}/msg/{path.stem}", path.read_text(encoding="utf-8"))
    for name, text in MESSAGES.items():
        _register(store, name, text)
    for name, text in SERVICES.items():
        register_service(name, text, store)
    for path in sorted(FOLDER.glob("srv/*.srv")):
        register_service(f"{FOLDER.name}/srv/{path.stem}", path.read_text(encoding="utf-8"), store)
    return store


def _mended(definitions: Any) -> Any:
    """Field definitions as ROS 2 has them.

    ROS 2 writes `char`, means uint8, and hashes it so; rosbags 0.11 keeps them as different types. Also, rosbags puts
    the parts of a service under srv/msg.
    """
    match definitions:
        case dict():
            return {
                _mended(name): (c, [(f, _mended(d)) for f, d in fields]) for name, (c, fields) in definitions.items()
            }
        case (Nodetype.BASE, ("char", 0)):
            return (Nodetype.BASE, ("uint8", 0))
        case (Nodetype.ARRAY | Nodetype.SEQUENCE as kind, (inner, count)):
            return (kind, (_mended(inner), count))
        case (Nodetype.NAME, str(name)):
            return (Nodetype.NAME, _mended(name))
        case str(name):
            return name.replace("/srv/msg/", "/srv/")
    return definitions


def _register(store: Typestore, name: str, text: str) -> None:
    store.register(_mended(get_types_from_msg(text, name)))


def register_service(name: str, text: str, store: Typestore | None = None) -> None:
    """Register a service by the text of its .srv. `name` is, for example, example_interfaces/srv/AddTwoInts."""
    store = store or types()
    request, _, response = ("\n" + text).partition("\n---")
    _register(store, f"{name}_Request", request)
    _register(store, f"{name}_Response", response)
    _register(store, f"{name}_Event", EVENT.format(name=name))
    parts = (("request", "Request"), ("response", "Response"), ("event", "Event"))
    _register(store, name, "".join(f"{name}_{kind} {field}_message\n" for field, kind in parts))


def type_hash(kind: str) -> str:
    """The RIHS01 hash of a message or service type. Raises ValueError for an unknown one."""
    _fields(kind)
    return types().hash_rihs01(kind)


def definition(kind: str) -> str:
    """The text of a type and of all that it is made of, as a recording keeps it."""
    return types().generate_msgdef(kind, ros_version=2)[0]


def make(kind: str, /, **fields: Any) -> Any:
    """A message of a type. Omitted fields are zero, empty or false. Raises ValueError for a field that it lacks."""
    defaults = {name: _default(description) for name, description in _fields(kind)}
    if strange := set(fields) - set(defaults):
        raise ValueError(f"{kind} has no field {', '.join(sorted(strange))}; it has {', '.join(defaults)}")
    return types().types[kind](**(defaults | fields))


def _fields(kind: str) -> Any:
    if kind not in types().fielddefs:
        raise ValueError(f"the type {kind!r} is unknown; give a ROS 2 type such as sensor_msgs/msg/Image")
    return types().fielddefs[kind][1]


def _default(description: Any) -> Any:
    kind, inner = description
    if kind == Nodetype.BASE:
        return {"string": "", "bool": False}.get(inner[0], 0.0 if inner[0].startswith("float") else 0)
    if kind == Nodetype.NAME:
        return make(inner)
    (of, name), count = inner
    number = of == Nodetype.BASE and name[0] != "string"
    if number:
        return np.zeros(count if kind == Nodetype.ARRAY else 0, _DTYPES.get(name[0], name[0]))
    return [_default((of, name)) for _ in range(count if kind == Nodetype.ARRAY else 0)]


_DTYPES = {"byte": "uint8", "octet": "uint8"}


def encode(message: Any) -> bytearray:
    """The CDR bytes of a message. Raises ValueError if a field does not fit its type."""
    kind = message.__msgtype__
    try:
        data: bytearray = types().serialize_cdr(message, kind, little_endian=True).obj  # type: ignore[assignment]
    except Exception as error:  # generated code raises various types for a wrong field
        raise ValueError(f"{kind} cannot be written: {type(error).__name__}: {error}") from None
    if len(data) == 4:
        data.append(0)  # an empty message has one byte
    return data


def decode(data: bytes, kind: str, most_parts: int = MOST_PARTS) -> Any:
    """The message in CDR bytes. Raises ValueError if they are no message of this type, or one of too many parts."""
    try:
        message: Any = CountingStore(types(), most_parts, "parts (max_parts)").deserialize_cdr(data, kind)
    except (SerdeError, IndexError, OverflowError, MemoryError, AssertionError) as error:
        raise ValueError(f"{len(data)} bytes are no {kind}: {one_line(error)}") from None
    # rosbags takes a text that is cut short for a shorter text; written again, it would be longer than what came.
    if 4 + types().get_msgdef(kind).getsize_cdr(0, message, types()) > max(len(data), 5):
        raise ValueError(f"{len(data)} bytes are no {kind}: they are cut short")
    return message


def time_message(ns: int) -> Any:
    """A stamp in ns as builtin_interfaces/Time. Raises ValueError before 1970 or beyond 2106."""
    sec, nanosec = divmod(ns, 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame_id: str) -> Any:
    """A std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time_message(stamp_ns), frame_id=frame_id)


def pose(T: Float[np.ndarray, "4 4"]) -> Any:
    """A rigid transform as geometry_msgs/Pose."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", **dict(zip("xyz", T[:3, 3].tolist(), strict=True))),
        orientation=make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w)),
    )


def matrix(message: Any) -> Float[np.ndarray, "4 4"]:
    """The rigid transform of a geometry_msgs/Pose. Raises ValueError if its quaternion is invalid."""
    p, q = message.position, message.orientation
    values = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], np.float64)
    if not np.isfinite(values).all() or abs(math.hypot(*values[3:]) - 1.0) > 1e-3:
        raise ValueError(f"the pose {values.tolist()} is not finite with a quaternion (x y z w) of length 1")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def image_message(stamp_ns: int, frame_id: str, pixels: Shaped[np.ndarray, "h w *c"], encoding: str) -> Any:
    """Pixels as sensor_msgs/Image; `encoding` is ROS's name of their kind, such as rgb8 or 32FC1."""
    rows = np.ascontiguousarray(pixels)
    return make(
        "sensor_msgs/msg/Image",
        header=header(stamp_ns, frame_id),
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=encoding,
        step=rows.strides[0],
        data=rows.view(np.uint8).ravel(),
    )


def frame_messages(frame: Frame) -> dict[str, Any]:
    """A frame's messages by topic, as a camera driver sends them; `TopicSource` turns them back into the same frame.

    T_world_camera and labels are left out: a camera does not send them.
    """
    camera, stamp = frame.camera, (frame.stamp_ns, frame.frame_id)
    info = make(
        "sensor_msgs/msg/CameraInfo",
        header=header(*stamp),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        d=camera.distortion,
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
    )
    messages = {"color/camera_info": info, "color/image_raw": image_message(*stamp, frame.rgb, "rgb8")}
    if frame.depth is not None:
        messages["depth/image_raw"] = image_message(*stamp, frame.depth, "32FC1")
    return messages


def _numbers(values: Num[np.ndarray, "..."], dtype: str) -> Num[np.ndarray, "n"]:
    return np.ascontiguousarray(values, dtype).ravel()


def hypotheses_message(h: Hypotheses, method: str = "") -> Any:
    """Hypotheses as farside_msgs/ShapeHypotheses, complete: `hypotheses_from` gives them back."""
    frame, known, numbers = h.object_frame, h.T_world_camera is not None, h.diagnostics.as_mapping()
    return make(
        HYPOTHESES,
        header=header(h.stamp_ns, h.frame_id),
        object_id=int(h.object_id),
        label=h.label,
        pose=pose(frame.T_camera_object),
        half_extent=float(frame.half_extent),
        plane=_numbers(frame.plane, "float64"),
        xy_sigma=float(frame.xy_sigma),
        log_scale_sigma=float(frame.log_scale_sigma),
        along_sigma=float(frame.along_sigma),
        sight_sigma=float(frame.sight_sigma),
        camera_in_world_known=known,
        camera_in_world=pose(h.T_world_camera if h.T_world_camera is not None else np.eye(4)),
        grid=h.grid,
        weights=_numbers(h.weights, "float64"),
        populations=_numbers(h.population, "int32"),
        poses=_numbers(h.pose, "float32"),
        opacity=_numbers(h.opacity, "uint8"),
        seen_bits=np.packbits(h.seen),
        method=method,
        stage=int(h.stage),
        result=h.result,
        monte_carlo_error=float(h.monte_carlo_error),
        explained=float(h.diagnostics.explained),
        out_of_model=bool(h.out_of_model),
        inside_view=bool(h.inside_view),
        seed=int(h.seed),
        prior_hash=h.prior_hash,
        kind_names=list(h.kinds),
        kind_probabilities=np.array(list(h.kinds.values()), np.float64),
        diagnostic_names=list(numbers),
        diagnostic_values=np.array(list(numbers.values()), np.float64),
    )


def hypotheses_from(message: Any) -> Hypotheses:
    """The Hypotheses of a farside_msgs/ShapeHypotheses. Raises ValueError if its parts do not fit each other."""
    m, count, grid = message, len(message.weights), int(message.grid)
    sizes = {"opacity": count * grid**3, "poses": 5 * count, "populations": count, "seen_bits": -(-(grid**3) // 8)}
    for name, want in sizes.items():
        if len(getattr(m, name)) != want:
            raise ValueError(
                f"{name} has {len(getattr(m, name))} entries; {count} hypotheses of {grid} voxels a side need {want}"
            )
    diagnostics = _named(m, "diagnostic_names", "diagnostic_values")
    kinds = _named(m, "kind_names", "kind_probabilities")
    return Hypotheses(
        stamp_ns=m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec,
        frame_id=m.header.frame_id,
        object_id=m.object_id,
        label=m.label,
        object_frame=ObjectFrame(
            T_camera_object=matrix(m.pose),
            half_extent=m.half_extent,
            plane=np.asarray(m.plane),
            xy_sigma=m.xy_sigma,
            log_scale_sigma=m.log_scale_sigma,
            along_sigma=m.along_sigma,
            sight_sigma=m.sight_sigma,
        ),
        T_world_camera=matrix(m.camera_in_world) if m.camera_in_world_known else None,
        opacity=np.asarray(m.opacity, np.uint8).reshape(count, grid, grid, grid),
        pose=np.asarray(m.poses, np.float32).reshape(count, 5),
        weights=np.asarray(m.weights),
        population=np.asarray(m.populations),
        seen=np.unpackbits(np.asarray(m.seen_bits, np.uint8), count=grid**3).reshape(grid, grid, grid).astype(bool),
        inside_view=m.inside_view,
        out_of_model=m.out_of_model,
        stage=m.stage,
        monte_carlo_error=m.monte_carlo_error,
        prior_hash=m.prior_hash,
        seed=m.seed,
        diagnostics=AnswerDiagnostics.from_mapping(diagnostics),
        result=StopReason(m.result),
        kinds=kinds,
    )


def _named(message: Any, names: str, values: str) -> dict[str, float]:
    """Two of its arrays as a mapping. Raises ValueError where one is longer."""
    keys, numbers = getattr(message, names), np.asarray(getattr(message, values)).tolist()
    if len(keys) != len(numbers):
        raise ValueError(f"there are {len(keys)} {names} but {len(numbers)} {values}")
    return dict(zip(keys, numbers, strict=True))
