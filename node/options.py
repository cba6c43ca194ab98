"""Options of the commands: one dataclass each, whose field docstrings are the help. Nothing heavy is imported here."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Replay:
    """Infer whole-shape hypotheses for the objects in one recorded view; write a file and a picture for each."""

    source: Annotated[
        Positional[Path | None],
        arg(metavar="[SOURCE]", help_behavior_hint="(default: the recording that ships with the project)"),
    ] = None
    """Frame folder (color.png, depth.png, meta.json) or recording (.mcap, .db3, .bag, ROS 2 bag folder)."""
    object: Annotated[int | None, arg(metavar="ID", help_behavior_hint="(default: all)")] = None
    """The one object to infer: its id in the label map or, without one, 1, 2, ... from the largest."""
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
        Literal["tempered_smc", "annealed_hmc"] | None,
        arg(metavar="{tempered_smc,annealed_hmc}", help_behavior_hint="(default: tempered_smc)"),
    ] = None
    """Sampler: weighted tempered populations, or the annealed chains of the ProbNeRF paper."""
    frame: Annotated[int, arg(metavar="K")] = 0
    """Which frame of a recording (of its range, with --from and --to), from 0; -1 is the last."""
    start_s: Annotated[float, arg(name="from", metavar="SECONDS")] = 0.0
    """Leave out a recording's frames before this time after its first one."""
    end_s: Annotated[float | None, arg(name="to", metavar="SECONDS", help_behavior_hint="(default: the end)")] = None
    """Leave out a recording's frames after this time after its first one."""
    schedule: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Repeat the inferences that a recording tells of, which also gives their frames, budgets, stages and seeds."""
    camera: Annotated[
        Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: the intrinsics in the source)")
    ] = None
    """Calibration of the colour image (as `farside calibrate` writes it) to use in place of the recorded intrinsics."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Colour image of a recording that has several."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """Depth image of a recording; needed where its name does not say depth, or its frame_id is not colour's."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped tabletop prior)")] = (
        None
    )
    """Weights of another prior (.safetensors, as `farside train` writes them)."""
    colour_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave depth out. Without depth the camera's height and tilt are needed: see `segment` in launch/replay.yaml."""
    box: Annotated[
        tuple[int, int, int, int] | None, arg(metavar="X0 Y0 X1 Y1", help_behavior_hint="(default: none)")
    ] = None
    """Without depth: a box about the whole object, in pixels, the last two beyond it."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """YAML file with these options and all others by name, such as launch/replay.yaml; options given here win."""


@dataclass(frozen=True)
class Live:
    """Infer from a camera until Ctrl-C: answer on the bus, show a page, record. Objects are kept track of."""

    source: Annotated[Positional[str], arg(metavar="[SOURCE]")] = "oak"
    """oak, oak:ID, webcam:N, topic (a ROS 2 camera driver on the bus), or a recording, which is played back."""
    camera: Annotated[
        Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: the source's own intrinsics)")
    ] = None
    """Calibration of the colour image, as `farside calibrate` writes it."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """As of `farside replay`, of a recording."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """As of `farside replay`, of a recording."""
    record: Annotated[Path | None, arg(metavar="FILE.mcap", help_behavior_hint="(default: no recording)")] = None
    """Record every frame, the hypotheses and their schedule to a new file; `farside replay --schedule` repeats it."""
    page: Annotated[int | None, arg(metavar="PORT", help_behavior_hint="(default: no page)")] = None
    """Show a 3D page on this port of this machine; 0 takes a free one."""
    token: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put a random token into the page's address: nobody else on this machine can open it."""
    budget: Annotated[float, arg(metavar="SECONDS")] = 40.0
    """Sampling time for each object of a frame; what has not converged goes on with the next one."""
    pace: Annotated[float, arg(metavar="X")] = 1.0
    """Of a recording: 1 as it was made, 2 twice as fast, 0 as fast as it is read."""
    seconds: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: until Ctrl-C)")] = None
    """Stop after this time."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Seed of everything random."""
    prior: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: the shipped tabletop prior)")] = (
        None
    )
    """Weights of another prior."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """YAML file with these options and all others by name, such as launch/live.yaml; options given here win."""


@dataclass(frozen=True)
class Record:
    """Record frames of any source to an MCAP file, until Ctrl-C, the source's end, or --seconds."""

    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """Whatever `farside replay` reads."""
    out: Annotated[Path, arg(metavar="FILE.mcap")]
    """The recording, a new file."""
    seconds: Annotated[float | None, arg(metavar="N", help_behavior_hint="(default: no limit)")] = None
    """Time to record, by the stamps of the frames."""
    start_s: Annotated[float, arg(name="from", metavar="SECONDS")] = 0.0
    """Where the source is a recording: leave out frames before this time after its first one."""
    end_s: Annotated[float | None, arg(name="to", metavar="SECONDS", help_behavior_hint="(default: the end)")] = None
    """Where the source is a recording: leave out frames after this time after its first one."""
    colour_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """As of `farside replay`, of a recording."""
    depth_topic: Annotated[str | None, arg(metavar="TOPIC", help_behavior_hint="(default: by type and name)")] = None
    """As of `farside replay`, of a recording."""
    colour: Literal["raw", "png", "jpeg"] = "raw"
    """raw costs the least time, png (as exact) more of it and less space, jpeg the least space but is not exact."""
    depth: Literal["exact", "millimetres"] = "exact"
    """Whether depth that is not whole millimetres is kept as it is, or rounded to them."""
    compression: Literal["none", "lz4", "zstd"] = "lz4"
    """Of the file, in order of time and smallness."""


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
    """Chance of being wrong at which it is still called free or occupied; else the verdict is "unsure"."""
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
    out: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: open the page)")] = None
    """Open no page; draw the object's picture here, or for several objects into this folder."""
    port: Annotated[int, arg(metavar="N")] = 8765
    """Port of the page on this machine (127.0.0.1); 0 takes a free one."""
    token: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Put a random token into the page's address: nobody else on this machine can open it."""


@dataclass(frozen=True)
class Calibrate:
    """Measure a camera's intrinsics from pictures of a printed board; write a camera file that ROS reads, too.

    1. farside calibrate --print-target board.pdf, and print it at 100%.
    2. Take 15 or more pictures: the board tilted by 30 to 45 degrees to each side, near and far, in every corner.
    3. farside calibrate PICTURES --out camera.yaml

    Or move the board before a live camera: farside calibrate webcam:0, and Ctrl-C when no advice is left.
    """

    source: Annotated[
        Positional[str | None], arg(metavar="[SOURCE]", help_behavior_hint="(this, --from or --print-target)")
    ] = None
    """Folder of images, recording with a colour image (needs no camera_info), video, or camera: oak, webcam:N."""
    board: Annotated[
        str | None, arg(metavar="BOARD", help_behavior_hint="(default: charuco:7x5:0.035:0.026:DICT_5X5_100)")
    ] = None
    """chessboard:8x6:0.025 (inner corners, square in m) or charuco with squares, square, marker and dictionary."""
    out: Annotated[Path, arg(metavar="FILE.yaml")] = Path("camera.yaml")
    """The camera file, as ROS reads it, with standard deviations; a picture (.png) of the views goes beside it."""
    model: Annotated[
        Literal["plumb_bob", "rational_polynomial", "equidistant"],
        arg(metavar="{plumb_bob,rational_polynomial,equidistant}"),
    ] = "plumb_bob"
    """Lens: plumb_bob (5 coefficients; most cameras), rational_polynomial (8; wide), equidistant (4; fisheye)."""
    name: Annotated[str, arg(metavar="NAME")] = "camera"
    """camera_name in the file."""
    every: Annotated[int, arg(metavar="N")] = 1
    """Look at every Nth picture only."""
    from_: Annotated[
        Path | None, arg(name="from", metavar="SOURCE", help_behavior_hint="(measures nothing; needs no board)")
    ] = None
    """Write the camera that a recording (camera_info), a frame folder (meta.json), a camera file or the calibration of
    an OAK camera (.json, of the image as the lens makes it) states to --out."""
    socket: Annotated[str, arg(metavar="SOCKET")] = "CAM_A"
    """With --from FILE.json: which camera of the device."""
    size: Annotated[tuple[int, int], arg(metavar="W H")] = (640, 480)
    """With --from FILE.json: the size of its images, px."""
    print_target: Annotated[
        Path | None, arg(metavar="FILE.pdf|FILE.png", help_behavior_hint="(in true millimetres)")
    ] = None
    """Write a page with the board, to print."""
    paper: Literal["A4", "A3", "letter"] = "A4"
    """Paper of --print-target."""


@dataclass(frozen=True)
class Capture:
    """Turn an object on a turntable and keep posed pictures of it, for `farside train --data`; resumes after a stop."""

    source: Annotated[str | None, arg(metavar="SOURCE", help_behavior_hint="(required)")] = None
    """Where frames come from: a live camera, or whatever else `farside` opens."""
    port: Annotated[
        str | None, arg(metavar="PORT", help_behavior_hint="(required; without it the ports are listed)")
    ] = None
    """Serial port of the turntable (grbl 1.1), such as /dev/ttyUSB0."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("captured")
    """Folder of the data set, one folder for each object."""
    instance: Annotated[str, arg(metavar="NAME")] = "object"
    """Name of this object."""
    views: Annotated[int, arg(metavar="N")] = 36
    """Pictures of one full turn."""
    board: Annotated[str, arg(metavar="BOARD")] = "charuco:7x7:0.03:0.022:DICT_4X4_50"
    """ChArUco board on the plate: squares, square and marker in m, dictionary; `farside calibrate --print-target`
    prints it. Place objects of one kind the same way round: the board's right is the front."""
    background: Annotated[Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: white)")] = None
    """Picture of the empty plate, board in view, from where the camera stands; read only where there is no depth."""
    home: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Turn to the limit switch first; otherwise the present angle is 0."""
    unlock: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Clear the controller's alarm first: only when you have seen that nothing is jammed."""
    retakes: Annotated[int, arg(metavar="N")] = 2
    """Take a view so many times again in which the board is not found, before it is skipped."""
    settle: Annotated[float, arg(metavar="SECONDS")] = 0.3
    """Rest before each picture."""
    axis: Literal["X", "Y", "Z", "A", "B", "C"] = "X"
    """Axis letter that turns the table."""
    degrees_per_unit: Annotated[float, arg(metavar="DEGREES")] = 1.0
    """Degrees that the table turns for one G-code unit; negative turns the other way."""
    speed: Annotated[float, arg(metavar="DEG/S")] = 30.0
    """Degrees per second."""
    baud: Annotated[int, arg(metavar="BITS/S")] = 115_200
    """Speed of the serial line."""
