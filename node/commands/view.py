"""`farside view`: describe hypotheses files, and show them on the page or draw them."""

import threading
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from node.commands.replay import report
from node.figures.object_figure import draw_object
from node.figures.turning import draw_turning
from node.viewer.scene3d import CameraView, camera_view
from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import frame_path, load_scene
from perception.sources.frame_folder import read_frame_folder


def open_page(path: Path, port: int, token: bool, out: Console, err: Console) -> None:
    """Show the objects of a hypotheses file or folder on the page until Ctrl-C; `token` as `Page`.

    Raises FileNotFoundError, ValueError or OSError in one line: no such file, or a port that is in use.
    """
    from node.viewer.page import Page  # viser takes a second to import

    scene = load_scene(path)
    view = load_view(path, scene, err)
    with Page(port, token) as page:
        page.show(scene, view)
        for h in scene:
            report(h, out)
        out.print(f"{page.address} shows it; Ctrl-C ends it", highlight=False, soft_wrap=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            pass


def draw(path: Path, picture: Path, out: Console, err: Console) -> None:
    """Describe each object of a hypotheses file or folder and draw its picture: to `picture`, or with several objects
    to `object_<id>.png` in the folder `picture`. A name that ends in .gif gets turning hypotheses (`draw_turning`).

    Raises FileNotFoundError or ValueError in one line.
    """
    scene = load_scene(path)
    several = len(scene) > 1
    if several and (picture.is_file() or picture.suffix):
        raise ValueError(f"{path} holds {len(scene)} objects; give one file, or a folder for --out, not {picture}")
    if not several and picture.is_dir():
        raise ValueError(f"{picture} is a folder; give a file for --out, such as {picture / 'object.png'}")
    if not several and picture.suffix.lower() not in (".png", ".gif"):
        raise ValueError(f"{picture} is no name for a picture; give --out a name such as {picture.with_suffix('.png')}")
    view = load_view(path, scene, err)
    for h in scene:
        target = picture / f"object_{h.object_id}.png" if several else picture
        found = None if view is None else view.segments.get(h.object_id)
        frame = None if view is None else view.frame
        if target.suffix.lower() == ".gif":
            draw_turning(target, h, frame)
        else:
            draw_object(target, h, frame, found)
        report(h, out)
        out.print(f"  {target}", highlight=False, soft_wrap=True)


def load_view(path: Path, scene: Sequence[Hypotheses], err: Console) -> CameraView | None:
    """The frame that `replay` kept beside a hypotheses file, if the objects were inferred from it."""
    folder = frame_path(path if path.is_dir() else path.parent)
    if not (folder / "meta.json").is_file():
        return None
    try:
        return camera_view(read_frame_folder(folder), scene)
    except (ValueError, FileNotFoundError) as error:
        err.print(f"note: the picture is left out: {error}", highlight=False, soft_wrap=True)
        return None
