"""The command `farside hand-eye`: pictures of a board and the robot's poses in, the camera's place on the robot out."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from calibration.boards import DEFAULT_BOARD, parse_board
from calibration.calibrate import CalibrateConfig, calibrate, distinct
from calibration.camera import Camera
from calibration.camera_file import read_camera
from calibration.fit import BoardView
from calibration.hand_eye import HandEye, PosedView, hand_eye
from calibration.pose_files import RobotPose, quaternion, read_robot_poses, write_hand_eye
from node.commands.calibrate import check_output, find_views
from node.commands.calibration_options import Calibrate, HandEyeOptions
from perception.sources.pictures import Picture, open_pictures


def locate_camera(options: HandEyeOptions, out: Console, err: Console) -> None:
    """Find where the camera is, print it with its deviations and every picture's miss, and write it to `options.out`.

    Nothing is written where it is not determined. Raises ValueError or FileNotFoundError, one line.
    """
    source = options.source
    board = parse_board(options.board or DEFAULT_BOARD)
    check_output(options.out)
    _check_frames(options)
    poses = read_robot_poses(options.poses)
    camera = None if options.camera is None else read_camera(options.camera)
    pictures, total = open_pictures(source)
    if total is None:
        raise ValueError(
            f"{source} is no folder of pictures; the robot stands still for each, so give one with a pose each"
        )
    if board.twofold:
        note = (
            f"{board} looks the same after half a turn; keep it the same way up in all pictures, or use a ChArUco board"
        )
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    names: list[str] = []
    found = find_views(_named(pictures, names), board, err, total, Calibrate(source), CalibrateConfig())
    assert found.size is not None
    posed = _posed(options, names, found.views, poses, err)
    if camera is None:
        camera = _calibrated(source, found.views, found.size, err)
    elif (camera.width, camera.height) != found.size:
        size = "x".join(map(str, found.size))
        raise ValueError(
            f"{options.camera} is calibrated at {camera.width}x{camera.height} px but the pictures are {size} px;"
            " calibrate at their size"
        )
    try:
        result = hand_eye(posed, camera, options.eye)
    except ValueError as error:
        raise ValueError(f"{options.poses}: {error}") from None
    parent = options.gripper_frame if options.eye == "in-hand" else options.base_frame
    _report(result, parent, options.camera_frame, len(found.unseen), out)
    if result.trouble is not None:
        raise ValueError(f"{options.poses}: nothing is saved: {result.trouble}")
    write_hand_eye(options.out, result, parent, options.camera_frame)
    out.print(f"  {options.out}", highlight=False, soft_wrap=True)


def _check_frames(options: HandEyeOptions) -> None:
    parent = "--gripper-frame" if options.eye == "in-hand" else "--base-frame"
    frames = {parent: options.gripper_frame if options.eye == "in-hand" else options.base_frame}
    frames["--camera-frame"] = options.camera_frame
    for option, name in frames.items():
        if not name.strip("/ ") or not name.isprintable():
            raise ValueError(f"{option} is {name!r}; give a frame's name")
    if frames[parent] == options.camera_frame:
        raise ValueError(f"{parent} and --camera-frame are both {options.camera_frame!r}; give each its own name")


def _named(pictures: Iterator[Picture], names: list[str]) -> Iterator[Picture]:
    for picture in pictures:
        names.append(picture.name)
        yield picture


def _posed(
    options: HandEyeOptions, names: list[str], views: Sequence[BoardView], poses: Sequence[RobotPose], err: Console
) -> list[PosedView]:
    """The views that have a pose: by the picture's name where one is named in the file, else by their order.

    What has no partner is told to `err`. Raises ValueError where a picture has two poses.
    """
    known = {name: name for name in names} | {Path(name).stem: name for name in names}
    by_name, lone = dict[str, RobotPose](), list[str]()
    for pose in poses:
        path = Path(pose.picture or "")
        name = next((known[part] for part in (path.name, path.stem) if part in known), None)
        if name is None:
            lone.append(str(pose.picture)[:60])
        elif not np.allclose(by_name.setdefault(name, pose).T_base_gripper, pose.T_base_gripper):
            raise ValueError(f"{options.poses} has two poses of {name}; give the one at which it was taken")
    words = [p.picture for p in poses if p.picture and not p.picture.replace(".", "").isdigit()]
    if words and not by_name:
        raise ValueError(
            f"{options.poses} names {words[0]}, and no such name is among the pictures of {options.source}; name those"
        )
    if not by_name:  # not named, or with stamps
        if len(poses) != len(names):
            raise ValueError(
                f"{options.poses} has {len(poses)} poses, but {options.source} has {len(names)} pictures; give one for"
                " each in the order of their names, or name the picture beside each pose"
            )
        by_name, lone = dict(zip(names, poses, strict=True)), []
    without = [name for name in names if name not in by_name]
    for what, left in (("pictures have no pose", without), ("poses name no picture", lone)):
        if left:
            err.print(f"note: {len(left)} {what}: {', '.join(left[:5])}", highlight=False, soft_wrap=True)
    return [PosedView(v, by_name[v.name].T_base_gripper) for v in views if v.name in by_name]


def _calibrated(source: Path | str, views: Sequence[BoardView], size: tuple[int, int], err: Console) -> Camera:
    err.print("no --camera: it is calibrated from these pictures, too", style="yellow", highlight=False)
    result = calibrate(distinct(views, size, CalibrateConfig())[0], size)
    if result.trouble is not None:
        raise ValueError(f"{source}: {result.trouble}; or give --camera")
    return result.camera


def _report(result: HandEye, parent: str, camera: str, unseen: int, out: Console) -> None:
    """The camera's place, and how each picture misses it."""
    T, std = result.T_parent_camera, result.std
    shift = ", ".join(f"{1000 * v:.1f} ± {1000 * s:.1f}" for v, s in zip(T[:3, 3], std[3:], strict=True))
    turn = ", ".join(f"{np.degrees(s):.2f}" for s in std[:3])
    counts = [f"{len(result.misses)} used"]
    counts += [f"{n} {what}" for n, what in ((unseen, "without the board"), (len(result.dropped), "left out")) if n]
    rows = {
        "pictures": ", ".join(counts),
        "x, y, z": f"{shift} mm",
        "quaternion": "{:.5f} {:.5f} {:.5f} {:.5f} (x y z w)".format(*quaternion(T)),
        "turn": f"± {turn} degrees about x, y, z of {parent}",
        "RMS": f"{result.rms:.2f} px",
    }
    out.print(f"{camera} in {parent}", style="bold", highlight=False)
    table = Table.grid(padding=(0, 2))
    for name, value in rows.items():
        table.add_row(f"  {name}", value)
    out.print(table, highlight=False)
    out.print("  from where the robot says the gripper is to where the picture puts it:", highlight=False)
    misses = Table.grid(padding=(0, 2))
    for miss in result.misses:
        misses.add_row(
            f"  {miss.name}", f"{1000 * miss.shift:.1f} mm", f"{miss.turn:.2f} degrees", f"{miss.rms_px:.2f} px"
        )
    out.print(misses, highlight=False)
    for name, why in result.dropped:
        out.print(f"  {name} is left out: {why}", style="yellow", highlight=False, soft_wrap=True)
