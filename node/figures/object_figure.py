"""All pictures: an object's hypotheses, and the curves of a training run."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy import ndimage

from foundation.whole_file import whole_file
from node.figures import voxel_renderer
from node.figures.summary import answer, diagnostics, figures, warnings
from perception.answers.hypotheses import Hypotheses
from perception.answers.summary import sticks_out, summarise
from perception.observation.segmentation import Segment
from perception.sources.frame import Frame
from probnerf.pixel_status import UNKNOWN
from probnerf.types import BASE_Z

SHOWN = 4  # hypotheses in a picture
_LINE, _LEGEND = 0.058, 0.17  # of the summary: height of a line of 8 points, and of the legend below (axes)
_PIXELS = 180  # of a small picture's side
_LOG2 = float(np.log(2.0))
_DISAGREEMENT, _OCCUPIED = "RdPu", "OrRd"


def draw_object(path: Path, h: Hypotheses, frame: Frame | None = None, segment: Segment | None = None) -> None:
    """One object in one picture (PNG): view and pixel statuses, hypotheses from the camera and from behind, where they
    disagree, and their p_occupied of unseen space. Without a frame, only the hypotheses.
    """
    figure = Figure(figsize=(15.5, 9.9), dpi=100, facecolor="white")
    axes = figure.subplots(3, SHOWN + 1, gridspec_kw={"wspace": 0.06, "hspace": 0.17})
    figure.subplots_adjust(left=0.012, right=0.988, top=0.93, bottom=0.06)
    front, back = (voxel_renderer.viewpoint(h.object_frame, _PIXELS, behind) for behind in (False, True))
    for ax in axes.flat:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(False)
    _draw_view(axes[0, 0], axes[1, 0], h, frame, segment)
    chosen, shares = shown(h, SHOWN)
    for column, (index, share) in enumerate(zip(chosen, shares, strict=True), start=1):
        for row, view in enumerate((front, back)):
            picture = voxel_renderer.shade(h, voxel_renderer.level(h, index), view, float(h.base[index]))
            axes[row, column].imshow(picture, interpolation="bilinear")
        axes[0, column].set_title(f"{100 * share:.0f}% of the weight", fontsize=11)
    axes[0, 1].set_ylabel("from the camera", fontsize=11)
    axes[1, 1].set_ylabel("from behind", fontsize=11)
    _draw_disagreement(figure, axes[2, 0], axes[2, 1], h, back)
    _draw_sections(figure, axes[2, 2], axes[2, 3], h)
    _write_summary(axes[2, 4], h)
    name = f"object {h.object_id}" + (f" ({h.label})" if h.label else "")
    figure.suptitle(f"{name}: what one view says about the whole shape", fontsize=14, x=0.012, ha="left")
    save_figure(figure, path)


def draw_training(path: Path, history: list[dict[str, float]]) -> None:
    """Curves of a training run from its history (`step`, `loss`, `fit`, `kl`, ...), one panel each."""
    names = [name for name in history[0] if name not in ("step", "rays")] if history else []
    figure = Figure(figsize=(4.2 * max(len(names), 1), 3.4), dpi=110, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, max(len(names), 1)))
    steps = np.array([row["step"] for row in history])
    switch = [row["step"] for row in history if row.get("rays")]
    for ax, name in zip(panels, names, strict=False):
        values = np.array([row.get(name, np.nan) for row in history], np.float64)
        ax.plot(steps, values, color="#4f8fd0", alpha=0.35, linewidth=0.8)
        ax.plot(steps, _smoothed(values), color="#1f4e79", linewidth=1.6)
        finite = values[np.isfinite(values)]
        if len(finite) > 20:  # the first steps would set the scale
            low, high = np.percentile(finite[len(finite) // 20 :], [0.5, 99.5])
            ax.set_ylim(low - 0.1 * (high - low) - 1e-9, high + 0.1 * (high - low) + 1e-9)
        if switch and switch[0] > steps[0]:
            ax.axvline(switch[0], color="#888888", linewidth=0.8, linestyle="--")
        ax.set_title(
            {"fit": "fit (nats per object)", "kl": "KL (nats)", "loss": "loss (nats per object)"}.get(name, name)
        )
        ax.set_xlabel("step")
        ax.grid(alpha=0.25)
    save_figure(figure, path)


def shown(h: Hypotheses, count: int) -> tuple[Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Up to `count` hypotheses that represent all, and the share of the weight that each one represents.

    Those with a hidden part that sticks out (`sticks_out`) and those without are shown by their weight, one of each at
    least: they are what differs most for a planner, and `representatives` alone may pass over a thin part.
    """
    out, index, shares = sticks_out(h), np.zeros(0, int), np.zeros(0)
    weight = float(h.weights[out].sum())
    few = int(np.clip(round(count * weight), 1, count - 1)) if 0.0 < weight < 1.0 else round(count * weight)
    for group, most in ((~out, count - few), (out, few)):
        rows = np.flatnonzero(group & (h.weights > 0.0))
        if len(rows) and most:
            chosen, share = representatives(h.solid[rows], h.weights[rows], most)
            index, shares = np.append(index, rows[chosen]), np.append(shares, share)
    return index, shares


def representatives(
    solid: Bool[np.ndarray, "S G G G"], weights: Float[np.ndarray, "S"], count: int
) -> tuple[Int[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Up to `count` hypotheses that represent all of them, and the share of the weight that each one represents.

    Greedy k-medoids: each next one lowers most the weighted sum of distances (1 - intersection over union) to the
    nearest representative; a hypothesis counts for its nearest. The heaviest group comes first.
    """
    flat = solid.reshape(len(solid), -1).astype(np.float32)
    both, size = flat @ flat.T, flat.sum(axis=1)
    distance = 1.0 - both / np.maximum(size[:, None] + size - both, 1.0)
    nearest, chosen = np.full(len(flat), 2.0), np.zeros(0, int)
    for _ in range(min(count, len(flat))):
        cost = weights @ np.minimum(distance, nearest[:, None])
        best = int(cost.argmin())
        if len(chosen) and weights @ nearest - cost[best] < 1e-4:
            break  # the others are copies
        chosen, nearest = np.append(chosen, best), np.minimum(nearest, distance[:, best])
    shares = np.bincount(distance[:, chosen].argmin(axis=1), weights=weights, minlength=len(chosen))
    order = np.argsort(-shares, kind="stable")
    return chosen[order], shares[order]


def _draw_view(above: Axes, below: Axes, h: Hypotheses, frame: Frame | None, segment: Segment | None) -> None:
    """The frame's crop and, over it in grey, the pixels' statuses."""
    if frame is None or segment is None:
        for ax in (above, below):
            ax.set_axis_off()
        above.text(0.5, 0.5, "the view is not kept\nin a hypotheses file", ha="center", color="#888888", fontsize=11)
        return
    view = voxel_renderer.viewpoint(h.object_frame, 2 * _PIXELS)
    crop = voxel_renderer.look_up(frame.rgb, frame.camera, h.object_frame, view, 255) / 255.0
    status = voxel_renderer.look_up(segment.status, frame.camera, h.object_frame, view, UNKNOWN)
    above.imshow(crop, interpolation="bilinear")
    above.set_title("the view", fontsize=11)
    grey = crop.mean(axis=2, keepdims=True)
    paint = np.zeros_like(crop)
    for value, (_, colour) in voxel_renderer.STATUS.items():
        paint[status == value] = to_rgb(colour)
    below.imshow(0.5 * grey + 0.5 * paint)
    below.set_title("what its pixels say of this object", fontsize=11)
    handles = [Patch(color=colour, label=label) for label, colour in voxel_renderer.STATUS.values()]
    below.legend(handles=handles, loc="lower left", fontsize=8, ncols=3, framealpha=0.85, handlelength=1.0)


def _draw_disagreement(
    figure: Figure, behind: Axes, above: Axes, h: Hypotheses, back: voxel_renderer.Viewpoint
) -> None:
    """Where shapes differ by more than the place of a wall: binary entropy of p_occupied at unseen voxels two or more
    from the likely shape's surface, the largest along each line of sight, over a pale picture of that shape.
    """
    likely = h.p_occupied >= 0.5
    wall = ndimage.binary_dilation(likely, iterations=2) & ~ndimage.binary_erosion(likely, iterations=2)
    differ = np.where(wall | ~h.unseen, 0.0, h.disagreement)
    differ *= ndimage.binary_opening(differ > 0.1, np.ones((2, 2, 2)))  # without single voxels
    pale = voxel_renderer.shade(h, h.p_occupied, back).mean(axis=2)
    behind.imshow(0.5 + 0.5 * pale, cmap="gray", vmin=0, vmax=1, interpolation="bilinear")
    from_behind = voxel_renderer.largest_along(differ, back)
    scale: dict[str, Any] = {"cmap": _DISAGREEMENT, "vmin": 0, "vmax": _LOG2, "interpolation": "bilinear"}
    behind.imshow(from_behind, alpha=np.clip(2 * from_behind / _LOG2, 0, 1), **scale)
    from_above = differ.max(axis=2).T
    above.imshow(np.where(likely.any(axis=2).T, 0.8, 1.0), cmap="gray", vmin=0, vmax=1, origin="lower")
    above.imshow(from_above, alpha=np.clip(2 * from_above / _LOG2, 0, 1), origin="lower", **scale)
    behind.set_title("where shapes differ, from behind", fontsize=11)
    above.set_title("where shapes differ, from above", fontsize=11)
    _point_to_camera(above)
    _add_bar(
        figure,
        _DISAGREEMENT,
        _LOG2,
        [behind, above],
        "largest entropy on the line of sight, two voxels off the likely surface, nats",
    )


def _draw_sections(figure: Figure, horizontal: Axes, vertical: Axes, h: Hypotheses) -> None:
    """p_occupied in two sections; what the camera saw lies under a veil."""
    grid, p = h.grid, h.p_occupied
    column = p.sum(axis=(0, 1))
    filled = np.flatnonzero(column > 0.05 * max(column.max(), 1e-9))
    k = int(filled.mean()) if len(filled) else grid // 2
    base = 0.5 * grid * (BASE_Z + 1.0)  # voxels under the plane
    veil = ListedColormap(["none", "#8fa9bf"])
    for ax, values, seen, title in (
        (horizontal, p[:, :, k].T, h.seen[:, :, k].T, f"from above, at {100 * h.voxel_m * (k + 0.5 - base):.1f} cm"),
        (vertical, p[:, grid // 2, :].T, h.seen[:, grid // 2, :].T, "from the side, through the axis"),
    ):
        ax.imshow(values, origin="lower", cmap=_OCCUPIED, vmin=0, vmax=1, interpolation="bilinear")
        ax.imshow(seen, origin="lower", cmap=veil, vmin=0, vmax=1, alpha=0.6, interpolation="nearest")
        ax.set_title(title, fontsize=11)
        _point_to_camera(ax)
    vertical.axhline(base - 0.5, color="#555555", linewidth=1.0)
    _add_bar(
        figure, _OCCUPIED, 1.0, [horizontal, vertical], "probability that space is occupied (veiled: the camera saw it)"
    )


def _point_to_camera(ax: Axes) -> None:
    """In maps and sections x points to the camera and is drawn to the right."""
    ax.annotate("camera", (0.985, 0.945), xycoords="axes fraction", ha="right", fontsize=8, color="#444444")
    ax.annotate("", (0.985, 0.93), (0.82, 0.93), xycoords="axes fraction", arrowprops={"arrowstyle": "->"})
    ax.spines[:].set(visible=True, color="#cccccc")


def _add_bar(figure: Figure, colours: str | Colormap, top: float, axes: list[Axes], label: str) -> None:
    scale = ScalarMappable(Normalize(0.0, top), colours)
    bar = figure.colorbar(scale, ax=axes, orientation="horizontal", fraction=0.045, pad=0.03, aspect=45)
    bar.set_label(label, fontsize=9)
    bar.ax.tick_params(labelsize=8)


def _write_summary(ax: Axes, h: Hypotheses) -> None:
    lines = [line for part in answer(summarise(h)).split("; ") for line in textwrap.wrap(part, 41)]
    ax.text(0.03, 1.0, "\n".join(lines), va="top", fontsize=9, transform=ax.transAxes)
    doubts = [line for warning in warnings(h) for line in textwrap.wrap(warning, 46)]
    top = 0.97 - _LINE * 9 / 8 * len(lines)
    bottom = _LEGEND + _LINE * len(doubts)
    rows = list({**figures(h), **diagnostics(h)}.items())  # the last matter least
    for i, (name, value) in enumerate(rows[: max(0, int((top - bottom) / _LINE))]):
        ax.text(0.03, top - _LINE * i, name, va="top", fontsize=8, color="#666666", transform=ax.transAxes)
        ax.text(0.36, top - _LINE * i, value, va="top", fontsize=8, transform=ax.transAxes)
    ax.text(0.03, bottom, "\n".join(doubts), va="top", fontsize=8, color="#b03020", transform=ax.transAxes)
    unseen = (
        "surface not measured, or out of its sight" if h.object_frame.sight_sigma > 0 else "surface out of its sight"
    )
    handles = [
        Patch(color=tuple(voxel_renderer.SEEN), label="surface that the camera saw"),
        Patch(color=tuple(voxel_renderer.UNSEEN), label=unseen),
    ]
    ax.legend(handles=handles, loc="lower left", fontsize=9, frameon=False, borderpad=0.0)


def _smoothed(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Running mean over a twentieth of the run."""
    width = max(1, len(values) // 20)
    padded = np.concatenate([np.full(width // 2, values[0]), values, np.full(width - 1 - width // 2, values[-1])])
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def save_figure(figure: Figure, path: Path) -> None:
    """Write the PNG whole or not at all."""
    with whole_file(path) as part:
        figure.savefig(part, format="png")
