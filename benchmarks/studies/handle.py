"""Is a handle behind it? The probability that the answer's shapes give, against how often there is one.

Cups, mugs and pitchers without a pixel of a handle, not selected by whether there is one ("no handle in sight" of
`scenes.conditions`): test seeds, RGB-D, the whole path. A shape of an answer has a handle if it reaches farther than
REACH from the true body where nobody saw (`reach`), as every true handle does. p is the share of the answer's weight on
such shapes.

- p, share: the mean p and the share of objects with a handle, over all objects and in bins of p.
- log_score, brier: of p.
- hidden_nll: as in `farside bench hidden`.

"the base rate" gives each object the share with a handle of validation objects that show none. "from the prior" is the
controller that does not begin at modes.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure
from scipy import ndimage

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, objects_of
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed, selected
from benchmarks.harness.tables import Table, ranged
from benchmarks.measures.metrics import scored_voxels
from benchmarks.measures.scores import BOXES, random_boxes, score
from benchmarks.rivals.methods import CONTROLLER, FROM_PRIOR, METHODS, Question, answer, settings_of
from benchmarks.scenes.conditions import BEHIND, unseen_handle, views
from benchmarks.scenes.vessels import VesselView, base_rate
from perception.inference.settings import ControllerConfig
from perception.simulation.simulated_camera import PlacedObject
from probnerf.objects.tabletop import VALIDATION_SEEDS
from probnerf.prior.checkpoint import Prior, load_prior

OWN = CONTROLLER.name
BASE = "the base rate"
ASKED = (CONTROLLER, FROM_PRIOR, next(m for m in METHODS if m.name == "encoder alone"))
COLOURS = dict(zip((m.name for m in ASKED), ("tab:blue", "tab:purple", "tab:orange"), strict=True))
REACH = 2.5  # voxels of 32: of 120 validation objects those with a handle reach 3.6 or more, the others 0
EDGES = (0.0, 0.05, 0.3, 0.6, 1.0)  # of p
BASE_SEEDS = 2000  # of validation
UNITS = {"p": "", "share": "", "log_score": "nats", "brier": "", "hidden_nll": "nats", "point_gradients": ""}
COMPARED = ("log_score", "hidden_nll")  # with the controller's
MEASURES = ("p", "share", "log_score", "brier", "hidden_nll")


def reach(
    shapes: Bool[np.ndarray, "s x y z"], body: Bool[np.ndarray, "x y z"], seen: Bool[np.ndarray, "x y z"]
) -> Float[np.ndarray, "s"]:
    """How far each shape reaches from the true body where nobody saw, voxels; 0 where it ends with the body."""
    past = np.where(seen, 0.0, ndimage.distance_transform_edt(~body))
    return np.max(shapes * past, axis=(1, 2, 3))


def has_handle(view: VesselView, shapes: Bool[np.ndarray, "s x y z"]) -> Bool[np.ndarray, "s"]:
    """Whether each shape of an answer has one behind the view's object."""
    return reach(shapes, view.body, view.seen) > REACH


def base_share(seeds: int) -> float:
    """Share with a handle of the first validation seeds' cups, mugs and pitchers that show none in a small picture."""
    found = [placed.shape.has_handle for placed in map(unseen_handle, VALIDATION_SEEDS[:seeds]) if placed is not None]
    return float(np.mean(found))


def log_score(
    p: Float[np.ndarray, "n"], true: Bool[np.ndarray, "n"], shapes: int | Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """-log of what was said of what is true, nats; p as if half a shape more had spoken for either side."""
    p = (p * shapes + 0.5) / (shapes + 1)
    return -np.log(np.where(true, p, 1.0 - p))


@dataclass(frozen=True)
class Options(PriorOptions):
    """How likely the answer says that a handle is behind, against how often one is."""

    n: int = 86
    """Objects."""
    slow: int = 40
    """Of them, those that the controller from the prior answers, too."""
    methods: str = ""
    """Only these, separated by semicolons."""

    @property
    def asked(self) -> list[str]:
        """Methods by name."""
        return selected(self.methods, [m.name for m in ASKED], "method")


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=1, slow=0)
    _ = options.asked  # a mistyped name is refused before anything is loaded
    prior, results = load_prior(options.prior), results_of("handle", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config = ControllerConfig()
    common = {"prior": prior.identity, "condition": BEHIND, "seed": options.seed}
    alone = {**common, "method": BASE, "settings": {"seeds": BASE_SEEDS}, "object": "any"}
    if alone not in results:
        results.add({**alone, "p": round(base_share(100 if options.quick else BASE_SEEDS), 4)})
    rate = base_rate(128 if options.quick else 1024, config=config.observe)
    for method in (m for m in ASKED if m.name in options.asked):
        settings = {"digest": digest([settings_of(method, config), asdict(config), REACH], options.quick)}
        own = {**common, "method": method.name, "settings": settings}
        count = min(options.n, options.slow) if method is FROM_PRIOR else options.n

        def known(number: int, own: Line = own) -> bool:
            return {**own, "object": number} in results

        for number, view in views(BEHIND, count, known):
            if view is None:
                continue
            found, sampled, _ = answer(method, Question(view, prior, config, options.seed))
            p = float(found.weights @ has_handle(view, found.shapes))
            rng = np.random.default_rng([options.seed, view.seed, 31])
            boxes = random_boxes(scored_voxels(view.seen, rate), BOXES, rng)
            line = {
                **own,
                "object": number,
                "p": round(p, 5),
                "shapes": len(found.weights),
                "handle": bool(PlacedObject(number, 0.0, 0.0, 0.0).shape.has_handle),
                "hidden_nll": round(float(score(view, found, rate, boxes, rng).values["hidden_nll"]), 5),
                "point_gradients": float(f"{sampled.point_gradients:.4g}"),
                "result": found.result,
            }
            results.add(line)
            say(f"{number}, {method.name}: {p:.2f}, handle {line['handle']}, {line['hidden_nll']:.3f} nats")


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Means of every method, shares by p, and differences from the controller's; None where there are no rows."""
    alone = [line for line in lines if line["method"] == BASE]
    lines = [line for line in lines if line["method"] in options.asked]
    if not lines or not alone:
        return None
    own = [x for x in lines if x["method"] == OWN] or [x for x in lines if x["method"] == lines[0]["method"]]
    alone_row = {"method": BASE, "p": alone[-1]["p"], "shapes": BASE_SEEDS}
    rows = _rows([*lines, *({**alone_row, "object": x["object"], "handle": x["handle"]} for x in own)])
    return Summary(rows, _tables(Figures(rows)), lambda: _draw(lines))


def _rows(lines: Sequence[Line]) -> list[Row]:
    rows = []
    reference: dict[str, dict[int, float]] = {}  # the controller's, by metric and object
    for method in (*(m.name for m in ASKED), BASE):
        own = [x for x in lines if x["method"] == method]
        if not own:
            continue
        values, objects = _values(own), objects_of(own)
        for metric, each in values.items():
            rows += mean_rows("handle", method, BEHIND, metric, each, UNITS[metric])
        for low, high, inside in _bins(values["p"]):
            for metric in ("p", "share"):
                where, mean = f"{metric} where p is {low:g} to {high:g}", float(values[metric][inside].mean())
                rows.append(Row("handle", method, BEHIND, where, mean, "", int(inside.sum())))
        if method == OWN:
            reference = {m: dict(zip(objects, each.tolist(), strict=True)) for m, each in values.items()}
        for metric in [m for m in COMPARED if m in values and method != OWN]:
            both = [k for k, number in enumerate(objects) if number in reference.get(metric, {})]
            if both:
                theirs = [reference[metric][objects[k]] for k in both]
                rows += gap_rows("handle", method, BEHIND, f"{metric}_above_controller", values[metric][both], theirs)
    return rows


def _tables(of: Figures) -> list[Table]:
    means, shares = [], []
    for method in of.methods(BEHIND):
        cells = [ranged(of.interval(BEHIND, method, m)) if (BEHIND, method, m) in of else "" for m in MEASURES]
        above = [f"{metric}_above_controller" for metric in COMPARED]
        cells += [ranged(of.interval(BEHIND, method, m), sign="+") if (BEHIND, method, m) in of else "" for m in above]
        means.append([method, str(of.count(BEHIND, method, "p")), *cells])
        for low, high in pairwise(EDGES):
            names = [f"{metric} where p is {low:g} to {high:g}" for metric in ("p", "share")]
            if method != BASE and (BEHIND, method, names[0]) in of:
                pair = (f"{of(BEHIND, method, name):.3f}" for name in names)
                shares.append([method, f"{low:g} to {high:g}", str(of.count(BEHIND, method, names[0])), *pair])
    header = ("method", "n", *MEASURES, *(f"{metric} above the controller's" for metric in COMPARED))
    return [
        Table("Is a handle behind it?", header, means),
        Table("By p", ("method", "p", "objects", "mean p", "share with a handle"), shares),
    ]


def _values(lines: Sequence[Line]) -> dict[str, Float[np.ndarray, "n"]]:
    """One method's measures, object by object."""
    p, true, shapes = (np.array([x[name] for x in lines]) for name in ("p", "handle", "shapes"))
    values = {"p": p, "share": true * 1.0, "log_score": log_score(p, true, shapes), "brier": (p - true) ** 2}
    return values | {m: np.array([x[m] for x in lines]) for m in ("hidden_nll", "point_gradients") if m in lines[0]}


def _bins(p: Float[np.ndarray, "n"]) -> list[tuple[float, float, Bool[np.ndarray, "n"]]]:
    """Those of `EDGES` that have any p: low, high, which."""
    which = np.clip(np.searchsorted(EDGES, p, side="right") - 1, 0, len(EDGES) - 2)
    return [(low, high, which == b) for b, (low, high) in enumerate(pairwise(EDGES)) if (which == b).any()]


def _draw(lines: Sequence[Line]) -> Figure:
    """What each method said of objects with a handle and without; p against what is there, in bins of p."""
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    each, bins = figure.subplots(1, 2, width_ratios=(3, 2))
    names = [m.name for m in ASKED if any(x["method"] == m.name for x in lines)]
    rng = np.random.default_rng(0)
    for k, name in enumerate(names):
        own = [x for x in lines if x["method"] == name]
        p, true = np.array([x["p"] for x in own]), np.array([x["handle"] for x in own])
        for side, mark, label in ((False, "o", "none is there"), (True, "^", "a handle is there")):
            at = k + (0.16 if side else -0.16) + rng.uniform(-0.1, 0.1, np.sum(true == side))
            face = COLOURS[name] if side else "none"
            each.plot(at, p[true == side], mark, color=COLOURS[name], mfc=face, ms=5, label=label if k == 0 else None)
        filled = [inside for _, _, inside in _bins(p) if inside.sum() > 2]
        share = np.array([true[inside].mean() for inside in filled])
        error = 1.96 * np.sqrt(share * (1 - share) / np.array([inside.sum() for inside in filled]))
        mean_p = [p[inside].mean() for inside in filled]
        bins.errorbar(mean_p, share, error, fmt="o-", color=COLOURS[name], capsize=3, ms=5, label=name)
    each.set_xticks(range(len(names)), [f"{n}\n({sum(x['method'] == n for x in lines)})" for n in names], fontsize=9)
    each.set(ylabel="P(a handle is behind)", ylim=(-0.03, 1.03), title="p of each object")
    each.legend(fontsize=9)
    bins.plot([0, 1], [0, 1], "k--", linewidth=1)
    bins.set(
        xlabel="P(a handle is behind)", ylabel="share with one", title="p against what is there", ylim=(-0.05, 1.05)
    )
    bins.legend(fontsize=9)
    return figure
