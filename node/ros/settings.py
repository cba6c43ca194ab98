"""Settings of the bus (endpoints, admitted certificates, Zenoh's configuration) and of a camera's topics."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from perception.sources.topic_names import named_otherwise

_NODE = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_SPACE = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
# What an admitted certificate allows: everything that ROS 2 nodes do, on this domain only.
_MESSAGES = ["put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"]
_GRAPH = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]


@dataclass(frozen=True)
class BusConfig:
    """Where the bus listens, and which clients it admits."""

    domain_id: int = 0
    namespace: str = "/"
    name: str = "farside"
    mode: Literal["peer", "client"] = "peer"  # client: all traffic goes through the router at `connect`
    listen: tuple[str, ...] = ("tcp/127.0.0.1:0",)  # protocol/address:port; port 0: any; tls/... needs the files below
    connect: tuple[str, ...] = ()  # e.g. tcp/127.0.0.1:7447, the ROS 2 router on this machine
    tls_ca: Path | None = None  # certificate authority of both sides' certificates (mutual TLS)
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    allowed: tuple[str, ...] = ()  # common names of admitted certificates; empty: all that TLS admits
    max_message_bytes: int = 64_000_000
    max_request_bytes: int = 4_000_000  # of a service's request
    max_parts: int = 100_000  # of a message or request: the messages within it, such as detections and their boxes
    max_rate: float = 200.0  # messages per second of each topic, and of each sender on a topic or service
    use_sim_time: bool = False  # ages and diagnostics are by the time on /clock, of a simulation or a recording

    def __post_init__(self) -> None:
        if not 0 <= self.domain_id <= 232:
            raise ValueError(f"domain_id is {self.domain_id}; give 0 to 232")
        if min(self.max_message_bytes, self.max_request_bytes, self.max_parts) < 1 or not self.max_rate > 0:
            raise ValueError("max_message_bytes, max_request_bytes, max_parts and max_rate must be greater than 0")
        if not _NODE.fullmatch(self.name):
            raise ValueError(
                f"name is {self.name!r}; use letters, digits and _ (its namespace is a setting of its own)"
            )
        if self.namespace != "/" and not _SPACE.fullmatch(self.namespace):
            raise ValueError(
                f"namespace is {self.namespace!r}; give / or parts of letters, digits and _, each after a /"
            )
        for endpoint in (*self.listen, *self.connect):
            protocol, slash, address = endpoint.partition("/")
            if not slash or protocol not in ("tcp", "tls") or not address.rpartition(":")[2].isdigit():
                raise ValueError(f"endpoint {endpoint!r} is not tcp/address:port or tls/address:port")
        files = {"tls_ca": self.tls_ca, "tls_certificate": self.tls_certificate, "tls_key": self.tls_key}
        encrypted = [e.startswith("tls/") for e in (*self.listen, *self.connect)]
        if any(encrypted) and (missing := [name for name, path in files.items() if path is None]):
            raise ValueError(f"a tls endpoint needs {', '.join(files)}; {missing[0]} is missing")
        if self.allowed and not all(encrypted):
            raise ValueError("allowed names certificates, so every endpoint must be tls/...; a tcp one shows none")
        if self.mode == "client" and not self.connect:
            raise ValueError("mode client needs connect: the router's endpoint, such as tcp/192.0.2.1:7447")

    def settings(self) -> dict[str, Any]:
        """Zenoh's configuration. Raises FileNotFoundError for a certificate that is not there."""
        for path in (self.tls_ca, self.tls_certificate, self.tls_key):
            if path is not None and not path.is_file():
                raise FileNotFoundError(f"{path}: no such file; give the certificate or key of the bus")
        settings: dict[str, Any] = {
            "mode": self.mode,
            "listen": {"endpoints": list(self.listen) if self.mode == "peer" else []},
            "connect": {"endpoints": list(self.connect)},
            # No multicast scouting. Connected nodes announce the others (gossip), as ROS 2 nodes do.
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
            "timestamping": {"enabled": True},  # which late joiners need
            # What is above the limit is received and counted, up to 4 times it; above that nothing can be said of it.
            "transport": {"link": {"rx": {"max_message_size": 4 * self.max_message_bytes + (1 << 20)}}},
        }
        if self.tls_key is not None:
            certificate, own_key = str(self.tls_certificate), str(self.tls_key)
            settings["transport"]["link"]["tls"] = {
                "root_ca_certificate": str(self.tls_ca),
                "enable_mtls": True,
                "listen_certificate": certificate,
                "listen_private_key": own_key,
                "connect_certificate": certificate,
                "connect_private_key": own_key,
            }
        if self.allowed:
            # `**` does not match what begins with @: tokens of the graph, and those of latched topics.
            keys = [f"{self.domain_id}/**", f"{self.domain_id}/**/@adv/**", f"@ros2_lv/{self.domain_id}/**"]
            rule = {"id": "ros", "permission": "allow", "flows": ["ingress", "egress"]}
            settings["access_control"] = {
                "enabled": True,
                "default_permission": "deny",
                "rules": [rule | {"messages": _MESSAGES + _GRAPH, "key_exprs": keys}],
                "subjects": [{"id": "allowed", "cert_common_names": list(self.allowed)}],
                "policies": [{"rules": ["ros"], "subjects": ["allowed"]}],
            }
        return settings


@dataclass(frozen=True)
class TopicConfig:
    """Where a camera driver publishes. A colour topic whose name ends in /compressed carries CompressedImage."""

    colour: str = "/camera/color/image_raw"
    depth: str | None = "/camera/aligned_depth_to_color/image_raw"  # aligned to colour; None: frames without depth
    info: str = "/camera/color/camera_info"
    detections: str | None = None  # vision_msgs/Detection2DArray of a detector: what is in its boxes is inferred, alone
    least_score: float = 0.3  # of a detection
    rectified: bool | None = None  # images are rectified: the info's P, no distortion; None: rectified if
    # the colour topic's name has a part rect or rectified
    aligned: bool = False  # depth is aligned to colour although its frame_id differs
    tolerance_ms: float = 10.0  # largest difference between the stamps of colour and depth
    silence_s: float = 2.0  # without a frame, after which a note is printed
    end_s: float | None = None  # without a frame, after which the source ends; None: never
    waiting: int = 10  # colour images that may wait for their depth

    def __post_init__(self) -> None:
        if not (self.tolerance_ms >= 0 and self.silence_s > 0 and self.waiting >= 1):
            raise ValueError("tolerance_ms must not be negative, silence_s be positive, and waiting be 1 or more")
        if not 0.0 <= self.least_score <= 1.0:
            raise ValueError(f"topic: least_score is {self.least_score:g}; give 0 to 1")
        if self.depth is not None and (word := named_otherwise(self.depth)):
            raise ValueError(f"topic: depth is {self.depth}, whose name says {word}; give the camera's depth image")


@dataclass(frozen=True)
class PlannerConfig:
    """What planners get: MoveIt's planning scene, an octomap, and signed distances as nvblox serves them."""

    risk: float = 0.05  # space counts as occupied where its probability of being occupied is above this
    scene: str = "~/planning_scene"  # topic of the differences; MoveIt takes those on /planning_scene by itself
    mesh_grid: int = 32  # voxels per axis of an object's mesh, at most; fewer are wider, and checked faster
    octomap_m: float = 0.005  # edge of a voxel of the octomap
    scene_octomap: bool = False  # the scene has the octomap, too, in place of one that MoveIt itself made
    distance_m: float = 0.01  # edge of a voxel of the distances
    farthest_m: float = 2.0  # distances end here
    unknown_m: float = -1000.0  # distance where nothing was inferred, as nvblox has it; 1000: such space is free

    def __post_init__(self) -> None:
        if not 0.0 < self.risk < 1.0:
            raise ValueError(f"planner: risk is {self.risk:g}; give a probability above 0 and below 1")
        if self.mesh_grid < 4 or not min(self.octomap_m, self.distance_m, self.farthest_m) >= 1e-4:
            raise ValueError(
                "planner: mesh_grid must be 4 or more, octomap_m, distance_m and farthest_m 0.1 mm or more"
            )
