"""How `rmw_zenoh_cpp` names things on Zenoh: keys, liveliness tokens, and the attachment of each sample. Text only."""

import re
import struct
from dataclasses import dataclass

import xxhash

_NAME = re.compile(r"(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_ATTACHMENT = struct.Struct("<qqB16s")
_PARTNERS = {"MP": "MS", "MS": "MP", "SS": "SC", "SC": "SS"}
_NO_HASH = "TypeHashNotSupported"
_DEFAULT_DEPTH = 42  # of rmw_zenoh_cpp's default quality of service, which is left out


@dataclass(frozen=True)
class RosNode:
    """A node's name and its Zenoh session."""

    domain: int
    zid: str  # of the session
    namespace: str  # "/" or "/a/b"
    name: str

    def resolve(self, name: str) -> str:
        """The full name of ~/name (the node's own), name (the namespace's) or /name. Raises ValueError for no name."""
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no ROS name; use letters, digits and _, parts separated by /")
        space = self.namespace.rstrip("/")
        if name.startswith("/"):
            return name
        return f"{space}/{self.name}/{name[2:]}" if name.startswith("~/") else f"{space}/{name}"

    def token(self, entity: int, code: str, topic: str = "", kind: str = "", type_hash: str = "", qos: str = "") -> str:
        """The liveliness token of the node (code NN), or its publisher MP, subscriber MS, service SS or client SC."""
        who = [_mangled(self.namespace), self.name]
        what = [_mangled(topic), type_name(kind), type_hash, qos] if topic else []
        return "/".join(["@ros2_lv", str(self.domain), self.zid, "0", str(entity), code, "%", *who, *what])


@dataclass(frozen=True)
class Entity:
    """What a liveliness token says of a publisher, subscriber, service or client."""

    zid: str
    code: str
    node: str  # full name
    topic: str
    kind: str  # as type_name gives it
    type_hash: str

    @property
    def meets(self) -> tuple[str, str, str]:
        """Whom it exchanges messages with, if their hash is the same: their code, topic and type."""
        return _PARTNERS[self.code], self.topic, self.kind


def entity(token: str) -> Entity | None:
    """The entity of a token; None for that of a node, and for what is no token."""
    parts = token.split("/")
    if len(parts) < 13 or parts[5] not in _PARTNERS:
        return None
    space, node, topic = (part.replace("%", "/") for part in parts[7:10])
    return Entity(parts[2], parts[5], f"{space.rstrip('/')}/{node}", topic, parts[10], parts[11])


def why_apart(mine: Entity, other: Entity) -> str | None:
    """Why two entities do not hear each other although topic and type are the same. None: they do, or never would."""
    if mine.meets != (other.code, other.topic, other.kind) or mine.type_hash == other.type_hash:
        return None
    who, kind = f"node {other.node}", mine.kind.replace("::dds_::", "::").replace("::", "/").removesuffix("_")
    if other.type_hash == _NO_HASH:
        return (
            f"{who} has no hash of {kind}, as nodes of ROS 2 Humble, and neither hears the other;"
            " run it on ROS 2 Jazzy or newer"
        )
    return (
        f"{who} has another definition of {kind} ({other.type_hash[:15]}, here {mine.type_hash[:15]}), and neither"
        " hears the other; build both with the same version of the package"
    )


def key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """The key of a topic or service; `name` is a full one."""
    return f"{domain}/{name.strip('/')}/{type_name(kind)}/{type_hash}"


def type_name(kind: str) -> str:
    """sensor_msgs/msg/Image as sensor_msgs::msg::dds_::Image_."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def quality(depth: int, latched: bool = False) -> str:
    """Quality of service in a token: reliable, the last `depth` samples, kept for late joiners if `latched`."""
    return f":{1 if latched else ''}:,{'' if depth == _DEFAULT_DEPTH else depth}:,:,:,,"


def gid(token: str) -> bytes:
    """The 16 bytes that stand for the entity of a token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, time_ns: int, source: bytes) -> bytes:
    """What travels beside a sample: its number, when it was sent, and the gid of who sent it."""
    return _ATTACHMENT.pack(sequence, time_ns, 16, source)


def read_attachment(data: bytes) -> tuple[int, int, bytes]:
    """(sequence, time in ns, gid). Raises ValueError if the bytes are no attachment."""
    if len(data) != _ATTACHMENT.size or data[16] != 16:
        raise ValueError(f"the attachment has {len(data)} bytes; rmw_zenoh_cpp sends {_ATTACHMENT.size}")
    sequence, time_ns, _, source = _ATTACHMENT.unpack(data)
    return sequence, time_ns, source


def _mangled(name: str) -> str:
    return name.replace("/", "%")
