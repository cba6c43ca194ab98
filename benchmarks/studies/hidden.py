"""Hidden handles: how well the posterior and three rivals predict what one RGB-D view of a vessel does not show.

Vessels of the test seeds with a handle, each in a simulated view without a pixel of it (`scenes.vessels`); yaw
unknown, the whole path from frame to hypotheses. Four methods answer the same observation (`rivals.quick`), all
smoothed alike. Measures are taken per vessel, on 32^3 voxels of the view's cube, then averaged:

- hidden_nll, hidden_brier, hidden_ece: over the voxels that are truly unseen (by the true geometry) and whose
  training-set frequency of occupancy (family objects at any yaw, placed by perception's widths) lies in (0.02, 0.98).
- hidden_nll_handle: over those of them outside the true body that the true handle would occupy at some yaw.
- seconds: without the first vessel, for which the rivals compile (the posterior's programs are compiled before).
- coverage90, ks, falsely_free: of the occupied volume in random unseen boxes (2 to 10 voxels a side about a scored
  voxel; the seen part of a box does not count), by randomised ranks.

All vessels have a handle, while the view leaves open whether there is one. Ranks are reported as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.harness.intervals import gap_rows, interval, mean_rows, paired_interval
from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table, between, gated
from benchmarks.measures.metrics import coverage, falsely_free, ks_distance, scored_voxels
from benchmarks.measures.scores import BOXES, Answer, random_boxes, score
from benchmarks.rivals.quick import METHODS, POSTERIOR, RivalConfig, answers, warm_up
from benchmarks.scenes.vessels import VesselView, base_rate, hidden_vessel
from perception.inference.settings import ControllerConfig
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import load_prior

CONDITION = "handle hidden, RGB-D"
PER_OBJECT = ("hidden_nll", "hidden_nll_handle", "hidden_brier", "hidden_ece", "seconds")
COLOURS = dict(zip(METHODS, ("tab:blue", "tab:gray", "tab:orange", "tab:red"), strict=True))


@dataclass(frozen=True, eq=False)
class Judged:
    """One vessel, every method's answer and their figures."""

    vessel: VesselView
    scored: Bool[np.ndarray, "32 32 32"]
    probability: dict[str, Float[np.ndarray, "32 32 32"]]  # smoothed
    values: dict[str, dict[str, float]]  # by method and metric
    ranks: dict[str, Float[np.ndarray, "boxes"]]
    p_free: dict[str, Float[np.ndarray, "boxes"]]
    occupied: Bool[np.ndarray, "boxes"]
    result: str


def judge(
    vessel: VesselView, given: dict[str, Answer], rate: Float[np.ndarray, "32 32 32"], seed: int, warm: bool
) -> Judged:
    """Every measure of every method on one vessel; `warm` where their times hold no compilation."""
    scored = scored_voxels(vessel.seen, rate)
    rng = np.random.default_rng([seed, vessel.seed, 31])
    boxes = random_boxes(scored, BOXES, rng)
    found = {method: score(vessel, answer, rate, boxes, rng) for method, answer in given.items()}
    return Judged(
        vessel=vessel,
        scored=scored,
        probability={method: s.probability for method, s in found.items()},
        values={
            method: {**s.values, "seconds": given[method].seconds if warm else float("nan")}
            for method, s in found.items()
        },
        ranks={method: s.ranks for method, s in found.items()},
        p_free={method: s.p_free for method, s in found.items()},
        occupied=found[POSTERIOR].occupied,
        result=given[POSTERIOR].result,
    )


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """What one view of a vessel does not show: the posterior beside prior, encoder and MAP, handles hidden."""

    n: int = 30
    """Vessels."""
    budget_s: float = 60.0
    """Seconds that the sampler may take per vessel."""
    stages: int = 0
    """Stages that it may take instead of the budget (0: the budget holds)."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    n, seed, budget_s, stages = options.n, options.seed, options.budget_s, options.stages
    loaded, config, rivals = load_prior(options.prior), ControllerConfig(), RivalConfig()
    if options.quick:
        n = min(n, 3)
        rivals = replace(rivals, yaws=12, fit=replace(rivals.fit, steps=60, screen_steps=20))
        budget_s = min(budget_s, 10.0)
    rate = base_rate(128 if options.quick else 1024, config=config.observe)
    judged: list[Judged] = []
    sizes: set[tuple[int, ...]] = set()
    for family_seed in TEST_SEEDS:
        if len(judged) == n:
            break
        vessel = hidden_vessel(family_seed)
        if vessel is None:
            continue
        warm_up(vessel.frame, vessel.segment, loaded, config, sizes)
        given = answers(vessel, loaded, config, rivals, seed, None if stages else budget_s, stages or None)
        judged.append(judge(vessel, given, rate, seed, warm=bool(judged)))
        figures = ", ".join(f"{m} {v['hidden_nll']:.3f}" for m, v in judged[-1].values.items())
        say(f"{len(judged):3d} vessel {family_seed}: {figures} nats ({judged[-1].result})")
    return Summary(_rows(judged), [_table(judged)], lambda: _draw(judged))


def _column(judged: Sequence[Judged], method: str, metric: str) -> Float[np.ndarray, "n"]:
    return np.array([j.values[method][metric] for j in judged])


def _rows(judged: Sequence[Judged]) -> list[Row]:
    rows = []
    occupied = np.concatenate([j.occupied for j in judged])
    for method in METHODS:
        for metric in PER_OBJECT:
            unit = {"hidden_nll": "nats", "hidden_nll_handle": "nats", "seconds": "s"}.get(metric, "")
            rows += mean_rows("hidden", method, CONDITION, metric, _column(judged, method, metric), unit)
        ranks = np.concatenate([j.ranks[method] for j in judged])
        p_free = np.concatenate([j.p_free[method] for j in judged])
        for metric, value in (
            ("coverage90", coverage(ranks)),
            ("ks", ks_distance(ranks)),
            ("falsely_free", falsely_free(p_free, occupied)),
        ):
            rows.append(Row("hidden", method, CONDITION, metric, value, "", len(ranks)))
        if method == POSTERIOR:
            continue
        for metric in ("hidden_nll", "hidden_nll_handle"):
            own, posterior = (_column(judged, m, metric) for m in (method, POSTERIOR))
            rows += gap_rows("hidden", method, CONDITION, f"{metric}_above_posterior", own, posterior)
    done = [float(j.result == "converged") for j in judged]
    rows.append(Row("hidden", POSTERIOR, CONDITION, "converged", float(np.mean(done)), "", len(done)))
    return rows


def _table(judged: Sequence[Judged]) -> Table:
    lines = []
    for method in METHODS:
        cells = [method]
        for metric in PER_OBJECT:
            cells.append(f"{interval(_column(judged, method, metric)).mean:.3f}")
        for metric in ("hidden_nll", "hidden_nll_handle"):
            gap = paired_interval(_column(judged, method, metric), _column(judged, POSTERIOR, metric))
            cells.append("" if method == POSTERIOR else gated(between(gap, sign="+"), gap.low, least=0.0))
        lines.append(cells)
    header = ("method", *PER_OBJECT, "hidden_nll above the posterior's, gate > 0", "on the handle stratum, gate > 0")
    return Table(f"{len(judged)} vessels, {CONDITION}, smoothed alike", header, lines)


def _draw(judged: Sequence[Judged]) -> Figure:
    """Scores with intervals, reliability, ranks; below, three vessels: the view, the truth, each method's answer."""
    figure = Figure(figsize=(15, 15), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=(1, 2.2)))
    bars, handle, reliability, ranks = top.subplots(1, 4)
    for ax, metric, title in (
        (bars, "hidden_nll", "all unseen voxels"),
        (handle, "hidden_nll_handle", "handle stratum"),
    ):
        for i, method in enumerate(METHODS):
            found = interval(_column(judged, method, metric))
            half = found.high - found.mean
            error = half if np.isfinite(half) else None
            ax.bar(i, found.mean, yerr=error, color=COLOURS[method], capsize=4)
        ax.set_xticks(range(len(METHODS)), METHODS, rotation=20)
        ax.set_ylabel("hidden_nll, nats")
        ax.set_title(title)
    _draw_reliability(judged, reliability)
    ranks.hist(np.concatenate([j.ranks[POSTERIOR] for j in judged]), np.linspace(0, 1, 11), color=COLOURS[POSTERIOR])
    ranks.axhline(BOXES * len(judged) / 10, color="k", linestyle="--", linewidth=1)
    ranks.set(xlabel="rank of a box's volume (flat: calibrated)", ylabel="boxes", title="ranks of the posterior")

    axes = bottom.subplots(min(3, len(judged)), 2 + len(METHODS), squeeze=False)
    for row, j in zip(axes, judged, strict=False):
        v, u = np.nonzero(j.vessel.segment.mask)
        row[0].imshow(j.vessel.frame.rgb[max(v.min() - 20, 0) : v.max() + 20, max(u.min() - 20, 0) : u.max() + 20])
        row[0].set_title(f"the view (vessel {j.vessel.seed})", fontsize=9)
        # the level at which most of the true handle's unseen voxels lie
        part = j.vessel.solid & j.scored & j.vessel.near_handle
        level = int(part.sum(axis=(0, 1)).argmax())
        unseen = ~j.vessel.seen[:, :, level]
        shown = np.where(j.vessel.solid[:, :, level], 1.0, np.where(unseen, 0.35, 0.0))
        row[1].imshow(shown, origin="lower", cmap="Greys", vmin=0, vmax=1)
        row[1].set_title("truth (light grey: unseen)", fontsize=9)
        for ax, method in zip(row[2:], METHODS, strict=True):
            ax.imshow(j.probability[method][:, :, level], origin="lower", cmap="magma", vmin=0, vmax=1)
            ax.contour(j.vessel.solid[:, :, level], [0.5], colors="w", linewidths=0.8)
            ax.set_title(f"{method}: {j.values[method]['hidden_nll']:.3f} nats", fontsize=9)
        for ax in row:
            ax.set_axis_off()
    bottom.suptitle(
        "Level section through the hidden handle, camera at the top: probability of being occupied, truth in white"
    )
    return figure


def _draw_reliability(judged: Sequence[Judged], ax: Axes) -> None:
    """Frequency of occupancy against probability, all scored voxels of all vessels."""
    truth = np.concatenate([j.vessel.solid[j.scored] for j in judged])
    ax.plot([0, 1], [0, 1], "k--", linewidth=1)
    for method in METHODS:
        p = np.concatenate([j.probability[method][j.scored] for j in judged])
        bins = np.minimum((p * 10).astype(int), 9)
        count = np.bincount(bins, minlength=10)
        shown = count > 50
        mean, share = (np.bincount(bins, weights=w, minlength=10)[shown] / count[shown] for w in (p, truth))
        ax.plot(mean, share, "o-", color=COLOURS[method], label=method, markersize=4)
    ax.set(xlabel="probability", ylabel="share occupied", title="reliability, unseen voxels")
    ax.legend(fontsize=8)
