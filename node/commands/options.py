"""Options of the commands, which are also the keys of their configuration files."""

from dataclasses import dataclass, field
from pathlib import Path

from node.ros.settings import BusConfig, TopicConfig
from perception.inference.settings import ControllerConfig, TrackConfig
from perception.observation.settings import SegmentConfig
from perception.sources.settings import RecordConfig

ENDPOINT = "tcp/127.0.0.1:7448"  # the router of ROS 2 has 7447


@dataclass(frozen=True)
class LiveConfig:
    """Keys of a configuration file such as launch/live.yaml; the command's options have the same names."""

    source: str = "oak"  # oak, oak:ID, webcam:N, topic (a camera driver on the bus), a recording, a video, ...
    camera: Path | None = None  # calibration of the colour image
    colour_topic: str | None = None  # of a recording; None: found by type and name
    depth_topic: str | None = None  # of a recording; taken as aligned to colour
    record: Path | None = None  # new MCAP file
    budget: float = 40.0  # s of sampling for each object of a frame; what has not converged goes on with the next
    pace: float = 1.0  # of a recording
    seconds: float | None = None  # until it ends by itself
    page: int | None = None  # port of the page on this machine; None: no page
    token: bool = False  # in the page's address, a random one
    seed: int = 0
    prior: Path | None = None
    bus: BusConfig = field(default_factory=lambda: BusConfig(listen=(ENDPOINT,)))
    topic: TopicConfig = field(default_factory=TopicConfig)
    recording: RecordConfig = field(default_factory=RecordConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    track: TrackConfig = field(default_factory=TrackConfig)

    def __post_init__(self) -> None:
        if self.token and self.page is None:
            raise ValueError("a token is in the page's address; give the page's port, too")
        if not self.budget > 0:
            raise ValueError(f"the budget is {self.budget:g} s; give more than 0")
        if self.seconds is not None and not self.seconds > 0:
            raise ValueError(f"seconds is {self.seconds:g}; give more than 0")
        if not 0 <= self.seed < 1 << 32:
            raise ValueError(f"the seed is {self.seed}; give 0 to {(1 << 32) - 1}")
