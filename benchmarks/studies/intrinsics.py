"""Whether the stated deviations of a calibration are its errors, beside a fit of a flat board by OpenCV.

A set of views of one board is drawn with a random camera, and calibrated in two halves. The board is bent to a sphere
or a cylinder by 0.5 to 2 mm of 0.21 m. Errors of corners are 0.05 px each and 0.1 px that neighbours in a picture
share (medians over pictures), and larger along a blur (`benchmarks/scenes/bent_boards.py`). Nothing was chosen by the
real set, which is read from ../shared/data beside the checkout where it is there.

- halves: difference of the two halves' estimates over the root of the sum of their squared deviations; root mean
  square over sets. 1 is right, more is too sure.
- truth: the same of an estimate's error over its deviation. What the halves have in common, such as the bend, shows
  here only.
- error: root mean square error of the estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table, gated
from benchmarks.scenes.bent_boards import SIZE, bent_views
from benchmarks.scenes.real_frames import DATA
from calibration.boards import parse_board
from calibration.calibrate import calibrate
from calibration.camera import Camera
from calibration.fit import BoardView, Model
from perception.sources.pictures import open_pictures

SETS, VIEWS = 60, 12  # views of a half
GATE = (0.8, 1.3)
NAMES = ("fx", "fy", "cx", "cy", "k1")
REAL, REAL_BOARD = "chessboard_wide", "chessboard:8x6:0.108"


@dataclass(frozen=True)
class Options(TableOptions):
    """Whether the stated deviations of a calibration are its errors, beside a fit of a flat board by OpenCV."""


Estimate = tuple[Float[np.ndarray, "5"], Float[np.ndarray, "5"]]  # of NAMES: values and standard deviations


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    rows, lines = [], []
    models: tuple[Model, ...] = ("plumb_bob", "equidistant")
    for model in models:
        pairs, truths = [], []
        for seed in range(6 if options.quick else SETS):
            camera, views = bent_views(model, 2 * VIEWS, seed)
            truths.append(_values(camera))
            pairs.append([_estimates(half, model) for half in (views[:VIEWS], views[VIEWS:])])
        for method in pairs[0][0]:
            a, b = (np.array([pair[i][method] for pair in pairs]) for i in (0, 1))  # sets, value and deviation, names
            halves = _rms((a[:, 0] - b[:, 0]) / np.hypot(a[:, 1], b[:, 1]))
            error = _rms(a[:, 0] - truths)
            truth = _rms((a[:, 0] - truths) / a[:, 1])
            condition = f"{model}, {VIEWS} views"
            for metric, values in (("halves", halves), ("truth", truth), ("error", error)):
                rows += [
                    Row("intrinsics", method, condition, f"{metric} {name}", float(value), "", len(pairs))
                    for name, value in zip(NAMES, values, strict=True)
                ]
            cells = [gated(f"{v:.2f}", v, *GATE) if method == "farside" else f"{v:.2f}" for v in halves]
            lines.append([condition, method, "halves", *cells])
            lines.append([condition, method, "truth", *(f"{v:.2f}" for v in truth)])
            lines.append([condition, method, "error", *(f"{v:.2g}" for v in error)])
    header = ("model", "method", "figure", *NAMES)
    title = f"{len(pairs)} sets with bent boards; gate of halves {GATE[0]:g} to {GATE[1]:g}"
    tables = [Table(title, header, lines)]
    if (DATA / REAL).is_dir():
        tables.append(_real())
    return Summary(rows, tables)


def _values(camera: Camera) -> Float[np.ndarray, "5"]:
    return np.array([*camera.K[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion[0]])


def _estimates(views: Sequence[BoardView], model: Model) -> dict[str, Estimate]:
    """What each method says; OpenCV states no deviations of a fisheye."""
    camera = calibrate(views, SIZE, model).camera
    assert camera.K_std is not None and camera.distortion_std is not None
    said = {
        "farside": (_values(camera), np.array([*camera.K_std[[0, 1, 0, 1], [0, 1, 2, 2]], camera.distortion_std[0]]))
    }
    if model == "plumb_bob":
        points, pixels = ([getattr(v, name).astype(np.float32) for v in views] for name in ("points", "pixels"))
        _, K, D, _, _, std, *_ = cv2.calibrateCameraExtended(points, pixels, SIZE, np.eye(3), np.zeros(5))
        said["flat, independent errors (OpenCV)"] = _values(Camera(*SIZE, K, np.ravel(D)[:5])), np.ravel(std)[:5]
    return said


def _rms(values: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "n"]:
    return np.sqrt((values**2).mean(axis=0))


def _real() -> Table:
    """The whole real set and its halves, every second picture."""
    board, views = parse_board(REAL_BOARD), []
    for picture in open_pictures(DATA / REAL)[0]:
        found = board.find(picture.rgb)
        if found is not None:
            views.append(BoardView(picture.name, *found))
    parts = {"all": views, "even": views[::2], "odd": views[1::2]}
    said = {part: _estimates(chosen, "plumb_bob") for part, chosen in parts.items()}
    lines = []
    for method in said["all"]:
        for part, chosen in parts.items():
            cells = [f"{v:.4g} ± {s:.2g}" for v, s in zip(*said[part][method], strict=True)]
            lines.append([method, f"{part}, {len(chosen)} views", *cells])
        (a, a_std), (b, b_std) = said["even"][method], said["odd"][method]
        lines.append(
            [method, "difference of halves / its deviation", *(f"{v:.2f}" for v in (a - b) / np.hypot(a_std, b_std))]
        )
    return Table(f"The real pictures of {REAL}", ("method", "pictures", *NAMES), lines)
