"""A moving picture (GIF): the view, and beside it some of the hypotheses turning about the object's upright axis."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from foundation.whole_file import whole_file
from node.figures import voxel_renderer
from node.figures.object_figure import SHOWN, shown
from perception.answers.hypotheses import Hypotheses
from perception.sources.frame import Frame

_PIXELS = 164  # of a panel's side
_LABEL = 22  # px under a panel
_TURN_MS = 4000  # one turn
_COLOURS = 160  # of the palette that all frames share


def draw_turning(path: Path, h: Hypotheses, frame: Frame | None = None, steps: int = 36) -> None:
    """One turn of `steps` pictures. Surface that the camera saw is grey, the rest is orange.

    Each shape represents a share of the weight (`shown`). Without `frame` the view is left out.
    """
    index, shares = shown(h, SHOWN)
    labels = [f"{100 * share:.0f}% of the weight" for share in shares]
    panels: list[np.ndarray] = []
    if frame is not None:
        view = voxel_renderer.viewpoint(h.object_frame, _PIXELS)
        panels = [voxel_renderer.look_up(frame.rgb, frame.camera, h.object_frame, view, 255) / 255.0]
        labels = ["the one view", *labels]
    pictures, levels = [], [voxel_renderer.level(h, i) for i in index]
    for view in voxel_renderer.orbit(h.object_frame, _PIXELS, steps):
        shapes = [voxel_renderer.shade(h, levels[k], view, float(h.base[i])) for k, i in enumerate(index)]
        pictures.append(_labelled(np.concatenate([*panels, *shapes], axis=1), labels))
    sides = np.concatenate([np.asarray(pictures[0]), np.asarray(pictures[steps // 2])])
    palette = Image.fromarray(sides).quantize(_COLOURS)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    with whole_file(path) as part:
        frames[0].save(
            part, "GIF", save_all=True, append_images=frames[1:], duration=_TURN_MS // steps, loop=0, optimize=True
        )


def _labelled(row: Float[np.ndarray, "s w 3"], labels: list[str]) -> Image.Image:
    height, width = row.shape[:2]
    image = Image.new("RGB", (width, height + _LABEL), "white")
    image.paste(Image.fromarray(np.round(255 * row).astype(np.uint8)))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    for i, label in enumerate(labels):
        draw.text(((i + 0.5) * height, height + 0.5 * _LABEL), label, "#444444", font, anchor="mm")
    return image
