"""The ProbNeRF paper's experiments on this project's own code: posterior inference and annealing, on cars.

Objects of the test seeds of `benchmarks.paper.families`, of known pose, each from a telling and from an untelling place
(`benchmarks.paper.conditioned`); one colour picture and no depth. The prior was trained by
`python -m benchmarks.paper.train`. A family whose prior is not there (people) is left out.

posterior inference (the paper's figure of ablations): HMC as in the paper and mean-field VI, each with the weights'
perturbation delta and without, beside this project's sampler, the encoder alone and the prior alone.

- psnr_given, psnr_heldout: of an answer's pictures from the given place (of what was given) and from four others, dB, a
  mean over draws; psnr_heldout_of_mean: of the mean picture.
- pixel_sd: standard deviation between draws of a held-out pixel's colour (root of the mean variance; the paper gives
  variances).
- hidden_nll, hidden_ece: of the voxels (32^3) that the given picture does not show, as in `farside bench hidden`.

the prior's gate: z~ is fitted to the solid of held-out objects (`benchmarks.measures.refitted`); iou of 64^3 voxels.

annealing (the paper's figure of an ambulance's rear): vehicles from behind, 8 chains of HMC from the same starts, as
the paper anneals it and at one temperature with its step of 0.0005. Chains are sorted by psnr_given of their last
state: best, 4th, worst. `spread` is best less worst.

HMC is shortened to 40 x 25 and VI to 600 steps for two cores; `--full` runs the paper's own schedule. `--small` answers
the first four objects anew, shows the tables of the committed rows, and how far the two differ. Fréchet distances,
Functa and the other rivals, prior samples, and the renderer's experiment on these families are not there yet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, key, newest
from benchmarks.harness.rows import Row
from benchmarks.harness.study import ResumedOptions, Summary, results_of, resumed, selected
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.metrics import psnr
from benchmarks.measures.refitted import refit
from benchmarks.paper.cars import Car
from benchmarks.paper.conditioned import PLACES, Conditioned, base_rate
from benchmarks.paper.families import FAMILIES, SPLITS, Family
from benchmarks.paper.judged import judge, pictures
from benchmarks.paper.methods import CHAINS, ENCODER, FIXED, HMC, METHODS, PRIOR, SHORT, Effort, Question
from probnerf.prior.checkpoint import Prior, load_prior

WEIGHTS = Path(__file__).resolve().parent.parent / "checkpoints" / "paper"
RATED = range(200)  # training seeds that the base rate is of
UNITS = {
    "psnr_given": "dB", "psnr_heldout": "dB", "psnr_heldout_of_mean": "dB", "pixel_sd": "", "hidden_nll": "nats",
    "hidden_ece": "",
}  # fmt: skip
BACK = PLACES["cars"][0]
ANNEALING = "annealing, cars from behind"
COMPARED = (HMC, FIXED)
FIT, GATE, LEAST_IOU = "fit to the solid", "the prior's gate", 0.85
ORDER = ("best", "4th", "worst", "spread")


@dataclass(frozen=True)
class Options(ResumedOptions):
    """The paper's experiments: posterior inference and annealing, on cars."""

    full: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The paper's own schedules; without, shorter ones for two cores."""
    small: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Answer four objects anew, and compare them with the kept rows."""
    n: int = 24
    """Objects of each family; of the annealing a third of them."""
    families: str = ""
    """Only these, separated by semicolons."""
    methods: str = ""
    """Only these of the posterior inference, separated by semicolons."""
    seed: int = 0
    """Of the samplers."""

    @property
    def effort(self) -> Effort:
        """Lengths of the schedules."""
        return Effort() if self.full and not self.quick else SHORT

    @property
    def chosen(self) -> list[Family]:
        """Families whose weights are there. Raises ValueError for an unknown one."""
        names = selected(self.families, list(FAMILIES), "family")
        return [FAMILIES[name] for name in names if weights_of(FAMILIES[name]).is_file()]


def weights_of(family: Family) -> Path:
    """The family's prior."""
    return WEIGHTS / f"{family.name}.safetensors"


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    _ = selected(options.methods, [m.name for m in METHODS], "method")
    results, families = results_of("paper", options), options.chosen
    if not families:
        raise ValueError(
            f"{WEIGHTS} holds no prior; train one with `python -m benchmarks.paper.train`, and copy it there"
        )
    priors = {family.name: load_prior(weights_of(family)) for family in families}

    anew = Results(options.out / "paper-small.jsonl") if options.small else results

    def measure() -> None:
        for family in families:
            _gate(options, family, priors[family.name], anew)
            _posteriors(options, family, priors[family.name], anew)
        if "cars" in priors:
            _annealing(options, priors["cars"], anew)

    def summed() -> Summary | None:
        found = summary(results.lines, replace(options, small=False))
        if not options.small or found is None:
            return found
        return Summary(found.rows, [*found.tables, agreement(anew.lines, results.lines)], found.picture)

    return resumed(anew, options, measure, summed)


def _count(options: Options) -> int:
    return 1 if options.quick else min(options.n, 4) if options.small else options.n


def _gate(options: Options, family: Family, prior: Prior, results: Results) -> None:
    for seed in SPLITS["test"][: _count(options)]:
        line: Line = {
            "prior": prior.identity, "method": FIT, "settings": {}, "condition": f"{family.name}, {GATE}",
            "object": seed, "seed": options.seed,
        }  # fmt: skip
        if line not in results:
            iou = round(refit(prior.model, family.name, family.draw(seed).mesh, seed).iou, 4)
            results.add({**line, "iou": iou})
            say(f"{line['condition']}, {seed}: iou {iou:.3f}")


def _posteriors(options: Options, family: Family, prior: Prior, results: Results) -> None:
    rate, asked = None, selected(options.methods, [m.name for m in METHODS], "method")
    for seed in SPLITS["test"][: _count(options)]:
        for place in PLACES[family.name]:
            view = Conditioned(family, seed, place, prior.model.preset.image_size)
            for method in (m for m in METHODS if m.name in asked):
                line: Line = {
                    "prior": prior.identity, "method": method.name, "settings": method.settings(options.effort),
                    "condition": f"{family.name}, {place.name}", "object": seed, "seed": options.seed,
                }  # fmt: skip
                if line in results:
                    continue
                rate = base_rate(family, RATED[:20] if options.quick else RATED) if rate is None else rate
                found = method.answer(Question(view, prior.model, options.effort, options.seed))
                values = judge(view, prior.model, found, rate).values
                kept = {name: round(value, 5) for name, value in values.items()}
                results.add({**line, **kept, "gradients": found.gradients, "result": found.posterior.result})
                say(
                    f"{line['condition']}, {seed}, {method.name}: given {kept['psnr_given']:.1f} dB, held out"
                    f" {kept['psnr_heldout']:.1f} dB, sd {kept['pixel_sd']:.3f}, hidden {kept['hidden_nll']:.3f} nats"
                )


def rear_seeds(count: int) -> list[int]:
    """Vehicles of the annealing: the first ambulance of the test seeds, then the first others."""
    seeds, ambulance = SPLITS["test"], None
    for seed in seeds:
        car = FAMILIES["cars"].draw(seed)
        if isinstance(car, Car) and car.style == "ambulance":
            ambulance = seed
            break
    assert ambulance is not None
    return [ambulance, *(seed for seed in seeds[:count] if seed != ambulance)][:count]


def _annealing(options: Options, prior: Prior, results: Results) -> None:
    for seed in rear_seeds(max(1, _count(options) // 3)):
        view = Conditioned(FAMILIES["cars"], seed, BACK, prior.model.preset.image_size)
        for method in COMPARED:
            line: Line = {
                "prior": prior.identity, "method": method.name, "settings": method.settings(options.effort),
                "condition": ANNEALING, "object": seed, "seed": options.seed,
            }  # fmt: skip
            if line in results:
                continue
            found = method.answer(Question(view, prior.model, options.effort, options.seed))
            last = found.posterior.positions[-CHAINS:]  # the chains' last states
            made = pictures(prior.model, found.likelihood, last, view.T_object_camera)[:, 0]
            each = [round(psnr(picture, view.given.rgb[0] / 255.0), 3) for picture in made]
            acceptance = round(float(found.posterior.diagnostics.acceptance), 3)
            results.add({**line, "chains": each, "acceptance": acceptance, "result": found.posterior.result})
            say(f"{ANNEALING}, {seed}, {method.name}: {min(each):.1f} to {max(each):.1f} dB, acceptance {acceptance}")


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the first `n` objects; None where there are none."""
    rows: list[Row] = []
    tables: list[Table] = []
    identities = dict.fromkeys(line["prior"] for line in lines)
    schedule = {m.name: m.settings(options.effort) for m in (*METHODS, FIXED)}
    schedule[FIT] = {}
    lines = [x for p in identities for x in newest([y for y in lines if y["settings"] == schedule[y["method"]]], p)]
    if gated_lines := [line for line in lines if line["method"] == FIT and line["object"] in _seeds(options)]:
        tables.append(_gate_table(gated_lines, rows))
    for condition in dict.fromkeys(x["condition"] for x in lines if x["condition"] != ANNEALING and x["method"] != FIT):
        own = [line for line in lines if line["condition"] == condition and line["object"] in _seeds(options)]
        cells = []
        for method in [m.name for m in METHODS if any(line["method"] == m.name for line in own)]:
            values = {line["object"]: line for line in own if line["method"] == method}
            for metric, unit in UNITS.items():
                rows += mean_rows("paper", method, condition, metric, [x[metric] for x in values.values()], unit)
            reference = {line["object"]: line for line in own if line["method"] == HMC.name}
            both = [seed for seed in values if seed in reference]
            for metric in ("psnr_heldout", "hidden_nll"):
                pair = ([x[seed][metric] for seed in both] for x in (values, reference))
                rows += gap_rows("paper", method, condition, f"{metric}_above_hmc", *pair, unit=UNITS[metric])
            of = Figures(rows)
            digits = {"dB": 1}
            cells.append(
                [method, str(len(values))]
                + [ranged(of.interval(condition, method, m), digits.get(u, 3)) for m, u in UNITS.items()]
                + [ranged(of.interval(condition, method, "hidden_nll_above_hmc"), sign="+")]
            )
        tables.append(Table(condition, ("method", "n", *UNITS, "hidden_nll above hmc's"), cells))
    chains = [line for line in lines if line["condition"] == ANNEALING]
    if chains:
        tables.append(_chain_table(chains, rows))
    return Summary(rows, tables, lambda: _draw(Figures(rows))) if rows else None


def _gate_table(lines: Sequence[Line], rows: list[Row]) -> Table:
    cells = []
    for condition in dict.fromkeys(line["condition"] for line in lines):
        values = [line["iou"] for line in lines if line["condition"] == condition]
        rows += mean_rows("paper", FIT, condition, "iou", values, "")
        mean = Figures(rows).interval(condition, FIT, "iou")
        cells.append(
            [condition, str(len(values)), gated(ranged(mean), mean.mean, least=LEAST_IOU), f"{min(values):.3f}"]
        )
    return Table("z~ fitted to the solid", ("", "n", f"iou, gate >= {LEAST_IOU:g}", "lowest"), cells)


def agreement(anew: Sequence[Line], kept: Sequence[Line]) -> Table:
    """How far rows that were made anew are from the kept ones of the same identity."""
    before, cells = {key(line): line for line in kept}, []
    for metric, unit in UNITS.items():
        both = [(line, before[key(line)]) for line in anew if metric in line and key(line) in before]
        differences = [abs(a[metric] - b[metric]) for a, b in both]
        if differences:
            cells.append([metric, unit, str(len(both)), *(f"{f(differences):.4f}" for f in (np.median, np.max))])
    return Table("Made anew, beside the kept rows", ("", "unit", "answers", "median difference", "largest"), cells)


def _seeds(options: Options) -> range:
    return SPLITS["test"][: _count(options)]


def _chain_table(lines: Sequence[Line], rows: list[Row]) -> Table:
    cells = []
    for method in (m.name for m in COMPARED if any(line["method"] == m.name for line in lines)):
        own = [line for line in lines if line["method"] == method]
        each = np.sort(np.array([line["chains"] for line in own]), axis=1)[:, ::-1]
        values = dict(zip(ORDER[:3], each[:, [0, 3, -1]].T, strict=True))
        values["spread"] = each[:, 0] - each[:, -1]
        for name in ORDER:
            rows += mean_rows("paper", method, ANNEALING, f"psnr_given, {name}", values[name], "dB")
        of = Figures(rows)
        acceptance = np.mean([line["acceptance"] for line in own])
        shown = [ranged(of.interval(ANNEALING, method, f"psnr_given, {name}"), 1) for name in ORDER]
        cells.append([method, str(len(own)), *shown, f"{acceptance:.2f}"])
    return Table(f"{ANNEALING}: psnr of the given view by chain, dB", ("method", "n", *ORDER, "acceptance"), cells)


def _draw(of: Figures) -> Figure:
    """Held-out quality against diversity, and what is said of hidden space, by condition."""
    conditions = [c for c in of.conditions() if c != ANNEALING and not c.endswith(GATE)]
    figure = Figure(figsize=(11, 3.4 * max(len(conditions), 1)), layout="constrained")
    axes = figure.subplots(max(len(conditions), 1), 2, squeeze=False)
    for (left, right), condition in zip(axes, conditions, strict=True):
        for k, method in enumerate(of.methods(condition)):
            if method in (PRIOR.name, ENCODER.name):
                mark = "s"
            else:
                mark = "o"
            x, y = of(condition, method, "pixel_sd"), of.interval(condition, method, "psnr_heldout")
            left.errorbar(x, y.mean, [[y.mean - y.low], [y.high - y.mean]], fmt=mark, color=f"C{k}", label=method)
            nll = of.interval(condition, method, "hidden_nll")
            right.errorbar(nll.mean, k, xerr=[[nll.mean - nll.low], [nll.high - nll.mean]], fmt=mark, color=f"C{k}")
        left.set_ylim(5.0, 35.0)  # intervals of few objects reach farther
        right.set_xlim(0.0, 2.0)
        left.set(title=condition, xlabel="sd of held-out pixels between draws", ylabel="psnr of held-out views, dB")
        left.legend(fontsize=8)
        right.set(xlabel="hidden_nll, nats (lower is better)", yticks=range(len(of.methods(condition))))
        right.set_yticklabels(of.methods(condition), fontsize=8)
    return figure
