"""Whether p_occupied is calibrated in unseen space: the posterior and its rivals on objects of every kind.

Test seeds, and the whole path from frame to hypotheses, under the conditions of `scenes.conditions`. Prior, encoder
and MAP answer all of them. Mean-field VI and the paper's annealed HMC (its last 16 states) take long and answer the
first `slow` ones.

- hidden_nll, hidden_brier: as in `farside bench hidden`, over unseen voxels whose training-set frequency lies in
  (0.02, 0.98), with the same smoothing.
- energy_score: of whole shapes, over all unseen voxels.
- hidden_ece: pools the voxels of all objects in 15 bins. Voxels of one object err together, so its 95% interval is a
  bootstrap over objects.
- mean_iou, best_of_8_iou: of whole shapes.
- coverage90: share of the boxes whose true volume lies in the central 90% of the answer's. Ranks count the truth as
  one more draw, so a single shape would cover everything: MAP has no rank.
- wrong_at_R, free_at_R: of the random unseen boxes with p_free of 1 - R or more, the share that is truly occupied; and
  their share of all boxes.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, PairedInterval, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, objects_of
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed, selected
from benchmarks.harness.tables import Table, between, gated, ranged
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
from benchmarks.rivals.quick import ENCODER, MAP, METHODS, POSTERIOR, PRIOR, RivalConfig, answers
from benchmarks.scenes.conditions import ANY, SORTS, views
from benchmarks.scenes.vessels import VesselView, base_rate
from perception.inference.settings import ControllerConfig
from probnerf.inference import likelihood_settings
from probnerf.prior.checkpoint import Prior, load_prior

SLOW = {m.name: m for m in (VI, PAPER)}
PER_OBJECT = {
    "hidden_nll": "nats",
    "hidden_brier": "",
    "mean_iou": "",
    "best_of_8_iou": "",
    "energy_score": "",
    "seconds": "s",
}
GATE_ECE, GATE_COVERAGE, GATE_WRONG = 0.03, (0.87, 0.93), 0.05  # of the posterior
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


@dataclass(frozen=True)
class Options(PriorOptions):
    """Reliability of p_occupied in unseen space, ranks of volumes and scores, beside prior, encoder and MAP."""

    n: int = 100
    """Objects of each condition."""
    slow: int = 24
    """Of them, those that VI and the paper's annealed HMC answer, too."""
    conditions: str = ""
    """Only these, separated by semicolons: any view; any view, colour only; half hidden; ..."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=min(options.n, 2), slow=0, conditions=options.conditions or ANY)
    selected(options.conditions, list(SORTS), "condition")
    prior, results = load_prior(options.prior), results_of("calibration", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config, rivals, seed = ControllerConfig(), RivalConfig(), options.seed
    common = {"prior": prior.identity, "seed": seed}
    settings = _settings(config, rivals, options.quick)
    rates = {k: base_rate(128 if options.quick else 1024, config=config.observe, pose_known=k) for k in (False, True)}
    conditions = selected(options.conditions, list(SORTS), "condition")
    for condition, methods, count in (
        (c, m, k) for c in conditions for m, k in ((METHODS, options.n), (tuple(SLOW), options.slow))
    ):

        def missing(number: int, condition: str = condition, methods: tuple[str, ...] = methods) -> dict[str, Line]:
            own = {**common, "condition": condition, "object": number}
            lines = {m: {**own, "method": m, "settings": settings[m]} for m in methods}
            return {m: line for m, line in lines.items() if line not in results}

        for number, view in views(condition, min(count, options.n), lambda number: not missing(number)):
            if view is None:
                continue
            missing_lines = missing(number)
            given = answers(view, prior, config, rivals, seed, None, 240, [m for m in missing_lines if m in METHODS])
            question = Question(view, prior, config, seed)
            given |= {m: answer(SLOW[m], question)[0] for m in missing_lines if m in SLOW}
            judgements = {m: judged(view, a, rates[view.pose_known], seed) for m, a in given.items()}
            for method, found in judgements.items():
                results.add({**missing_lines[method], **found})
            say(f"{condition}, {number}: " + ", ".join(f"{m} {v['hidden_nll']:.3f}" for m, v in judgements.items()))


def _answered_by_all(lines: list[Line]) -> list[Line]:
    """Those of objects that every quick method has answered: the rivals' outlast a change of the sampler."""
    methods: dict[tuple[str, int], set[str]] = {}
    for line in lines:
        methods.setdefault((line["condition"], line["object"]), set()).add(line["method"])
    return [line for line in lines if methods[line["condition"], line["object"]] >= set(METHODS)]


def _settings(config: ControllerConfig, rivals: RivalConfig, quick: bool) -> dict[str, Line]:
    """What each method's answers depend on. The rivals' outlast a change of the sampler."""
    observe = asdict(config.observe)
    del observe["choices"]  # the rivals are given one
    shared = [asdict(likelihood_settings(config.infer)), observe, config.grid, config.hypotheses]

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


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the conditions that are asked for, of each its first `n` objects; None where there are no rows."""
    conditions = selected(options.conditions, list(SORTS), "condition")
    lines = _answered_by_all([line for line in lines if line["condition"] in conditions])
    first = {c: sorted({line["object"] for line in lines if line["condition"] == c})[: options.n] for c in conditions}
    lines = [line for line in lines if line["object"] in first[line["condition"]]]
    if not lines:
        return None
    rows = _rows(lines)
    return Summary(rows, _tables(Figures(rows)), lambda: _draw(lines))


def _rows(lines: list[Line]) -> list[Row]:
    rows = []
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
            both = np.array([(x["hidden_nll"], reference[x["object"]]) for x in own]).T
            rows += gap_rows("calibration", method, condition, "hidden_nll_above_posterior", *both)
    return rows


def _tables(of: Figures) -> list[Table]:
    """Scores, reliability, whole shapes, and the two slow rivals; gates are the posterior's."""
    conditions = of.conditions()
    named = {c: f"{c} ({of.count(c, POSTERIOR, 'hidden_nll')})" for c in conditions}
    scores, worth, shapes, slow = [], [], [], []
    for c in conditions:
        quick = [of.interval(c, m, "hidden_nll_above_posterior") for m in METHODS if m != POSTERIOR]
        best = min(quick, key=lambda gap: gap.mean)
        nll = [f"{of(c, m, 'hidden_nll'):.3f}" for m in (POSTERIOR, ENCODER, MAP, PRIOR)]
        scores.append([named[c], *nll, gated(between(best, sign="+"), best.low, least=0.0)])
        shown = (POSTERIOR, ENCODER, MAP)
        shapes.append([
            named[c], *(" / ".join(f"{of(c, m, k):.{d}f}" for m in shown)
                        for k, d in (("energy_score", 3), ("best_of_8_iou", 2), ("mean_iou", 2))),
        ])  # fmt: skip
        for m in shown if c == ANY else (POSTERIOR,):
            ece, inside, wrong = (of(c, m, k) for k in ("hidden_ece", "coverage90", "wrong_at_0.05"))
            ends = PairedInterval(ece, of(c, m, "hidden_ece_q025"), of(c, m, "hidden_ece_q975"), 0)
            texts = [
                ranged(ends),
                "" if np.isnan(inside) else f"{inside:.3f}",
                f"{wrong:.3f} ({of(c, m, 'free_at_0.05'):.0%})",
            ]
            if m == POSTERIOR:
                gates = ((ece, 0.0, GATE_ECE), (inside, *GATE_COVERAGE), (wrong, 0.0, GATE_WRONG))
                texts = [gated(text, *gate) for text, gate in zip(texts, gates, strict=True)]
            worth.append([named[c], m, *texts])
        for m in [m for m in SLOW if (c, m, "hidden_nll") in of]:
            gap = of.interval(c, m, "hidden_nll_above_posterior")
            slow.append([
                f"{c} ({gap.n})", m, gated(between(gap, sign="+"), gap.low, least=0.0),
                f"{of(c, m, 'coverage90'):.2f}", f"{of(c, m, 'wrong_at_0.05'):.2f}",
            ])  # fmt: skip
    wrong_of = "of boxes called free at a risk of 0.05, those that are not (share called), gate <= 0.05"
    return [
        Table(
            "Means of hidden_nll, nats a voxel; lower is better",
            ("condition (objects)", *(POSTERIOR, ENCODER, MAP, PRIOR), "best rival less the posterior, gate > 0"),
            scores,
        ),
        Table(
            "What the probabilities are worth",
            ("condition (objects)", "method", "hidden_ece, gate <= 0.03", "coverage90, gate 0.87 to 0.93", wrong_of),
            worth,
        ),
        Table(
            f"Whole shapes: {POSTERIOR} / {ENCODER} / {MAP}",
            ("condition (objects)", "energy score, lower is better", "best of 8, IoU", "mean IoU"),
            shapes,
        ),
        *(
            [
                Table(
                    "The slow rivals, on the first objects of each condition",
                    (
                        "condition (objects)", "method", "hidden_nll above the posterior's, gate > 0", "coverage90",
                        "called free at 0.05 and not",
                    ),
                    slow,
                )
            ]
            if slow
            else []
        ),
    ]  # fmt: skip


def _draw(lines: list[Line]) -> Figure:
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
        objects = len(objects_of(own))
        top.set(title=f"{condition}, {objects} objects", xlabel="p_occupied", ylabel="share occupied")
        ranks = np.concatenate([line["ranks"] for line in own if line["method"] == POSTERIOR])
        at, low, high = uniform_band(objects)  # boxes of one object err together: as if each had one
        bottom.fill_between(at, low - at, high - at, color="0.85", label="95% band, one box an object")
        bottom.plot(at, np.mean(ranks[:, None] <= at, axis=0) - at, color=COLOURS[POSTERIOR])
        bottom.axhline(0.0, color="k", linewidth=0.6)
        bottom.set(xlabel="rank of a box's true volume", ylabel="share below, less uniform", title="ranks, posterior")
        bottom.legend(fontsize=8, loc="upper left")
    axes[0, 0].legend(fontsize=8)
    return figure


def _reliability(ax: Axes, lines: list[Line]) -> None:
    ax.plot([0, 1], [0, 1], "k--", linewidth=1)
    for method in [m for m in COLOURS if any(line["method"] == m for line in lines)]:
        own = [line for line in lines if line["method"] == method]
        voxels, p, truth = (np.sum([line[k] for line in own], axis=0) for k in ("voxels", "probability", "truth"))
        shown = voxels > 200
        ax.plot(p[shown] / voxels[shown], truth[shown] / voxels[shown], "o-", color=COLOURS[method], label=method, ms=4)
