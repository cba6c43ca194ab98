"""Uncurated grids of samples and maps of pixel variance, as in the paper's appendix.

`python -m benchmarks.paper.grids` draws them into docs/, some minutes a method. Nothing is chosen: the objects are the
first of the test seeds, the samples the first draws.

bench_paper_grid_samples.png: the prior's samples above, true cars below, all from one place.
bench_paper_grid_answers.png: one car from behind, answered by each method. In each pair of rows: the given view and one
from ahead; first the truth, then 8 draws, then the map: the standard deviation of a pixel between draws.
bench_paper_grid_annealing.png: an ambulance from behind, the last states of 8 chains, annealed and at one temperature.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from benchmarks.harness.command import command
from benchmarks.harness.machine import ROOT
from benchmarks.harness.progress import say
from benchmarks.harness.study import selected
from benchmarks.paper.annealing import BACK, COMPARED, rear_seeds
from benchmarks.paper.conditioned import SIZE, Conditioned
from benchmarks.paper.experiment import prior_of
from benchmarks.paper.families import FAMILIES, SPLITS, Family, render
from benchmarks.paper.judged import DRAWS, pictures
from benchmarks.paper.methods import CHAINS, HMC, HMC_DELTA, SHORT, VI, VI_DELTA, Effort, Found, Method, Question
from benchmarks.paper.prior_samples import own_samples
from probnerf.prior.networks import ProbNeRF
from probnerf.sampling.populations import thin

WEIGHTS = ROOT / "benchmarks" / "checkpoints" / "paper" / "cars.safetensors"
SHEETS = ("samples", "answers", "annealing")
ANSWERED = (HMC, HMC_DELTA, VI, VI_DELTA)
AHEAD = 0  # of the held-out views, the one that sees most of what is hidden from behind
ACROSS, DOWN = 10, 4  # samples of the prior
PLACE = (40.0, 20.0)  # degrees, from which they are seen
MOST = 0.25  # standard deviation of a pixel that is drawn as white
TILE = 0.72  # inches
Row = tuple[str, list[np.ndarray]]  # its label; pictures [s s 3], or a map [s s]


@dataclass(frozen=True)
class Options:
    """Draw the paper's grids of samples."""

    out: Path = ROOT / "docs"
    """Folder of the pictures."""
    sheets: str = ""
    """Only these, separated by semicolons: samples, answers, annealing."""
    prior: Annotated[Path, tyro.conf.arg(metavar="FILE")] = WEIGHTS
    """Weights."""
    full: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The paper's own schedules; without, shorter ones for two cores."""


def main(options: Options) -> None:
    """Draw the sheets. Raises ValueError for an unknown one, and as `prior_of` does."""
    asked = selected(options.sheets, SHEETS, "sheet")
    family = FAMILIES["cars"]
    model = prior_of(family, options.prior).model
    effort = Effort() if options.full else SHORT
    if "samples" in asked:
        save(options.out, "samples", sample_rows(model, family))
    if "answers" in asked:
        view = Conditioned(family, SPLITS["test"][0], BACK, model.preset.image_size)
        save(options.out, "answers", [row for m in ANSWERED for row in answer_rows(view, model, effort, m)])
    if "annealing" in asked:
        view = Conditioned(family, rear_seeds(1)[0], BACK, model.preset.image_size)
        save(options.out, "annealing", [r for m in COMPARED for r in answer_rows(view, model, effort, m, last=True)])


def sample_rows(model: ProbNeRF, family: Family) -> list[Row]:
    """Rows of the prior's samples, then as many of true objects, from `PLACE`."""
    T = family.camera(*PLACE)
    count = ACROSS * DOWN // 2
    made = own_samples(model, jax.random.key(0), np.broadcast_to(T, (count, 4, 4)))
    true = [render(family.draw(seed), T[None], SIZE).rgb[0] / 255.0 for seed in SPLITS["test"][:count]]
    rows = []
    for label, each in (("prior", list(made)), ("true", true)):
        rows += [(label, each[start : start + ACROSS]) for start in range(0, count, ACROSS)]
    return rows


def answer_rows(view: Conditioned, model: ProbNeRF, effort: Effort, method: Method, last: bool = False) -> list[Row]:
    """Two rows of one method's answer: truth, draws (or the chains' last states), and the map of their deviation."""
    found = method.answer(Question(view, model, effort, 0))
    say(f"{method.name}: {found.gradients:.0f} gradients")
    positions = found.posterior.positions[-CHAINS:] if last else _draws(found)
    T = np.concatenate([view.T_object_camera, view.held_out.T_object_camera[AHEAD : AHEAD + 1]])
    shown = pictures(model, found.likelihood, positions, T)
    true = view.given.rgb[0] / 255.0, view.held_out.rgb[AHEAD] / 255.0
    name = method.name.replace(", ", ",\n")
    labels = f"{name}\ngiven", f"{name}\nhidden side"
    return [(labels[v], [true[v], *shown[:, v], deviation(shown[:, v])]) for v in range(2)]


def _draws(found: Found) -> Float[Array, "S d"]:
    """Those that the rows of the posterior inference are of."""
    return found.posterior.positions[thin(found.posterior, DRAWS)[0]]


def deviation(shown: Float[np.ndarray, "S s s 3"]) -> Float[np.ndarray, "s s"]:
    """Standard deviation of each pixel between pictures: root of the mean variance of its colours."""
    return np.sqrt(shown.var(axis=0).mean(axis=-1))


def sheet(rows: Sequence[Row]) -> Figure:
    """All pictures, a row a line; a map is drawn from black (0) to white (`MOST`)."""
    across = max(len(shown) for _, shown in rows)
    figure = Figure(figsize=(TILE * (across + 1), TILE * len(rows)), dpi=100)
    axes = figure.subplots(len(rows), across, squeeze=False)
    left = 1.0 / (across + 1)
    figure.subplots_adjust(left, 0.0, 1.0, 1.0, wspace=0.02, hspace=0.02)
    for (label, shown), line in zip(rows, axes, strict=True):
        middle = line[0].get_position()
        figure.text(0.5 * left, 0.5 * (middle.y0 + middle.y1), label, ha="center", va="center", fontsize=6)
        for axis in line:
            axis.axis("off")
        for axis, picture in zip(line, shown, strict=False):
            axis.imshow(np.clip(picture, 0.0, 1.0), cmap="magma", vmin=0.0, vmax=MOST)
    return figure


def save(folder: Path, name: str, rows: Sequence[Row]) -> None:
    """Draw the rows into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"bench_paper_grid_{name}.png"
    sheet(rows).savefig(path)
    say(str(path))


if __name__ == "__main__":
    command(main, Options)
