"""Options of the commands: one dataclass each, whose field docstrings are the help.

`ReplayConfig` and `LiveConfig` are also what a configuration file fills: an option's name is a key of the file. Only
modules that import neither JAX nor OpenCV are imported here, so that help and mistyped options answer at once.
"""

from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, arg

from calibration.turntable import TurntableConfig
from node.ros.settings import BusConfig, PlannerConfig, TopicConfig
from perception.inference.settings import ControllerConfig, TrackConfig
from perception.observation.settings import SegmentConfig
from perception.sources.settings import SHIPPED_LOG, OakConfig, RecordConfig
from perception.sources.topic_names import TopicNames
from probnerf.settings import Method

ENDPOINT = "tcp/127.0.0.1:7448"  # the router of ROS 2 has 7447


@dataclass(frozen=True)
class FrameOptions:
    """One frame of a source, and how its objects are found."""

    source: Annotated[
        Positional[Path | None],
        arg(metavar="[SOURCE]", help_behavior_hint="(default: the recording that ships with the project)"),
    ] = None
    """Frame folder (color.png, depth.png, meta.json), frame in one file (.npz: rgb, depth, K) or recording (.mcap,
    .db3, .bag, ROS 2 bag folder)."""
    object: Annotated[int | None, arg(metavar="ID", help_behavior_hint="(default: all)")] = None
    """The one object to take: its id in the label map. Without a label map: 1, 2, ... from the largest."""
    frame: Annotated[int, arg(metavar="K")] = 0
    """Which frame of a recording (of its range, with --from and --to), from 0; -1 is the last."""
    start_s: Annotated[float, arg(name="from", metavar="SECONDS")] = 0.0
    """Skip a recording's frames before this time after its first one."""
    end_s: Annotated[float | None, arg(name="to", metavar="SECONDS", help_behavior_hint="(default: the end)")] = None
    """Skip a recording's frames after this time after its first one."""
    camera: Annotated[
        Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: the intrinsics in the source)")
    ] = None
    """Colour camera in place of the recorded one: `farside calibrate`'s, ROS's or Kalibr's file (FILE.yaml#cam1)."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Colour image of a recording that has several."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Depth image of a recording; needed where its name does not say depth, or its frame_id is not colour's."""
    masks: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the source's label map)")] = None
    """Label map of an instance segmenter: .png or .npy of ids, or .npy or .npz of masks (n x height x width)."""
    box: Annotated[
        tuple[int, int, int, int] | None, arg(metavar="X0 Y0 X1 Y1", help_behavior_hint="(default: none)")
    ] = None
    """A box around one whole object, px; X1 and Y1 are the first column and row beyond it."""
    plane: Annotated[
        tuple[float, float, float, float] | None, arg(metavar="A B C D", help_behavior_hint="(default: found)")
    ] = None
    """The plane that things stand on: A x + B y + C z + D = 0 in the camera's frame (x right, y down, z forward; m)."""
    colour_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Ignore depth. The camera's height and tilt are then needed: see `segment` in launch/replay.yaml."""
    segment: SegmentConfig = field(default_factory=SegmentConfig)

    @property
    def topics(self) -> TopicNames:
        """The chosen topics of the recording."""
        return TopicNames(self.colour_topic, self.depth_topic)

    @property
    def segmentation(self) -> SegmentConfig:
        """How objects are found, with the chosen box and plane. Raises `ValueError` for a plane that is none."""
        mask = self.segment.mask if self.box is None else replace(self.segment.mask, box_px=self.box)
        plane = self.segment.plane if self.plane is None else replace(self.segment.plane, given=self.plane)
        return replace(self.segment, mask=mask, plane=plane)

    @property
    def folder(self) -> Path:
        """Where the results go by default."""
        source = self.source or SHIPPED_LOG
        return Path("out") / (source.stem if source.is_file() else source.resolve().name)


@dataclass(frozen=True)
class Segmenting(FrameOptions):
    """Draw and number the objects in one view, before anything is inferred, and write their label map."""

    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: out/<name of the source>)")] = None
    """Folder for segments.png (the picture) and label.png (ids: to correct, and to give back with --masks)."""

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self.out or super().folder


@dataclass(frozen=True)
class ReplayConfig(FrameOptions):
    """Infer whole-shape hypotheses for the objects in one recorded view; write a file and a picture for each."""

    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: out/<name of the source>)")] = None
    """Folder for object_<id>.npz and object_<id>.png, and for the frame itself (frame/)."""
    budget: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint="(default: 90; with --stages: no limit)")
    ] = None
    """Time for the whole job, shared by its objects."""
    stages: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: until it has converged)")] = None
    """Stop the sampler after N stages. Without a budget, the same input, seed and N give the same file."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""
    method: Annotated[
        Method | None,
        arg(metavar="{tempered_smc,annealed_hmc}", help_behavior_hint="(default: tempered_smc)"),
    ] = None
    """Sampler: weighted tempered populations, or the annealed chains of the ProbNeRF paper."""
    schedule: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Repeat the inferences in a recording's schedule, which gives their frames, stages and seeds."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped one)")] = None
    """Weights of another prior (.safetensors, as `farside train` writes them)."""
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    track: TrackConfig = field(default_factory=TrackConfig)  # of a schedule

    def __post_init__(self) -> None:
        if self.budget is not None and not self.budget > 0:
            raise ValueError(f"the budget is {self.budget:g} s; give more than 0")
        if self.stages is not None and self.stages < 1:
            raise ValueError(f"stages is {self.stages}; give 1 or more")
        if not 0 <= self.seed < 1 << 32:
            raise ValueError(f"the seed is {self.seed}; give 0 to {(1 << 32) - 1}")

    @property
    def inference(self) -> ControllerConfig:
        """The controller's configuration with the chosen method."""
        if self.method is None:
            return self.controller
        return replace(self.controller, infer=replace(self.controller.infer, method=self.method))

    @property
    def folder(self) -> Path:
        """Where the results go."""
        return self.out or super().folder


@dataclass(frozen=True)
class LiveConfig:
    """Infer from a camera until Ctrl-C: answer on the bus, show a page, record. Objects are tracked."""

    source: Annotated[Positional[str], arg(metavar="[SOURCE]")] = "oak"
    """oak, oak:ID, webcam:N, topic (a ROS 2 camera driver on the bus), or a recording, which is played back."""
    camera: Annotated[
        Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: the source's own intrinsics)")
    ] = None
    """Colour camera's calibration: `farside calibrate`'s, ROS's or Kalibr's file (FILE.yaml#cam1)."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Colour image of a recording that has several."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Depth image of a recording; needed where its name does not say depth, or its frame_id is not colour's."""
    hand_eye: Annotated[Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: the robot's /tf)")] = None
    """Where the camera is on the robot, as `farside hand-eye` writes it: published on /tf_static, so that questions may
    be asked in the robot's frames."""
    record: Annotated[Path | None, arg(metavar="FILE.mcap", help_behavior_hint="(default: no recording)")] = None
    """Record every frame, the hypotheses and their schedule to a new file; `farside replay --schedule` repeats it."""
    page: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="(default: no page)")] = None
    """Show a 3D page on this port of this machine; 0 takes a free one."""
    token: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put a random token into the page's address: nobody else on this machine can open it."""
    budget: Annotated[float, arg(metavar="SECONDS")] = 40.0
    """Time for each object of a frame, shared as each has need. What has not converged goes on with the next
    frame."""
    pace: Annotated[float, arg(metavar="X")] = 1.0
    """Speed of a recording: 1 as it was made, 2 twice as fast, 0 as fast as it can be read."""
    seconds: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: until Ctrl-C)")] = None
    """Stop after this time."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped one)")] = None
    """Weights of another prior."""
    bus: BusConfig = field(default_factory=lambda: BusConfig(listen=(ENDPOINT,)))
    oak: OakConfig = field(default_factory=OakConfig)
    topic: TopicConfig = field(default_factory=TopicConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
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


@dataclass(frozen=True)
class Record:
    """Record frames of any source to an MCAP file, until Ctrl-C, the source's end, or --seconds."""

    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """Any source that `farside replay` reads."""
    out: Annotated[Path, arg(metavar="FILE.mcap")]
    """The recording, a new file."""
    seconds: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: no limit)")] = None
    """Time to record, by the stamps of the frames."""
    start_s: Annotated[float, arg(name="from", metavar="SECONDS")] = 0.0
    """Of a recording: skip frames before this time after its first one."""
    end_s: Annotated[float | None, arg(name="to", metavar="SECONDS", help_behavior_hint="(default: the end)")] = None
    """Of a recording: skip frames after this time after its first one."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Colour image of a recording that has several."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Depth image of a recording; needed where its name does not say depth, or its frame_id is not colour's."""
    recording: tyro.conf.OmitArgPrefixes[RecordConfig] = field(default_factory=RecordConfig)


@dataclass(frozen=True)
class Query:
    """Ask how likely a box, some points or a mesh are free, jointly over all hypotheses (and objects, if FILE is a
    folder)."""

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """Hypotheses file (object_<id>.npz), or the folder that `farside replay` wrote."""
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="(this, --points or --mesh)"),
    ] = None
    """The lower and the upper corner of an axis-aligned box, metres."""
    points: Annotated[Path | None, arg(metavar="FILE.xyz", help_behavior_hint="(this, --box or --mesh)")] = None
    """Text file of points, one a line: x y z in metres."""
    mesh: Annotated[Path | None, arg(metavar="FILE.obj", help_behavior_hint="(this, --box or --points)")] = None
    """Mesh (.obj, .stl, .ply, .off, .glb) in metres, in the frame of the question: what it fills (with openings: its
    surface alone)."""
    frame: Literal["object", "camera", "world"] = "object"
    """Frame of the question. object: z up, x to the camera, the plane under the origin; camera: x right, y down."""
    risk: float = 0.05
    """Chance of being wrong at which it is still called free or occupied; else the verdict is "unsure", or
    "unseen" where nobody looked."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class View:
    """Describe the objects of a hypotheses file or folder, and show them on a 3D page until Ctrl-C."""

    file: Annotated[Positional[Path | None], arg(metavar="[FILE]", help_behavior_hint="(this, or --live)")] = None
    """Hypotheses file (object_<id>.npz), or the folder that `farside replay` wrote."""
    live: Annotated[str | None, arg(metavar="ENDPOINT", help_behavior_hint="(this, or FILE)")] = None
    """Show a node that runs, by its endpoint on the bus, such as tcp/127.0.0.1:7448."""
    node: Annotated[str, arg(metavar="NAME")] = "/farside"
    """Full name of that node."""
    out: Annotated[Path | None, arg(metavar="FILE.png|FILE.gif", help_behavior_hint="(default: open the page)")] = None
    """Open no page; draw the picture here (.gif: hypotheses that turn), or for several objects into this folder."""
    port: Annotated[int, arg(metavar="N")] = 8765
    """Port of the page on this machine (127.0.0.1); 0 takes a free one."""
    token: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put a random token into the page's address: nobody else on this machine can open it."""


@dataclass(frozen=True)
class Capture:
    """Turn an object on a turntable and keep posed pictures of it, for `farside train --data`; resumes after a stop."""

    source: Annotated[str | None, arg(metavar="SOURCE", help_behavior_hint="(required)")] = None
    """Source of frames: a live camera, or any other source of `farside`."""
    port: Annotated[
        str | None, arg(metavar="PORT", help_behavior_hint="(required; without it the ports are listed)")
    ] = None
    """Serial port of the turntable (grbl 1.1), such as /dev/ttyUSB0."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("captured")
    """Folder of the data set, with one subfolder per object."""
    instance: Annotated[str, arg(metavar="NAME")] = "object"
    """Name of this object."""
    views: Annotated[int, arg(metavar="N")] = 36
    """Pictures of one full turn."""
    board: Annotated[str, arg(metavar="BOARD")] = "charuco:7x7:0.03:0.022:DICT_4X4_50"
    """ChArUco board on the plate: squares, square and marker in m, dictionary; `farside calibrate --print-target`
    prints it. Place objects of one kind the same way round: the board's right is the front."""
    background: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: white)")] = None
    """Picture of the empty plate, board in view, from where the camera stands; used only without depth."""
    home: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Turn to the limit switch first; otherwise the present angle is 0."""
    unlock: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Clear the controller's alarm first. Check before that nothing is jammed."""
    retakes: Annotated[int, arg(metavar="N")] = 2
    """How often a view is taken again when the board is not found, before it is skipped."""
    settle: Annotated[float, arg(metavar="SECONDS")] = 0.3
    """Pause before each picture."""
    table: tyro.conf.OmitArgPrefixes[TurntableConfig] = field(default_factory=TurntableConfig)


def options_of(kind: type, hidden: bool) -> type:
    """`kind` as the command line reads it: with --config, and unchecked. `hidden` leaves its nested settings out."""
    suppress: Any = tyro.conf.Suppress
    nested = [(f.name, suppress[f.type], None) for f in fields(kind) if hidden and is_dataclass(f.type)]
    hint = "(default: none)"
    text = (
        "YAML file with these options and all others by name, such as launch/replay.yaml or launch/live.yaml; options"
        " given here win. --help-all lists all."
    )
    file = Annotated[Path | None, arg(metavar="FILE", help=text, help_behavior_hint=hint)]
    body = {"__doc__": kind.__doc__, "__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, [*nested, ("config", file, None)], bases=(kind,), namespace=body, frozen=True)
