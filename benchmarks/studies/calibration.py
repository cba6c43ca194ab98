"""Does p_occupied mean what it says: the posterior and its rivals over unseen space, objects of every kind.

Test seeds, the whole path from frame to hypotheses, under the conditions of `scenes.conditions`. Prior, encoder and MAP
answer all of them; mean-field VI and the paper's annealed HMC (its last 16 states), which take long, the first `slow`.

Measures: as `farside bench hidden`, over unseen voxels whose training-set frequency lies in (0.02, 0.98), smoothed
alike. energy_score: of whole shapes, over all unseen voxels. hidden_ece here pools the voxels of all objects (15 bins);
voxels of one object err together, so that its 95% interval is a bootstrap over objects. mean_iou and best_of_8_iou are
of whole shapes. wrong_at_R: of the random unseen boxes with p_free of 1 - R or more, the share that is truly occupied;
free_at_R: the share of all boxes that they are. Ranks count the truth as one more draw, so that a single shape would
cover anything: MAP has none.

Results are appended to a file, object by object, and what is there is not made again.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.harness.intervals import mean_rows, paired_interval
from benchmarks.harness.progress import say, table
from benchmarks.harness.results import FOLDER, Line, append_line, digest, key, newest, read_lines
from benchmarks.harness.rows import Row
from benchmarks.measures.metrics import (
    ECE_BINS,
    best_of_k_iou,
    coverage,
    energy_score,
    falsely_free,
    ks_distance,
    mean_iou,
    scored_voxels,
    uniform_band,
)
from benchmarks.measures.scores import BOXES, Answer, random_boxes, score
from benchmarks.rivals.methods import PAPER, VI, Question, answer, settings_of
from benchmarks.rivals.quick import MAP, METHODS, POSTERIOR, RivalConfig, answers
from benchmarks.scenes.conditions import ANY, SORTS, views
from benchmarks.scenes.vessels import VesselView, base_rate
from perception.inference.settings import ControllerConfig
from probnerf.inference import likelihood_settings
from probnerf.prior.checkpoint import load_prior

RESULTS = FOLDER / "calibration.jsonl"
SLOW = {m.name: m for m in (VI, PAPER)}
PER_OBJECT = {
    "hidden_nll": "nats",
    "hidden_brier": "",
    "mean_iou": "",
    "best_of_8_iou": "",
    "energy_score": "",
    "seconds": "s",
}
RISKS = (0.02, 0.05, 0.1, 0.2)
COLOURS = dict(
    zip((*METHODS, *SLOW), ("tab:blue", "tab:gray", "tab:orange", "tab:red", "tab:purple", "tab:green"), strict=True)
)


def judged(view: VesselView, answer: Answer, rate: Float[np.ndarray, "32 32 32"], seed: int) -> dict[str, Any]:
    """One answer's line: measures, ranks, and the reliability histogram's sums."""
    scored = scored_voxels(view.seen, rate)
    rng = np.random.default_rng([seed, view.seed, 31])
    boxes = random_boxes(scored, BOXES, rng)
    found = score(view, answer, rate, boxes, rng)
    unseen = ~view.seen
    p, truth = found.probability[scored], view.solid[scored]
    bins = np.minimum((p * ECE_BINS).astype(int), ECE_BINS - 1)
    return {
        **{name: round(float(found.values[name]), 5) for name in ("hidden_nll", "hidden_brier")},
        "mean_iou": round(mean_iou(answer.shapes, answer.weights, view.solid), 4),
        "best_of_8_iou": round(best_of_k_iou(answer.shapes, answer.weights, view.solid, 8), 4),
        "energy_score": round(energy_score(answer.shapes[:, unseen], answer.weights, view.solid[unseen]), 5),
        "seconds": round(answer.seconds, 3),
        "result": answer.result,
        "ranks": found.ranks.round(4).tolist(),
        "p_free": found.p_free.round(4).tolist(),
        "occupied": found.occupied.astype(int).tolist(),
        "voxels": np.bincount(bins, minlength=ECE_BINS).tolist(),
        "probability": np.bincount(bins, weights=p, minlength=ECE_BINS).round(3).tolist(),
        "truth": np.bincount(bins, weights=truth, minlength=ECE_BINS).astype(int).tolist(),
    }


def main(
    out: Path,
    quick: bool = False,
    prior: Path | None = None,
    n: int = 100,
    slow: int = 24,
    conditions: str = "",
    seed: int = 0,
    results: Path = RESULTS,
    only_chart: bool = False,
) -> list[Row]:
    """Reliability of p_occupied in unseen space, ranks of volumes and scores, beside prior, encoder and MAP.

    Args:
        prior: weights to use; the shipped ones by default
        n: objects of each condition
        slow: of them, those that VI and the paper's annealed HMC answer, too
        conditions: only these, separated by semicolons: any view; any view, colour only; half hidden; ...
        seed: of the samplers
        results: file that results are appended to, and read from
        only_chart: draw what the file holds
    """
    if quick:
        n, slow, conditions = min(n, 2), 0, conditions or ANY
        results = out / "calibration.jsonl" if results == RESULTS else results
    asked = [c.strip() for c in conditions.split(";") if c.strip()] or list(SORTS)
    if unknown := set(asked) - set(SORTS):
        raise ValueError(f"no condition {sorted(unknown)}; there are: {'; '.join(SORTS)}")
    loaded, config, rivals = load_prior(prior), ControllerConfig(), RivalConfig()
    common = {"prior": loaded.hash, "seed": seed}
    settings = _settings(config, rivals, quick)
    if not only_chart:
        done = {key(line) for line in read_lines(results)}
        rates = {k: base_rate(128 if quick else 1024, config=config.observe, pose_known=k) for k in (False, True)}
        for condition, methods, count in ((c, m, k) for c in asked for m, k in ((METHODS, n), (tuple(SLOW), slow))):

            def missing(number: int, condition: str = condition, methods: Sequence[str] = methods) -> dict[str, Line]:
                own = {**common, "condition": condition, "object": number}
                lines = {m: {**own, "method": m, "settings": settings[m]} for m in methods}
                return {m: line for m, line in lines.items() if key(line) not in done}

            for number, view in views(condition, min(count, n), lambda number: not missing(number)):
                if view is None:
                    continue
                asked_of = missing(number)
                given = answers(view, loaded, config, rivals, seed, None, 240, [m for m in asked_of if m in METHODS])
                question = Question(view, loaded, config, seed)
                given |= {m: answer(SLOW[m], question)[0] for m in asked_of if m in SLOW}
                answered = {
                    m: {**asked_of[m], **judged(view, a, rates[view.pose_known], seed)} for m, a in given.items()
                }
                for line in answered.values():
                    append_line(results, line)
                say(f"{condition}, {number}: " + ", ".join(f"{m} {v['hidden_nll']:.3f}" for m, v in answered.items()))
    lines = _answered_by_all([x for x in newest(read_lines(results), loaded.hash, seed) if x["condition"] in asked])
    if not lines:
        raise ValueError(f"{results} has no results of this prior and these conditions; leave --only-chart")
    rows = _rows(lines)
    _draw(lines, out / "calibration.png")
    return rows


def _answered_by_all(lines: list[Line]) -> list[Line]:
    """Those of objects that every quick method has answered: the rivals' outlast a change of the sampler."""
    methods: dict[tuple[str, int], set[str]] = {}
    for line in lines:
        methods.setdefault((line["condition"], line["object"]), set()).add(line["method"])
    return [line for line in lines if methods[line["condition"], line["object"]] >= set(METHODS)]


def _settings(config: ControllerConfig, rivals: RivalConfig, quick: bool) -> dict[str, Line]:
    """What each method's answers depend on. The rivals' outlast a change of the sampler."""
    shared = [asdict(likelihood_settings(config.infer)), asdict(config.observe), config.grid, config.hypotheses]

    def told(*settings: object) -> Line:
        return {"digest": digest(settings, quick)}

    sampler = asdict(config)
    del sampler["out_of_model_below"]  # what is judged here are the hypotheses, flagged or not
    own = {m: told(sampler) if m == POSTERIOR else told(shared, asdict(rivals)) for m in METHODS}
    return {**own, **{m: settings_of(method, config) for m, method in SLOW.items()}}


def pooled_ece(lines: list[Line], resamples: int = 400) -> tuple[float, float, float]:
    """The error over all voxels of all objects, and its 95% bootstrap interval over objects."""
    truth, probability, voxels = (
        np.array([line[k] for line in lines], np.float64) for k in ("truth", "probability", "voxels")
    )

    def error(rows: np.ndarray) -> float:
        return float(np.abs((truth[rows] - probability[rows]).sum(axis=0)).sum() / voxels[rows].sum())

    rng = np.random.default_rng(0)
    drawn = [error(rng.integers(len(lines), size=len(lines))) for _ in range(resamples)]
    low, high = np.quantile(drawn, (0.025, 0.975))
    return error(np.arange(len(lines))), float(low), float(high)


def called_free(p_free: Float[np.ndarray, "n"], occupied: Bool[np.ndarray, "n"]) -> dict[str, float]:
    """What abstaining buys: of the boxes that are called free at each risk, the share that is not; and their share."""
    found = {}
    for risk in RISKS:
        called = p_free >= 1.0 - risk
        found[f"wrong_at_{risk:g}"] = float(occupied[called].mean()) if called.any() else float("nan")
        found[f"free_at_{risk:g}"] = float(called.mean())
    return found


def _rows(lines: list[Line]) -> list[Row]:
    rows, cells = [], []
    for condition in [c for c in SORTS if any(line["condition"] == c for line in lines)]:
        here = sorted((x for x in lines if x["condition"] == condition), key=lambda x: x["object"])
        by = {m: [x for x in here if x["method"] == m] for m in COLOURS if any(x["method"] == m for x in here)}
        reference = {x["object"]: x["hidden_nll"] for x in by[POSTERIOR]}
        for method, own in by.items():
            for metric, unit in PER_OBJECT.items():
                rows += mean_rows("calibration", method, condition, metric, [x[metric] for x in own], unit)
            ranks, p_free, occupied = (np.concatenate([x[k] for x in own]) for k in ("ranks", "p_free", "occupied"))
            ece = pooled_ece(own)
            pooled = {
                "hidden_ece": ece[0], "hidden_ece_q025": ece[1], "hidden_ece_q975": ece[2],
                "coverage90": coverage(ranks), "ks": ks_distance(ranks),
                "falsely_free": falsely_free(p_free, occupied.astype(bool)),
            }  # fmt: skip
            if method == MAP:
                pooled |= {"coverage90": np.nan, "ks": np.nan}
            pooled |= called_free(p_free, occupied.astype(bool))
            rows += [Row("calibration", method, condition, k, float(v), "", len(own)) for k, v in pooled.items()]
            gap = paired_interval(*np.array([(x["hidden_nll"], reference[x["object"]]) for x in own]).T)
            for label, value in (("", gap.mean), ("_q025", gap.low), ("_q975", gap.high)):
                rows.append(
                    Row("calibration", method, condition, f"hidden_nll_above_posterior{label}", value, "nats", gap.n)
                )
            mean = {m: float(np.mean([x[m] for x in own])) for m in PER_OBJECT}
            cells.append([
                f"{condition} ({len(own)})", method, *(f"{mean[m]:.3f}" for m in PER_OBJECT),
                f"{ece[0]:.3f} ({ece[1]:.3f}..{ece[2]:.3f})", f"{pooled['coverage90']:.3f}",
                f"{pooled['falsely_free']:.3f}",
                f"{pooled['wrong_at_0.05']:.3f} of {pooled['free_at_0.05']:.2f}",
                "" if method == POSTERIOR else f"{gap.low:+.3f}..{gap.high:+.3f}",
            ])  # fmt: skip
    header = (
        "condition",
        "method",
        *PER_OBJECT,
        "ece, pooled",
        "coverage90",
        "falsely_free",
        "wrong at 0.05",
        "nll above posterior's",
    )
    table("Unseen space", header, cells)
    return rows


def _draw(lines: list[Line], path: Path) -> None:
    """Per condition: reliability of every method; distribution of the posterior's ranks with its band. Three a row."""
    conditions = [c for c in SORTS if any(line["condition"] == c for line in lines)]
    columns, rows = min(3, len(conditions)), -(-len(conditions) // 3)
    figure = Figure(figsize=(4.6 * columns, 8 * rows), layout="constrained")
    axes = figure.subplots(2 * rows, columns, squeeze=False)
    pairs = [(axes[2 * r, c], axes[2 * r + 1, c]) for r in range(rows) for c in range(columns)]
    for top, bottom in pairs[len(conditions) :]:
        top.set_axis_off(), bottom.set_axis_off()
    for (top, bottom), condition in zip(pairs, conditions, strict=False):
        own = [line for line in lines if line["condition"] == condition]
        _reliability(top, own)
        objects = len({line["object"] for line in own})
        top.set(title=f"{condition}, {objects} objects", xlabel="p_occupied", ylabel="share occupied")
        ranks = np.concatenate([line["ranks"] for line in own if line["method"] == POSTERIOR])
        at, low, high = uniform_band(objects)  # boxes of one object err together: as if each had one
        bottom.fill_between(at, low - at, high - at, color="0.85", label="95% band, one box an object")
        bottom.plot(at, np.mean(ranks[:, None] <= at, axis=0) - at, color=COLOURS[POSTERIOR])
        bottom.axhline(0.0, color="k", linewidth=0.6)
        bottom.set(xlabel="rank of a box's true volume", ylabel="share below, less uniform", title="ranks, posterior")
        bottom.legend(fontsize=8, loc="upper left")
    axes[0, 0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def _reliability(ax: Axes, lines: list[Line]) -> None:
    ax.plot([0, 1], [0, 1], "k--", linewidth=1)
    for method in [m for m in COLOURS if any(line["method"] == m for line in lines)]:
        own = [line for line in lines if line["method"] == method]
        voxels, p, truth = (np.sum([line[k] for line in own], axis=0) for k in ("voxels", "probability", "truth"))
        shown = voxels > 200
        ax.plot(p[shown] / voxels[shown], truth[shown] / voxels[shown], "o-", color=COLOURS[method], label=method, ms=4)
