"""The frontier: accuracy against time of the posterior's sampler, its shortcuts and its rivals, from one view.

The first vessels of the test seeds with a handle for which there is a view that hides it and one that shows it clearly
(`scenes.vessels`), each with depth and without; what perception refuses is left out. Methods are those of
`rivals.methods`, all smoothed alike, each timed on one object at a time, compiled before. Measures:

- hidden_nll, hidden_nll_handle, coverage90, ks, falsely_free: as `farside bench hidden`. Boxes are the same for all
  methods. The frequency of occupancy is that of RGB-D's widths in all conditions.
- psnr_heldout: the object alone on white, from behind and from one side, 48 x 48 pixels, mean over 8 hypotheses drawn
  by weight; psnr_heldout_of_mean: of their mean picture; psnr_given: from the view's own place.
- seconds: of one object, from frame to solid grids; work: seconds x the speed of the machine's matrix product beside
  them, which another machine can be compared by.
- point_gradients: see `rivals.methods`. The encoder alone has point_evaluations.
- hidden_nll_above_paper, _above_base: paired over objects with the paper's full schedule, and with one run of the
  sampler, from which levers are taken one at a time (delta is added to the one that begins at the prior).
- over all conditions: each vessel's mean of them, which are not independent, beside the paper's schedule's, and how
  many times more it takes: fewer_point_gradients, less_work.

Results are appended to a file, vessel by vessel, and what is there is not made again: Ctrl-C any time, and go on later.
"""

import json
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from benchmarks.harness.intervals import mean_rows, paired_interval
from benchmarks.harness.machine import matrix_speed
from benchmarks.harness.progress import say, table
from benchmarks.harness.results import FOLDER, Line, append_line, key, newest, read_lines, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.measures.metrics import coverage, falsely_free, ks_distance, scored_voxels
from benchmarks.measures.scores import BOXES, picture_psnr, random_boxes, score
from benchmarks.rivals.methods import CONDITIONS, DEPTHS, FULL, METHODS, Method, Question, answer, settings_of
from benchmarks.scenes.vessels import base_rate, vessel_picture, vessel_view
from benchmarks.studies.frontier_chart import draw_frontier
from perception.inference.settings import ControllerConfig
from probnerf.inference import without_sizes
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import Prior, load_prior

RESULTS = FOLDER / "frontier.jsonl"
UNITS = {
    "hidden_nll": "nats",
    "hidden_nll_handle": "nats",
    "psnr_heldout": "dB",
    "psnr_heldout_of_mean": "dB",
    "psnr_given": "dB",
    "psnr_given_of_mean": "dB",
    "seconds": "s",
    "work": "TFLOP",
    "point_gradients": "",
    "point_evaluations": "",
}
OVER_ALL = "over all conditions"
REFUSED = "perception"  # the method of a line that says why a view is left out


def main(
    out: Path,
    quick: bool = False,
    prior: Path | None = None,
    n: int = 24,
    methods: str = "",
    conditions: str = "",
    seed: int = 0,
    results: Path = RESULTS,
    only_chart: bool = False,
) -> list[Row]:
    """Accuracy against time on one picture: hidden and informative views, with depth and without.

    Args:
        prior: weights to use; the shipped ones by default
        n: vessels, the first so many
        methods: only these: names, groups or patterns with *, separated by semicolons
        conditions: only these: patterns such as hidden*;*RGB-D
        seed: of the samplers
        results: file that results are appended to, and read from
        only_chart: draw what the file holds
    """
    if quick:
        n, methods, conditions = 1, methods or "encoder;map;smc", conditions or CONDITIONS[0]
        results = out / "frontier.jsonl" if results == RESULTS else results
    chosen = [m for m in METHODS if _matches((m.name, m.group), methods)]
    asked = [c for c in CONDITIONS if _matches((c,), conditions)]
    if not chosen or not asked:
        names = "; ".join((*(m.name for m in METHODS), *CONDITIONS))
        raise ValueError(f"no method {methods!r} or condition {conditions!r}; there are: {names}")
    loaded = load_prior(prior)
    if not only_chart:
        try:
            _measure(loaded, chosen, asked, n, seed, results)
        except KeyboardInterrupt:
            say(f"stopped; {results} keeps what is done")
    lines = newest(read_lines(results), loaded.hash, seed)
    vessels = sorted({line["object"] for line in lines})[:n]
    lines = [line for line in lines if line["condition"] in asked and line["object"] in vessels]
    lines = [line for line in lines if line["method"] in {m.name for m in chosen}]
    if not lines:
        raise ValueError(f"{results} has no results of this prior, these methods and conditions; leave --only-chart")
    rows = _rows(lines)
    _print(rows)
    draw_frontier(rows, out / "frontier.png")
    return rows


def _matches(names: Sequence[str], patterns: str) -> bool:
    asked = [p.strip() for p in patterns.split(";") if p.strip()]
    return not asked or any(fnmatch(name, p) for name in names for p in asked)


def _measure(prior: Prior, methods: list[Method], conditions: list[str], n: int, seed: int, results: Path) -> None:
    """Every method on every condition of every vessel that the file lacks, vessel by vessel."""
    config, rate = ControllerConfig(), None
    done = {key(line) for line in read_lines(results)}
    known = {json.loads(k[4]) for k in done}
    warm: set[tuple] = set()
    vessels = 0
    for number in TEST_SEEDS:
        if vessels == n:
            break
        common = {"prior": prior.hash, "object": number, "seed": seed}
        asked = [
            {"method": m.name, "settings": settings_of(m, config), "condition": c, **common}
            for c in conditions
            for m in methods
            if c in m.conditions and key(_refusal(c, common)) not in done
        ]
        asked = [line for line in asked if key(line) not in done]
        if not asked and number in known:
            vessels += 1
            continue
        hidden = vessel_picture(number, "hidden")
        informative = None if hidden is None else vessel_picture(number, "informative")
        if hidden is None or informative is None:
            continue
        vessels += 1
        rate = base_rate(config=config.observe) if rate is None else rate
        for condition in conditions:
            left = [line for line in asked if line["condition"] == condition]
            if not left:
                continue
            handle, depth = condition.split(", ")
            try:
                view = vessel_view(hidden if handle == "hidden" else informative, depth == DEPTHS[0])
            except ValueError as error:
                say(f"vessel {number}, {condition}: left out, {error}")
                append_line(results, {**_refusal(condition, common), "result": str(error)})
                continue
            for line in left:
                method = next(m for m in methods if m.name == line["method"])
                found = _one(method, Question(view, prior, config, seed), rate, depth, warm)
                append_line(results, {**line, **found})
                say(
                    f"vessel {number} ({vessels}), {condition}: {method.name}: {found['hidden_nll']:.3f} nats,"
                    f" {found['psnr_heldout']:.1f} dB, {found['seconds']:.1f} s {found['result']}"
                )


def _refusal(condition: str, common: Line) -> Line:
    return {"method": REFUSED, "settings": {}, "condition": condition, **common}


def _one(method: Method, question: Question, rate: np.ndarray, depth: str, warm: set[tuple]) -> Line:
    """One method's answer to one view, measured. Raises KeyboardInterrupt where the sampler met Ctrl-C."""
    sizes = (method.programs or method.name, depth, question.likelihood.lattice.crossings, *question.likelihood.packed)
    if sizes not in warm:
        refuse_cut(answer(method, question, short=True)[0].result)
        warm.add(sizes)
    speed = matrix_speed(2048)
    # anew: what a question keeps of its observation is part of the time
    question = Question(question.view, question.prior, question.config, question.seed)
    found, sampled, positions = answer(method, question)
    refuse_cut(found.result)
    view = question.view
    rng = np.random.default_rng([question.seed, view.seed, 31])
    boxes = random_boxes(scored_voxels(view.seen, rate), BOXES, rng)
    scored = score(view, found, rate, boxes, rng)
    sizeless, pose_sigma = without_sizes(sampled.likelihood), sampled.observation.pose_sigma
    pictures = picture_psnr(view, question.prior.model, sizeless, positions, found.weights, pose_sigma)
    values = {
        **scored.values,
        **pictures,
        "seconds": found.seconds,
        "gflops": speed,
        "point_gradients": sampled.point_gradients,
        "point_evaluations": sampled.point_evaluations,
    }
    return {
        **{name: float(f"{value:.6g}") for name, value in values.items() if np.isfinite(value)},
        "ranks": np.round(scored.ranks, 4).tolist(),
        "p_free": np.round(scored.p_free, 4).tolist(),
        "occupied": scored.occupied.astype(int).tolist(),
        "result": found.result,
    }


def _rows(lines: Sequence[Line]) -> list[Row]:
    rows = []
    for condition in CONDITIONS:
        here = [line for line in lines if line["condition"] == condition]
        score = {(line["method"], line["object"]): line["hidden_nll"] for line in here}
        for method in METHODS:
            own = [line for line in here if line["method"] == method.name]
            if own:
                rows += _method_rows(method, condition, own, score)
    return rows + _over_all(lines)


def _over_all(lines: Sequence[Line]) -> list[Row]:
    """Of methods that answered every condition of a vessel, as the paper's schedule did."""
    of = {(line["method"], line["condition"], line["object"]): line for line in lines}
    rows = []
    for method in METHODS:
        vessels = [
            v
            for v in sorted({line["object"] for line in lines})
            if all((name, c, v) in of for name in (method.name, FULL) for c in CONDITIONS)
        ]
        if not vessels:
            continue
        both = [[[of[name, c, v] for c in CONDITIONS] for v in vessels] for name in (method.name, FULL)]
        own, paper = (np.array([[x["hidden_nll"] for x in each] for each in one]).mean(axis=1) for one in both)
        rows += mean_rows("frontier", method.name, OVER_ALL, "hidden_nll", own, "nats")
        if method.name != FULL:
            gap = paired_interval(own, paper)
            for label, value in (("", gap.mean), ("_q025", gap.low), ("_q975", gap.high)):
                name = f"hidden_nll_above_paper{label}"
                rows.append(Row("frontier", method.name, OVER_ALL, name, value, "nats", gap.n))
            cost = np.array(
                [[[(x["point_gradients"], x["seconds"] * x["gflops"]) for x in each] for each in one] for one in both]
            ).sum(axis=(1, 2))
            for name, mine, theirs in zip(("fewer_point_gradients", "less_work"), *cost, strict=True):
                if mine > 0:  # the encoder takes no gradients
                    rows.append(Row("frontier", method.name, OVER_ALL, name, float(theirs / mine), "", gap.n))
    return rows


def _method_rows(asked: Method, condition: str, own: Sequence[Line], score: dict[tuple[str, int], float]) -> list[Row]:
    """One method's rows; `score` is the hidden_nll of every method and object."""
    name, method, rows = "frontier", asked.name, list[Row]()
    for metric, unit in UNITS.items():
        values = [line.get(metric, np.nan) for line in own]
        if metric == "work":
            values = [1e-3 * line["seconds"] * line["gflops"] for line in own]
        rows += mean_rows(name, method, condition, metric, values, unit)
    each = [coverage(np.array(line["ranks"])) for line in own]  # over objects, whose boxes are not independent
    rows += mean_rows(name, method, condition, "coverage90", each, "")
    ranks, p_free, occupied = (np.concatenate([line[k] for line in own]) for k in ("ranks", "p_free", "occupied"))
    rows.append(Row(name, method, condition, "ks", ks_distance(ranks), "", len(ranks)))
    rows.append(Row(name, method, condition, "falsely_free", falsely_free(p_free, occupied > 0), "", len(ranks)))
    for word, other in (("paper", FULL), ("base", asked.base)):
        both = [(x["hidden_nll"], score[other, x["object"]]) for x in own if (other, x["object"]) in score]
        if not both or method == other:
            continue
        gap = paired_interval(*np.array(both).T)
        for label, value in (("", gap.mean), ("_q025", gap.low), ("_q975", gap.high)):
            rows.append(Row(name, method, condition, f"hidden_nll_above_{word}{label}", value, "nats", gap.n))
    return rows


def _print(rows: Sequence[Row]) -> None:
    value = {(row.condition, row.method, row.metric): row for row in rows}
    shown = ("hidden_nll", "hidden_nll_handle", "psnr_heldout", "psnr_heldout_of_mean", "coverage90", "falsely_free")
    for condition in dict.fromkeys(row.condition for row in rows if row.condition != OVER_ALL):
        lines = []
        for method in dict.fromkeys(row.method for row in rows if row.condition == condition):
            row = {metric: r for (c, m, metric), r in value.items() if (c, m) == (condition, method)}
            gaps = []
            for word in ("paper", "base"):
                ends = [row.get(f"hidden_nll_above_{word}{end}") for end in ("", "_q025", "_q975")]
                mean, low, high = (f"{end.value:+.3f}" if end else "" for end in ends)
                gaps.append(f"{mean} ({low} .. {high})" if mean else "")
            cells = [f"{row[m].value:.3f}" if m in row else "" for m in shown]
            cost = [f"{row['seconds'].value:.2f}", f"{row['work'].value:.2f}", f"{row['point_gradients'].value:.2e}"]
            lines.append([method, str(row["hidden_nll"].n), *cells, *cost, *gaps])
        header = (
            "method",
            "n",
            *shown,
            "seconds",
            "work, TFLOP",
            "point_gradients",
            "nll above the paper's",
            "above smc's (delta: from the prior's)",
        )
        table(condition, header, lines)
    lines = []
    for method in dict.fromkeys(row.method for row in rows if row.condition == OVER_ALL):
        names = ("hidden_nll", *(f"hidden_nll_above_paper{end}" for end in ("", "_q025", "_q975")))
        found = [value.get((OVER_ALL, method, name)) for name in (*names, "fewer_point_gradients", "less_work")]
        cells = [f"{row.value:.{d}f}" if row else "" for row, d in zip(found, (3, 3, 3, 3, 1, 1), strict=True)]
        lines.append([method, str(value[OVER_ALL, method, "hidden_nll"].n), *cells])
    if lines:
        ratios = ("fewer point_gradients", "less work")
        table(OVER_ALL, ("method", "n", "hidden_nll", "above the paper's", "from", "to", *ratios), lines)
