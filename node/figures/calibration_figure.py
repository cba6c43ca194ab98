"""The picture of a calibration: where corners were seen, how they miss their places, and what the views cover."""

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from calibration.calibrate import Calibration
from calibration.coverage import Coverage, next_views
from calibration.projection import Projection
from node.figures.object_figure import save_figure

_COLOURS = "viridis"
_PALE = "YlOrBr"


def draw_calibration(path: Path, result: Calibration, seen: Coverage, misses: Projection) -> None:
    """Write a PNG: corners, residuals magnified, corners per cell, tilts, and how far the projection may miss."""
    figure = Figure(figsize=(19.0, 9.4), dpi=100, layout=ConstrainedLayoutEngine(w_pad=0.25, h_pad=0.1))
    camera = result.camera
    (corners, residuals, deviation), (cells, leans, halves) = figure.subplots(2, 3)
    used = f"{len(result.views)} views used, {len(result.dropped)} left out"
    figure.suptitle(f"{camera.model}, fx {camera.K[0, 0]:.1f} px, RMS {camera.rms:.3f} px, {used}", fontsize=13)
    _draw_corners(corners, result)
    _draw_residuals(residuals, result)
    drawn = cells.imshow(seen.counts, extent=_extent(result), cmap="Blues", vmin=0, aspect="equal")
    cells.set_title("corners per cell (white: none)")
    for (row, column), count in np.ndenumerate(seen.counts):
        at = [(column + 0.5) * camera.width / seen.counts.shape[1], (row + 0.5) * camera.height / seen.counts.shape[0]]
        dark = count > 0.6 * seen.counts.max()
        cells.text(*at, str(count), ha="center", va="center", fontsize=9, color="white" if dark else "#333333")
    figure.colorbar(drawn, ax=cells, label="corners", shrink=0.75)
    dots = leans.scatter(*seen.tilts.T, c=seen.distances, cmap=_COLOURS, s=40, zorder=3)
    figure.colorbar(dots, ax=leans, label="distance (m)", shrink=0.75)
    limit = max(50.0, 1.1 * float(np.abs(seen.tilts).max()))
    leans.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", title="tilt of the board in each view")
    leans.set_xlabel("right side away (degrees)")
    leans.set_ylabel("lower side away (degrees)")
    leans.grid(color="#dddddd")
    _draw_map(deviation, misses, misses.std, "standard deviation of the projection")
    if misses.difference is None:
        halves.set_title("too few views for two halves")
    else:
        _draw_map(halves, misses, misses.difference, "from one half of the views to the other: shift of the projection")
    advice = next_views(seen)
    figure.supxlabel(f"next view: {advice[0]}" if advice else "the coverage is good", fontsize=10, color="#b03020")
    for ax in (corners, residuals, cells, deviation, halves):
        ax.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
        ax.set_xlabel("x (px)")
        ax.set_ylabel("y (px)")
    save_figure(figure, path)


def _extent(result: Calibration) -> tuple[float, float, float, float]:
    return (0.0, float(result.camera.width), float(result.camera.height), 0.0)


def _draw_corners(ax: Axes, result: Calibration) -> None:
    errors = np.array([v.rms for v in result.views])
    for fitted, colour in zip(result.views, np.linspace(0, 1, len(result.views)), strict=True):
        ax.plot(*fitted.view.pixels.T, ".", markersize=4, color=colormaps["turbo"](colour))
    cx, cy = result.camera.K[:2, 2]
    ax.plot(cx, cy, "+", color="#b03020", markersize=14, markeredgewidth=1.5)
    worst = result.views[int(errors.argmax())]
    ax.set_title(
        f"corners, a colour per view (+: principal point; worst view {worst.view.name}, {errors.max():.2f} px)"
    )
    ax.title.set_fontsize(10)


def _draw_map(ax: Axes, misses: Projection, values: np.ndarray, title: str) -> None:
    """Pixels over the picture, with the numbers; white where no ray is known."""
    values = np.maximum(values, 1e-3)  # of a picture without errors, the logarithm
    x, y = misses.places[0, :, 0].tolist(), misses.places[:, 0, 1].tolist()
    middle = float(np.sqrt(np.nanmin(values) * np.nanmax(values)))  # of the colours
    drawn = ax.pcolormesh(x, y, values, shading="nearest", cmap=_PALE, norm="log")
    ax.figure.colorbar(drawn, ax=ax, label="px", shrink=0.75)
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            across = {0: "left", len(x) - 1: "right"}.get(column, "center")
            down = {0: "top", len(y) - 1: "bottom"}.get(row, "center")
            ax.text(
                float(x[column]),
                float(y[row]),
                f"{value:.2f}",
                ha=across,
                va=down,
                fontsize=8,
                color="white" if value > 1.2 * middle else "#333333",
            )
    ax.set_title(title, fontsize=10)


def _draw_residuals(ax: Axes, result: Calibration) -> None:
    """Arrows from a corner's predicted place towards where it was found, magnified to be seen."""
    pixels = np.concatenate([v.view.pixels for v in result.views])
    residuals = np.concatenate([v.residuals for v in result.views])
    typical = float(np.percentile(np.linalg.norm(residuals, axis=1), 90))
    magnified = _round_down(
        result.camera.width / 20 / max(typical, 1e-6)
    )  # a large one gets a twentieth of the picture
    ax.quiver(
        *pixels.T, *(residuals * magnified).T, angles="xy", scale_units="xy", scale=1, width=0.0015, color="#274b8f"
    )
    length = _round_down(result.camera.width / 8 / magnified)  # px
    left, down = 0.04 * result.camera.width, 0.95 * result.camera.height
    ax.plot([left, left + length * magnified], [down, down], color="#b03020", linewidth=3)
    ax.text(left, down - 0.02 * result.camera.height, f"{length:g} px", color="#b03020", fontsize=10)
    ax.set_title(f"residuals, {magnified:g} times magnified")


def _round_down(value: float) -> float:
    """The next lower of 1, 2 and 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)))
