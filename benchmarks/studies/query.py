"""Queries: is a box free, by whole shapes jointly and by independent voxels; and the time of 100,000 points.

Objects of the test seeds from one random view each, as in `farside bench calibration`. The question is whether a
random box in unseen space (2 to 10 voxels a side about a voxel that may be occupied; its seen part does not count) is
all free. Three ways to answer it from the same hypotheses:

- joint: the share of hypotheses in which it is free (without the caution that a query adds for `out_of_model`)
- independent voxels: the product of (1 - p_occupied) over its voxels
- each voxel alone: free if p_occupied is below 0.5 in every voxel, as a map with one number per voxel is read

brier: mean squared error of that probability. log_score: nats, probabilities kept within 0.005 of 0 and 1. called
free: of boxes with a probability of 0.95 or more, the share that is not free. Intervals are over objects.

Times: the median of 21 for one object, boxes and points in the camera frame. points_alone is the look-up of p_occupied
without the joint answer.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import gap_rows, mean_rows, paired_interval
from benchmarks.harness.progress import say
from benchmarks.harness.results import refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.metrics import scored_voxels
from benchmarks.measures.scores import random_boxes
from benchmarks.scenes.conditions import ANY, views
from benchmarks.scenes.vessels import GRID, VesselView, base_rate
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import marginal, query
from perception.answers.regions import Box, Points, Swept
from perception.inference.controller import estimate
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import coarsen

JOINT, INDEPENDENT, ALONE = WAYS = ("joint", "independent voxels", "each voxel alone")
COLOURS = dict(zip(WAYS, ("tab:blue", "tab:orange", "tab:red"), strict=True))
BOXES = 64  # an object
CLIP = 0.005
CALLED = 0.95
POINTS = 100_000


def p_free_by_way(
    shapes: Bool[np.ndarray, "S V"], weights: Float[np.ndarray, "S"], inside: Bool[np.ndarray, "V"]
) -> dict[str, float]:
    """Probability that no voxel of `inside` is occupied, three ways."""
    held = shapes[:, inside]
    p = weights @ held
    return {
        JOINT: float(weights @ ~held.any(axis=1)),
        INDEPENDENT: float(np.prod(1.0 - p)),
        ALONE: float(np.all(p < 0.5)),
    }


def judged(
    view: VesselView, h: Hypotheses, rate: Float[np.ndarray, "32 32 32"], rng: np.random.Generator
) -> tuple[dict[str, Float[np.ndarray, "boxes"]], Bool[np.ndarray, "boxes"]]:
    """p_free of every box by way, and whether it is truly free."""
    shapes = coarsen(h.solid, GRID)
    p_free: dict[str, list[float]] = {way: [] for way in WAYS}
    free = []
    for (x, y, z), (a, b, c) in random_boxes(scored_voxels(view.seen, rate), BOXES, rng):
        inside = np.zeros((GRID,) * 3, bool)
        inside[x:a, y:b, z:c] = ~view.seen[x:a, y:b, z:c]
        for way, p in p_free_by_way(shapes.reshape(len(shapes), -1), h.weights, inside.ravel()).items():
            p_free[way].append(p)
        free.append(not (view.solid & inside).any())
    return {way: np.array(p) for way, p in p_free.items()}, np.array(free)


def scores(p: Float[np.ndarray, "boxes"], free: Bool[np.ndarray, "boxes"]) -> dict[str, float]:
    """Of one object's boxes."""
    kept = np.clip(p, CLIP, 1.0 - CLIP)
    called = p >= CALLED
    return {
        "brier": float(np.mean((p - free) ** 2)),
        "log_score": float(-np.mean(np.where(free, np.log(kept), np.log1p(-kept)))),
        "called_free": float(called.mean()),
        "wrong": float((called & ~free).mean()),
    }


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """Whether unseen boxes are free, jointly and by independent voxels; the time that a query takes."""

    n: int = 40
    """Objects."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    n, seed = min(options.n, 2) if options.quick else options.n, options.seed
    loaded, rate = load_prior(options.prior), base_rate(128 if options.quick else 1024)
    every: list[tuple[dict[str, np.ndarray], np.ndarray]] = []
    h = None
    for number, view in views(ANY, n, lambda _: False):
        assert view is not None
        h = estimate(view.frame, view.segment, loaded, seed=seed, stages=240).hypotheses
        refuse_cut(h.result)
        every.append(judged(view, h, rate, np.random.default_rng([seed, number, 71])))
        found = {way: scores(p, every[-1][1])["brier"] for way, p in every[-1][0].items()}
        say(f"{len(every)}, object {number}: brier " + ", ".join(f"{way} {v:.3f}" for way, v in found.items()))
    assert h is not None
    rows, cells = [], []
    by = {way: [scores(p_free[way], free) for p_free, free in every] for way in WAYS}
    for way, own in by.items():
        column = {metric: np.array([s[metric] for s in own]) for metric in own[0]}
        for metric in ("brier", "log_score"):
            rows += mean_rows("query", way, ANY, metric, column[metric], "nats" if metric == "log_score" else "")
        pair = column["log_score"], np.array([s["log_score"] for s in by[JOINT]])
        gap = paired_interval(*pair)
        rows += gap_rows("query", way, ANY, "log_score_above_joint", *pair)
        called = float(column["called_free"].mean())
        wrong = float(column["wrong"].mean()) / max(called, 1e-9)
        rows += [Row("query", way, ANY, k, v, "", gap.n) for k, v in (("called_free", called), ("wrong", wrong))]
        cells.append([
            way, f"{column['brier'].mean():.3f}", f"{column['log_score'].mean():.3f}",
            "" if way == JOINT else ranged(gap, sign="+"), gated(f"{wrong:.3f} ({called:.0%})", wrong, most=0.05),
        ])  # fmt: skip
    header = (
        "way",
        "brier",
        "log score",
        "above the joint one's",
        "called free and not (share called), gate <= 0.05",
    )
    times = _times(h)
    tables = [
        Table(f"{BOXES * len(every)} unseen boxes, {len(every)} objects", header, cells),
        Table("Median time", ("what", "ms"), [[row.metric, f"{row.value:.2f}"] for row in times]),
    ]
    return Summary([*rows, *times], tables, lambda: _draw(every))


def _times(h: Hypotheses) -> list[Row]:
    """Milliseconds of one object's answers."""
    rng = np.random.default_rng(0)
    points = h.object_frame.to_camera(rng.uniform(-1.0, 1.0, (POINTS, 3)))
    low, high = points.min(axis=0), points.max(axis=0)
    box = Box(tuple(low), tuple(0.5 * (low + high)))
    T = np.tile(h.object_frame.T_camera_object, (16, 1, 1))
    T[:, :3, 3] = points[:16]
    swept = Swept(T, np.full((16, 3), 0.05))
    p_occupied = marginal(h)
    questions: dict[str, Callable[[], object]] = {
        f"{POINTS:,} points": lambda: query([h], Points(points), "camera"),
        f"{POINTS:,} points_alone": lambda: p_occupied[h.voxels("camera", *points.T)],
        "a box, an eighth of the cube": lambda: query([h], box, "camera"),
        "16 swept boxes": lambda: query([h], swept, "camera"),
    }
    rows = []
    for name, ask in questions.items():
        ask()
        taken = []
        for _ in range(21):
            begun = time.perf_counter()
            ask()
            taken.append(1e3 * (time.perf_counter() - begun))
        rows.append(
            Row("query", JOINT, f"{len(h.weights)} hypotheses, {h.grid}^3", name, float(np.median(taken)), "ms", 21)
        )
    return rows


def _draw(every: list[tuple[dict[str, np.ndarray], np.ndarray]]) -> Figure:
    """Reliability of p_free, and how often each probability is said."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    free = np.concatenate([f for _, f in every])
    left.plot([0, 1], [0, 1], "k--", linewidth=1)
    edges = np.linspace(0, 1, 11)
    for way in (JOINT, INDEPENDENT):
        p = np.concatenate([p_free[way] for p_free, _ in every])
        bins = np.minimum((p * 10).astype(int), 9)
        count = np.bincount(bins, minlength=10)
        shown = count > 20
        mean, share = (np.bincount(bins, weights=w, minlength=10)[shown] / count[shown] for w in (p, free))
        left.plot(mean, share, "o-", color=COLOURS[way], label=way, ms=4)
        right.hist(p, edges, histtype="step", color=COLOURS[way], label=way)
    left.set(xlabel="probability that the box is free", ylabel="share that is", title="boxes in unseen space")
    right.set(xlabel="probability that the box is free", ylabel=f"boxes of {len(free)}")
    left.legend(fontsize=9)
    return figure
