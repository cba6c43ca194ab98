"""The ProbNeRF paper's experiments on this project's own code, with the systems that it compares with, on cars.

Objects of the test seeds of `benchmarks.paper.families`, of known pose, each from a telling and from an untelling place
(`benchmarks.paper.conditioned`); one colour picture and no depth. Of its 64 x 64 pixels 256 are compared, each for four
(the paper: all of 128 x 128). The prior was trained by `python -m benchmarks.paper.train`, for minutes and on pictures
of 32 x 32. A family whose prior is not there (people) is left out. **These are the paper's experiments, not its
sizes:** what fails here is not refuted, and n is small, as an answer takes minutes of a machine that does other work.

posterior inference (the paper's figure of ablations): HMC as in the paper and mean-field VI, each with the weights'
perturbation delta (`hmc, delta` is the paper's whole model) and without (its ablation), beside this project's sampler,
the encoder alone and the prior alone; and the rivals whose weights are in benchmarks/checkpoints/paper/rivals: Functa
(MAP), NeRF-VAE (draws of its encoder's answer) and pixelNeRF. `python -m benchmarks.rivals.train` trains them; a table
says which are there, how long they learnt, and whether each is healthy alone. A point estimate has no pixel_sd, and
what hidden space a rival fills is not measured.

- psnr_given, psnr_heldout: of an answer's pictures from the given place (of what was given) and from four others, dB, a
  mean over draws; psnr_heldout_of_mean: of the mean picture.
- pixel_sd: standard deviation between draws of a held-out pixel's colour (root of the mean variance; the paper gives
  variances).
- hidden_nll, hidden_ece: of the voxels (32^3) that the given picture does not show, as in `farside bench hidden`.

the prior's gate: z~ is fitted to the solid of held-out objects (`benchmarks.measures.refitted`); iou of 64^3 voxels.

annealing (the paper's figure of an ambulance's rear): vehicles from behind, 8 chains of HMC from the same starts, as
the paper anneals it and at one temperature: with the paper's step of 0.0005, and with one that is tuned as the annealed
chains' is. All take the same number of gradients, without delta. Chains are sorted by psnr_given of their last state:
best, 4th, worst. `spread` is best less worst.

prior samples (the paper's table of FIDs): the Fréchet distance of each method's objects from true ones, each seen once,
in features of a network that was trained apart from all methods (`benchmarks.rivals.features`), at equal n. It falls
with n: only columns can be compared, beside the distance of two sets of true pictures. With `--inception FILE`, the
weights of InceptionV3 that FIDs are of (`benchmarks/rivals/inception.py` says how to write them), it is made in those
features instead, with rows and a table of its own. The weights are not part of this project: of that network structure
and arithmetic were tested, on random weights, and no FID was measured.

delta: HMC on informative views with other scales sqrt(alpha); and other people's cars, which the prior does not know
(`--meshes`: a folder of Gazebo's models, which is not part of this repository).

renderers (the paper's figure of acceptance): `farside bench acceptance` on cars, from a draw (z~, delta) of the prior.
32 pixels of a picture are compared, and both renderers show one prior, which was trained through the foam; the paper
trained a second one through quadrature, and compares all pixels. So this asks the same question of another posterior.

decoders: pixels a second of this decoder, and of decoders that are told the latent at each point, in one run.

pictures: `python -m benchmarks.paper.grids` draws those at the end, uncurated, of the first test seeds. An ambulance
from behind, annealed and at one temperature, and answers to a car from behind: the truth, 8 draws (of the ambulance,
the chains' last states), and the deviation of each pixel between them (black 0, white 0.25), of the given view and of
the hidden side. Samples: the prior's above, true cars below. Looked at: hidden sides of hmc's answers differ more than
given ones; at one temperature most of the ambulance's chains end at other vehicles, with the tuned step, too.

The first table has the paper's claims with a verdict each, computed from these rows (`benchmarks.paper.claims`).

HMC is shortened to 40 x 25 and VI to 600 steps for two cores; `--full` runs the paper's own schedule. `--small` trains
nothing, answers the first four objects anew, shows the tables of the committed rows, and how far the two differ. Ended
or killed, it goes on where it was. On two slow cores that also did other work it took 84 minutes, in two parts and
without the decoders' cost; how long it takes alone was not measured. `--full` is about 18 hours, so counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures
from benchmarks.harness.results import Line, Results, key, newest
from benchmarks.harness.rows import Row
from benchmarks.harness.study import ResumedOptions, Summary, results_of, resumed, selected
from benchmarks.harness.tables import Table
from benchmarks.paper import annealing, claims, decoders, deltas, gate, posteriors, prior_samples, renderers
from benchmarks.paper.experiment import UNITS, Run, prior_of
from benchmarks.paper.families import FAMILIES, SPLITS, Family
from benchmarks.paper.methods import ENCODER, METHODS, PRIOR, SHORT, Effort
from benchmarks.paper.rival_answers import TrainedRival, keep_training, trained_rivals, training_table

WEIGHTS = Path(__file__).resolve().parent.parent / "checkpoints" / "paper"
RIVALS = WEIGHTS / "rivals"
FEATURES = WEIGHTS / "features.safetensors"
OTHER_UNITS = {"iou": "", "chains": "dB", "acceptance": "", "distance": "", "ratio": ""}  # of rows, beside `UNITS`
SMALL = 4  # objects of an experiment that `--small` answers anew


@dataclass(frozen=True)
class Options(ResumedOptions):
    """The paper's experiments, on cars."""

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
    experiments: str = ""
    """Only these, separated by semicolons: gate, posteriors, annealing, samples, renderers, decoders, sweep, others."""
    rivals: Annotated[Path, tyro.conf.arg(metavar="DIR")] = RIVALS
    """Folder of the rivals' weights."""
    features: Annotated[Path, tyro.conf.arg(metavar="FILE")] = FEATURES
    """Weights of the network of features."""
    inception: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Weights of InceptionV3 (`benchmarks/rivals/inception.py`): prior samples are compared in its features instead."""
    meshes: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(default: none)")] = None
    """Folder of Gazebo's models: other people's cars."""
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

    @property
    def count(self) -> int:
        """Objects of an experiment."""
        return 1 if self.quick else min(self.n, SMALL) if self.small else self.n


EXPERIMENTS = ("gate", "posteriors", "annealing", "samples", "renderers", "decoders", "sweep", "others")


def weights_of(family: Family) -> Path:
    """The family's prior."""
    return WEIGHTS / f"{family.name}.safetensors"


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has.

    Raises ValueError or FileNotFoundError, before anything is measured, for what is not known or not there.
    """
    if options.n < 1:
        raise ValueError(f"--n is {options.n}; give 1 object or more")
    asked = selected(options.methods, [m.name for m in METHODS], "method")
    wanted = selected(options.experiments, EXPERIMENTS, "experiment")
    if options.meshes is not None and "others" in wanted:
        deltas.check_others(options.meshes)
    elif "others" in wanted and options.experiments:
        raise ValueError("other people's cars are not part of this repository; give a folder of them with --meshes")
    results, families = results_of("paper", options), options.chosen
    if not families:
        raise ValueError(
            f"{WEIGHTS} holds no prior; train one with `python -m benchmarks.paper.train`, and copy it there"
        )
    priors = {family.name: prior_of(family, weights_of(family)) for family in families}
    rivals = {family.name: trained_rivals(options.rivals, family) for family in families if family.name == "cars"}
    features = prior_samples.features_in(options.features, options.inception) if "samples" in wanted else None
    anew = Results(options.out / "paper-small.jsonl") if options.small else results

    def measure() -> None:
        for family in families:
            effort = options.effort, options.seed, options.quick
            run = Run(family, priors[family.name], anew, options.count, *effort, options.out)
            own = rivals.get(family.name, [])
            keep_training(run, own)
            if "gate" in wanted:
                gate.measure(run)
            if "posteriors" in wanted:
                posteriors.measure(run, [m for m in METHODS if m.name in asked], own)
            if family.name == "cars":
                _of_cars(options, run, wanted, own, features)

    def summed() -> Summary | None:
        found = summary(results.lines, replace(options, small=False))
        if not options.small or found is None:
            return found
        return Summary(found.rows, [*found.tables, agreement(anew.lines, results.lines)], found.picture)

    return resumed(anew, options, measure, summed)


def _of_cars(
    options: Options,
    run: Run,
    wanted: Sequence[str],
    rivals: Sequence[TrainedRival],
    features: prior_samples.FeatureFile | None,
) -> None:
    """The experiments that the paper made on cars alone, each on some of the objects."""
    part = replace(run, count=max(1, run.count if options.small else run.count // 3))
    if "annealing" in wanted:
        annealing.measure(part)
    if "samples" in wanted and features is not None:
        counts = prior_samples.COUNTS[:1] if options.quick or options.small else prior_samples.COUNTS
        prior_samples.measure(run, rivals, features, counts)
    if "renderers" in wanted:
        renderers.measure(part)
    if "decoders" in wanted:
        decoders.measure(part, rivals)
    if "sweep" in wanted:
        deltas.measure_sweep(part)
    if "others" in wanted and options.meshes is not None:
        deltas.measure_others(part, options.meshes, rivals)


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the first `n` objects; None where there are none."""
    rows: list[Row] = []
    effort = options.effort.settings
    lines = [x for x in lines if all(x["settings"].get(name, value) == value for name, value in effort.items())]
    lines = [x for identity in dict.fromkeys(x["prior"] for x in lines) for x in newest(lines, identity)]
    seeds = SPLITS["test"][: options.count]
    tables = [
        *gate.tables(lines, rows, seeds),
        *training_table(lines),
        *posteriors.tables(lines, rows, list(FAMILIES), seeds),
        *annealing.tables(lines, rows),
        *prior_samples.tables(lines, rows),
        *renderers.tables(lines, rows),
        *deltas.tables(lines, rows, seeds),
        *decoders.tables(lines, rows),
    ]
    tables = [*claims.tables(lines, options.effort), *tables]
    return Summary(rows, tables, lambda: _draw(Figures(rows))) if rows else None


def agreement(anew: Sequence[Line], kept: Sequence[Line]) -> Table:
    """How far rows that were made anew are from the kept ones of the same identity; of chains, the farthest."""
    before, cells = {key(line): line for line in kept}, []
    for metric, unit in {**UNITS, **OTHER_UNITS}.items():
        both = [(line, before[key(line)]) for line in anew if metric in line and key(line) in before]
        differences = [float(np.abs(np.subtract(a[metric], b[metric])).max()) for a, b in both]
        if differences:
            cells.append([metric, unit, str(len(both)), *(f"{f(differences):.4f}" for f in (np.median, np.max))])
    return Table("Made anew, beside the kept rows", ("", "unit", "answers", "median difference", "largest"), cells)


def _draw(of: Figures) -> Figure:
    """Held-out quality against diversity, and what is said of hidden space, by condition."""
    conditions = posteriors.drawn(of, list(FAMILIES))
    figure = Figure(figsize=(11, 3.4 * max(len(conditions), 1)), layout="constrained")
    axes = figure.subplots(max(len(conditions), 1), 2, squeeze=False)
    for (left, right), condition in zip(axes, conditions, strict=False):
        names = of.methods(condition)
        for k, method in enumerate(names):
            mark = "s" if method in (PRIOR.name, ENCODER.name) else "o"
            y = of.interval(condition, method, "psnr_heldout")
            x = of(condition, method, "pixel_sd") if (condition, method, "pixel_sd") in of else 0.0  # a point estimate
            colour = f"C{k % 10}"
            left.errorbar(x, y.mean, [[y.mean - y.low], [y.high - y.mean]], fmt=mark, color=colour, label=method)
            if (condition, method, "hidden_nll") in of:
                nll = of.interval(condition, method, "hidden_nll")
                right.errorbar(nll.mean, k, xerr=[[nll.mean - nll.low], [nll.high - nll.mean]], fmt=mark, color=colour)
        left.set_ylim(5.0, 35.0)  # intervals of few objects reach farther
        right.set_xlim(0.0, 2.0)
        left.set(title=condition, xlabel="sd of held-out pixels between draws", ylabel="psnr of held-out views, dB")
        left.legend(fontsize=8)
        right.set(xlabel="hidden_nll, nats (lower is better)", yticks=range(len(names)))
        right.set_yticklabels(names, fontsize=8)
    return figure
