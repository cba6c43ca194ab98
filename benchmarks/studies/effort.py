"""Cost of easy and of hard scenes: no more model than a scene needs.

Easy: a plain can without a handle, nothing in front of it, seen from 30 to 50 degrees above. Hard: a printed pitcher
of which a carton hides 35 to 65% of the pixels. Test seeds, RGB-D, the whole path from frame to hypotheses, as it is
shipped; beside it the largest model for every scene, which is four runs of the sampler. Cost is field evaluations with
gradient, and seconds from the frame to the last answer (programs compiled before). first_answer is the time of the
first answer that can be published. hidden_nll is that of `farside bench hidden`.
"""

import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.intervals import gap_rows, interval, mean_rows, paired_interval
from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table, between, gated
from benchmarks.measures.metrics import scored_voxels
from benchmarks.measures.scores import Answer, random_boxes, score
from benchmarks.scenes.cartons import carton_seeds, half_hidden
from benchmarks.scenes.vessels import (
    GRID,
    VesselPicture,
    VesselView,
    ViewConfig,
    base_rate,
    place,
    simulated_camera,
    vessel_view,
)
from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.simulation.simulated_camera import PlacedObject, TableScene, render
from probnerf.objects.tabletop import KINDS, TEST_SEEDS, TEXTURES
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import coarsen

EASY, HARD = CONDITIONS = ("plain can, seen well", "printed pitcher, half hidden")
CONTROLLER, LARGEST = METHODS = ("controller", "largest model")
METRICS = {"point_gradients": "", "first_answer": "s", "seconds": "s", "hidden_nll": "nats"}
PARTS = ("climbing", "sampling", "publishing")  # of the seconds; the rest is to observe


@dataclass(frozen=True, eq=False)
class Spent:
    """One scene's figures, by method and metric."""

    values: dict[str, dict[str, float]]
    log: tuple[str, ...]  # the controller's


def scenes(condition: str, count: int) -> Iterator[VesselView]:
    """The first `count` views of test seeds that fit a condition."""
    kind, texture = ("can", "plain") if condition == EASY else ("pitcher", "printed")
    cartons = carton_seeds(TEST_SEEDS)
    found = 0
    for seed in TEST_SEEDS:
        shape = PlacedObject(seed, 0.0, 0.0, 0.0).shape
        if found == count:
            return
        if KINDS[int(shape.kind)] != kind or TEXTURES[int(shape.texture)] != texture:
            continue
        if condition == EASY and bool(shape.has_handle):
            continue
        picture = _easy(seed) if condition == EASY else half_hidden(seed, next(cartons))
        try:
            if picture is not None:
                yield vessel_view(picture)
                found += 1
        except ValueError:  # outside perception's range of sizes
            continue


def _easy(seed: int) -> VesselPicture:
    config = ViewConfig(elevation=(30.0, 50.0))
    placed, T = place(seed, np.random.default_rng([seed, 41]), config)
    camera = simulated_camera(config)
    return VesselPicture(placed, camera, T, render(TableScene((placed,)), camera, T))


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """What the controller spends on easy and on hard scenes, beside the largest model for all."""

    n: int = 8
    """Scenes of each sort."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    n, seed = min(options.n, 2) if options.quick else options.n, options.seed
    loaded, config = load_prior(options.prior), ControllerConfig()
    amounts = {CONTROLLER: config, LARGEST: replace(config, runs=4)}
    rate = base_rate(128 if options.quick else 1024, config=config.observe)
    spent: dict[str, list[Spent]] = {condition: [] for condition in CONDITIONS}
    warm = set[str]()

    def measured(view: VesselView, amount: ControllerConfig) -> tuple[dict[str, float], Estimate]:
        """One scene's figures with one amount of model, by metric, and what they are of."""
        begun, times = time.monotonic(), list[float]()
        found = estimate(
            view.frame,
            view.segment,
            loaded,
            amount,
            seed=seed,
            on_answer=lambda _: times.append(time.monotonic() - begun),
        )
        h = found.hypotheses
        rng = np.random.default_rng([seed, view.seed, 31])
        boxes = random_boxes(scored_voxels(view.seen, rate), 1, rng)
        judged = score(view, Answer(coarsen(h.solid, GRID), h.weights, found.seconds), rate, boxes, rng)
        cost = {"point_gradients": h.diagnostics.point_gradients, "first_answer": times[0], "seconds": times[-1]}
        parts = {part: found.parts.get(part, 0.0) for part in PARTS}
        return {**cost, **parts, "hidden_nll": judged.values["hidden_nll"]}, found

    for condition in CONDITIONS:
        for view in scenes(condition, n):
            if condition not in warm:  # each begins elsewhere, with programs of its own
                measured(view, replace(config, runs=1))
                warm.add(condition)
            got = {method: measured(view, amount) for method, amount in amounts.items()}
            values = {method: values for method, (values, _) in got.items()}
            spent[condition].append(Spent(values, got[CONTROLLER][1].log))
            c, largest = values[CONTROLLER], values[LARGEST]
            say(
                f"{condition}, {view.seed}: {c['point_gradients'] / 1e6:.1f} of {largest['point_gradients'] / 1e6:.1f}"
                f" million, {c['seconds']:.1f} of {largest['seconds']:.1f} s, {c['hidden_nll']:.3f} against"
                f" {largest['hidden_nll']:.3f} nats"
            )
            for line in spent[condition][-1].log:
                say(f"    {line}")
    rows, table = _rows(spent)
    peak = 1e-6 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB
    rows.append(Row("effort", "both", "the process", "peak_memory", peak, "GB", 1))
    return Summary(rows, [table], lambda: _draw(spent))


def _rows(spent: dict[str, list[Spent]]) -> tuple[list[Row], Table]:
    rows, lines, none = [], [], [""] * len(PARTS)

    def column(condition: str, method: str, metric: str) -> list[float]:
        return [s.values[method][metric] for s in spent[condition]]

    for condition in CONDITIONS:
        for method in METHODS:
            for metric, unit in (METRICS | dict.fromkeys(PARTS, "s")).items():
                rows += mean_rows("effort", method, condition, metric, column(condition, method, metric), unit)
            cells = [f"{interval(column(condition, method, metric)).mean:.3g}" for metric in (*METRICS, *PARTS)]
            lines.append([condition, method, *cells])
        own, largest = (column(condition, method, "hidden_nll") for method in (CONTROLLER, LARGEST))
        gap = paired_interval(own, largest)
        rows += gap_rows("effort", CONTROLLER, condition, "nll_above_largest", own, largest)
        lines.append(
            [condition, "controller's hidden_nll above the largest's", "", "", "", between(gap, sign="+"), *none]
        )
    for metric in ("point_gradients", "seconds"):
        easy, hard = (float(np.mean(column(condition, CONTROLLER, metric))) for condition in CONDITIONS)
        rows.append(Row("effort", CONTROLLER, "easy over hard", metric, easy / hard, "", len(spent[EASY])))
        share = gated(f"{easy / hard:.3f}", easy / hard, most=0.2)
        lines.append(["easy over hard, gate <= 0.2", metric, share, "", "", "", *none])
    return rows, Table("What scenes cost", ("condition", "method", *METRICS, *PARTS), lines)


def _draw(spent: dict[str, list[Spent]]) -> Figure:
    """Every scene's cost and score, an arrow from the controller to the largest model."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    ax = figure.subplots()
    for condition, colour in zip(CONDITIONS, ("tab:green", "tab:red"), strict=True):
        for i, s in enumerate(spent[condition]):
            points = [(s.values[m]["point_gradients"], s.values[m]["hidden_nll"]) for m in METHODS]
            ax.plot(*np.array(points).T, color=colour, linewidth=0.7, alpha=0.5)
            for (x, y), marker, method in zip(points, ("o", "s"), METHODS, strict=True):
                label = f"{condition}: {method}" if i == 0 else None
                ax.plot(
                    x, y, marker=marker, color=colour, fillstyle="full" if marker == "o" else "none", label=label, ls=""
                )
    ax.set(xscale="log", xlabel="field evaluations with gradient", ylabel="hidden_nll, nats (lower is better)")
    ax.set_title("A line joins one scene's two answers")
    ax.legend(fontsize=9)
    return figure
