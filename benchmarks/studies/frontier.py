"""Accuracy against time of the posterior's sampler, its variants and its rivals, from one view.

The first vessels of the test seeds with a handle for which one view hides it and one shows it clearly
(`scenes.vessels`), each with depth and without. Views that perception refuses are left out. The methods are those of
`rivals.methods`, all smoothed alike, each timed on one object at a time, with programs compiled before.

- hidden_nll, hidden_nll_handle, coverage90, ks, falsely_free: as in `farside bench hidden`. All methods get the same
  boxes. The frequency of occupancy is that of RGB-D's widths in all conditions.
- psnr_heldout: the object alone on white, from behind and from one side, 48 x 48 pixels, mean over 8 hypotheses drawn
  by weight. psnr_heldout_of_mean: of their mean picture. psnr_given: from the view's own place.
- seconds: of one object, from frame to solid grids. work: seconds times the speed of the machine's matrix product
  beside them, for comparison with another machine.
- point_gradients: see `rivals.methods`. The encoder alone has point_evaluations.
- hidden_nll_above_paper, _above_base: paired over objects with the paper's full schedule, and with one run of the
  sampler. A lever changes one thing of that run (delta is added to the run that begins at the prior).
- over all conditions: the mean of each vessel's four conditions, which are not independent, beside the paper's
  schedule; and the ratio of costs, fewer_point_gradients and less_work.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch

import numpy as np

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.machine import matrix_speed
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, newest, objects_of, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.metrics import coverage, falsely_free, ks_distance, scored_voxels
from benchmarks.measures.scores import BOXES, picture_psnr, random_boxes, score
from benchmarks.rivals.methods import CONDITIONS, DEPTHS, FULL, METHODS, Method, Question, answer, settings_of
from benchmarks.scenes.vessels import base_rate, vessel_picture, vessel_view
from benchmarks.studies.frontier_chart import draw_frontier
from perception.inference.settings import ControllerConfig
from probnerf.inference import without_sizes
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import Prior, load_prior

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


@dataclass(frozen=True)
class Options(PriorOptions):
    """Accuracy against time on one picture: hidden and informative views, with depth and without."""

    n: int = 24
    """Vessels, the first so many."""
    methods: str = ""
    """Only these: names, groups or patterns with *, separated by semicolons."""
    conditions: str = ""
    """Only these: patterns such as hidden*;*RGB-D."""

    @property
    def chosen(self) -> tuple[list[Method], list[str]]:
        """Methods and conditions that are asked for. Raises ValueError where there is none."""
        methods = [m for m in METHODS if _matches((m.name, m.group), self.methods)]
        conditions = [c for c in CONDITIONS if _matches((c,), self.conditions)]
        if not methods or not conditions:
            names = "; ".join((*(m.name for m in METHODS), *CONDITIONS))
            raise ValueError(f"no method {self.methods!r} or condition {self.conditions!r}; there are: {names}")
        return methods, conditions


ALSO = (Options(n=48, methods=f"{FULL};smc;controller, 10 stages;smc, 3 runs;smc, 6 runs", conditions=CONDITIONS[0]),)


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        methods, conditions = options.methods or "encoder;map;smc", options.conditions or CONDITIONS[0]
        options = replace(options, n=1, methods=methods, conditions=conditions)
    _ = options.chosen  # a mistyped name is refused before anything is loaded
    prior, results = load_prior(options.prior), results_of("frontier", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _matches(names: Sequence[str], patterns: str) -> bool:
    each = [p.strip() for p in patterns.split(";") if p.strip()]
    return not each or any(fnmatch(name, p) for name in names for p in each)


def _measure(options: Options, prior: Prior, results: Results) -> None:
    """Every method on every condition of every vessel that the file lacks, vessel by vessel."""
    config, rate = ControllerConfig(), None
    methods, conditions = options.chosen
    known = {line["object"] for line in results.lines}
    warm: set[tuple] = set()
    vessels = 0
    for number in TEST_SEEDS:
        if vessels == options.n:
            break
        common = {"prior": prior.identity, "object": number, "seed": options.seed}
        missing = [
            {"method": m.name, "settings": settings_of(m, config), "condition": c, **common}
            for c in conditions
            for m in methods
            if c in m.conditions and _refusal(c, common) not in results
        ]
        missing = [line for line in missing if line not in results]
        if not missing and number in known:
            vessels += 1
            continue
        hidden = vessel_picture(number, "hidden")
        informative = None if hidden is None else vessel_picture(number, "informative")
        if hidden is None or informative is None:
            continue
        vessels += 1
        rate = base_rate(config=config.observe) if rate is None else rate
        for condition in conditions:
            left = [line for line in missing if line["condition"] == condition]
            if not left:
                continue
            handle, depth = condition.split(", ")
            try:
                view = vessel_view(hidden if handle == "hidden" else informative, depth == DEPTHS[0])
            except ValueError as error:
                say(f"vessel {number}, {condition}: left out, {error}")
                results.add({**_refusal(condition, common), "result": str(error)})
                continue
            for line in left:
                method = next(m for m in methods if m.name == line["method"])
                found = _one(method, Question(view, prior, config, options.seed), rate, depth, warm)
                results.add({**line, **found})
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


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the methods, conditions and vessels that are asked for; None where there are no rows of them."""
    methods, conditions = options.chosen
    vessels, names = sorted(objects_of(lines))[: options.n], {m.name for m in methods}
    lines = [x for x in lines if x["object"] in vessels and x["condition"] in conditions and x["method"] in names]
    if not lines:
        return None
    rows = []
    for condition in CONDITIONS:
        here = [line for line in lines if line["condition"] == condition]
        score = {(line["method"], line["object"]): line["hidden_nll"] for line in here}
        for method in METHODS:
            own = [line for line in here if line["method"] == method.name]
            if own:
                rows += _method_rows(method, condition, own, score)
    rows += _over_all(lines)
    return Summary(rows, _tables(Figures(rows)), lambda: draw_frontier(rows))


def _over_all(lines: Sequence[Line]) -> list[Row]:
    """Of methods that answered every condition of a vessel, as the paper's schedule did."""
    of = {(line["method"], line["condition"], line["object"]): line for line in lines}
    rows = []
    for method in METHODS:
        vessels = [
            v
            for v in sorted(objects_of(lines))
            if all((name, c, v) in of for name in (method.name, FULL) for c in CONDITIONS)
        ]
        if not vessels:
            continue
        both = [[[of[name, c, v] for c in CONDITIONS] for v in vessels] for name in (method.name, FULL)]
        own, paper = (np.array([[x["hidden_nll"] for x in each] for each in one]).mean(axis=1) for one in both)
        rows += mean_rows("frontier", method.name, OVER_ALL, "hidden_nll", own, "nats")
        if method.name != FULL:
            rows += gap_rows("frontier", method.name, OVER_ALL, "hidden_nll_above_paper", own, paper)
            cost = np.array(
                [[[(x["point_gradients"], x["seconds"] * x["gflops"]) for x in each] for each in one] for one in both]
            ).sum(axis=(1, 2))
            for name, mine, theirs in zip(("fewer_point_gradients", "less_work"), *cost, strict=True):
                if mine > 0:  # the encoder takes no gradients
                    rows.append(Row("frontier", method.name, OVER_ALL, name, float(theirs / mine), "", len(own)))
    return rows


def _method_rows(entry: Method, condition: str, own: Sequence[Line], score: dict[tuple[str, int], float]) -> list[Row]:
    """One method's rows; `score` is the hidden_nll of every method and object."""
    name, method, rows = "frontier", entry.name, list[Row]()
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
    for word, other in (("paper", FULL), ("base", entry.base)):
        both = [(x["hidden_nll"], score[other, x["object"]]) for x in own if (other, x["object"]) in score]
        if both and method != other:
            rows += gap_rows(name, method, condition, f"hidden_nll_above_{word}", *np.array(both).T)
    return rows


def _tables(of: Figures) -> list[Table]:
    """Over all conditions, with the gates of the controller; each condition; levers."""
    groups = {m.name: m for m in METHODS}
    tables: list[Table] = []
    header: tuple[str, ...]
    if OVER_ALL in of.conditions():
        cells = []
        for name in of.methods(OVER_ALL):
            fewer, less = (of(OVER_ALL, name, m) for m in ("fewer_point_gradients", "less_work"))
            gap = of.interval(OVER_ALL, name, "hidden_nll_above_paper")
            texts = [ranged(gap, sign="+"), f"{fewer:.1f}"] if name != FULL else ["", ""]
            if groups[name].group in ("controller", "stages"):
                texts = [gated(texts[0], gap.high, most=0.01), gated(texts[1], fewer, least=20.0)]
            nll = of.interval(OVER_ALL, name, "hidden_nll")
            cells.append([name, str(nll.n), f"{nll.mean:.3f}", *texts, "" if name == FULL else f"{less:.1f}"])
        header = (
            "method", "vessels", "hidden_nll", "above the paper's, gate: upper end <= 0.01",
            "field evaluations, the paper's over its, gate >= 20", "work, the paper's over its",
        )  # fmt: skip
        tables.append(Table("Over all conditions together", header, _blank(cells)))
    shown = {"hidden_nll": 3, "hidden_nll_handle": 2, "seconds": 1, "psnr_heldout": 1, "psnr_heldout_of_mean": 1}
    shown |= {"coverage90": 2, "falsely_free": 2}
    for condition in [c for c in of.conditions() if c != OVER_ALL]:
        cells = []
        for name in of.methods(condition):
            gap = of.interval(condition, name, "hidden_nll_above_paper")
            cells.append([
                name, str(of.count(condition, name, "hidden_nll")),
                *(f"{of(condition, name, m):.{digits}f}" for m, digits in shown.items()),
                f"{of(condition, name, 'point_gradients'):.2e}", ranged(gap, sign="+") if gap.n else "",
            ])  # fmt: skip
        header = ("method", "n", *shown, "point_gradients", "hidden_nll above the paper's")
        tables.append(Table(condition, header, _blank(cells)))
    cells = []
    for condition in [c for c in of.conditions() if c != OVER_ALL]:
        for method in (m for m in METHODS if m.base != m.name and m.group in ("lever off", "smc")):
            gap = of.interval(condition, method.name, "hidden_nll_above_base")
            if gap.n:
                gradients = [of(condition, name, "point_gradients") for name in (method.name, method.base)]
                cells.append(
                    [method.name, method.base, str(gap.n), ranged(gap, sign="+"), f"{gradients[0] / gradients[1]:.1f}"]
                )
    if cells:
        header = ("lever", "beside", "vessels", "hidden_nll above it", "field evaluations over its")
        tables.append(Table(f"Levers, one at a time, {CONDITIONS[0]}", header, cells))
    return tables


def _blank(cells: list[list[str]]) -> list[list[str]]:
    """A figure that there is none of is an empty cell."""
    return [["" if cell == "nan" else cell for cell in row] for row in cells]
