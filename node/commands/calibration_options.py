"""Options of the commands that calibrate (as `options`: only modules without JAX and OpenCV are imported here)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg


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
    """Images (folder, or ROS's calibrationdata.tar.gz), recording (needs no camera_info), video, or oak, webcam:N."""
    board: Annotated[
        str | None, arg(metavar="BOARD", help_behavior_hint="(default: charuco:7x5:0.035:0.026:DICT_5X5_100)")
    ] = None
    """chessboard:8x6:0.025 (inner corners, square in m), charuco with squares, square, marker and dictionary,
    circles:7x5:0.03, asymmetric_circles:4x11:0.02, or aprilgrid:6x6:0.03:0.3 (tags, tag in m, gap in tags)."""
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
class HandEyeOptions:
    """Measure where a camera is on a robot, from pictures of a board and the robot's pose at each of them.

    1. Camera on the gripper (in-hand): fix the board in the robot's reach. Camera beside the robot (to-hand): fix the
       board to the gripper.
    2. Take 15 or more pictures, the robot at rest: the gripper turned by 30 degrees or more about different axes.
    3. farside hand-eye PICTURES --poses poses.csv --camera camera.yaml
    4. farside live --hand-eye hand_eye.yaml
    """

    source: Annotated[Positional[str], arg(metavar="PICTURES")]
    """Folder of images, in the order of their names."""
    poses: Annotated[Path, arg(metavar="FILE")]
    """T_base_gripper at each picture: .csv or .txt with rows of x y z qx qy qz qw (m; perhaps after a picture's name),
    .json or .yaml with a list of ROS's Pose or Transform, or of 4x4 matrices."""
    camera: Annotated[
        Path | None, arg(metavar="FILE.yaml", help_behavior_hint="(default: calibrated from the pictures)")
    ] = None
    """The camera's calibration: `farside calibrate`'s, ROS's or Kalibr's file (FILE.yaml#cam1)."""
    eye: Annotated[Literal["in-hand", "to-hand"], arg(metavar="{in-hand,to-hand}")] = "in-hand"
    """in-hand: the camera is on the gripper. to-hand: it stands still, and the gripper holds the board."""
    board: Annotated[
        str | None, arg(metavar="BOARD", help_behavior_hint="(default: charuco:7x5:0.035:0.026:DICT_5X5_100)")
    ] = None
    """The board, as of `farside calibrate`."""
    out: Annotated[Path, arg(metavar="FILE.yaml")] = Path("hand_eye.yaml")
    """The result: a geometry_msgs/TransformStamped with its standard deviations."""
    gripper_frame: Annotated[str, arg(metavar="FRAME")] = "tool0"
    """The robot's frame whose poses these are."""
    base_frame: Annotated[str, arg(metavar="FRAME")] = "base_link"
    """The frame that these poses are in."""
    camera_frame: Annotated[str, arg(metavar="FRAME")] = "camera_color_optical_frame"
    """frame_id of the camera's pictures (optical: x right, y down, z forward)."""
