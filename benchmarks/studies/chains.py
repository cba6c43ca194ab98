"""Where samplers get stuck, and how wide their answers are: chains side by side, and the spread of unseen volume.

The views of `farside bench stability`. For each method:

- unexplained: share of the view's informative pixels that a chain (or population) leaves unexplained, mean over its
  samples. The table has its mean, its standard deviation over the chains of a view, and the worst chain's value, all
  as means over views. A chain that is stuck in a wrong mode stands out. Annealed HMC begins hot and cools. At a fixed
  temperature, the same number of steps is spent at the likelihood's own scale (the paper's figure of multimodality).
- volume_sd: standard deviation over the answer's draws of the solid volume in unseen space, over its mean. Variational
  inference fits one Gaussian, which falls into one mode, so its draws agree where those of other methods differ.
- rounding (tempered_smc only): the largest error of the kernel's float32 log-likelihood against plain JAX in float64,
  as a difference between two samples, nats. Samplers use only such differences.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, newest, refuse_cut
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, ranged
from benchmarks.rivals.methods import (
    METHODS,
    VI,
    Method,
    Question,
    Sampled,
    annealed,
    answer,
    paper_schedule,
    settings_of,
)
from benchmarks.scenes.conditions import faultless_pictures
from benchmarks.scenes.vessels import GRID, vessel_view
from perception.inference.settings import ControllerConfig
from probnerf.inference import without_sizes
from probnerf.likelihood.dispatch import log_likelihood, plain_log_likelihood
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.shapes import explained

CONDITION = "any view"
ROUNDED = 32  # samples whose log-likelihood is evaluated in float64, too


def _named(name: str) -> Method:
    return next(m for m in METHODS if m.name == name)


SMC = _named("smc")
ANNEALED = paper_schedule(annealed(20, 100))
FIXED = _named("fixed 20x100")
COMPARED = (SMC, ANNEALED, FIXED, VI)


def unexplained(question: Question, sampled: Sampled) -> Float[np.ndarray, "chains"]:
    """Share of telling pixels that each chain leaves unexplained, by its samples' weights."""
    posterior = sampled.posterior
    share = explained(question.prior.model, without_sizes(sampled.likelihood), sampled.observation, posterior.positions)
    missed, weights = 1.0 - np.asarray(share, np.float64), np.exp(np.asarray(posterior.log_weights, np.float64))
    chain = np.asarray(posterior.population)
    found = []
    for c in np.unique(chain):
        own = weights[chain == c]
        found.append(np.average(missed[chain == c], weights=own if own.sum() > 0.0 else None))  # a failed one has none
    return np.array(found)


def relative_spread(volumes: Float[np.ndarray, "s"], weights: Float[np.ndarray, "s"]) -> float:
    """Standard deviation over mean; 0 where there is nothing."""
    mean = float(weights @ volumes / weights.sum())
    variance = float(weights @ (volumes - mean) ** 2 / weights.sum())
    return float(np.sqrt(variance)) / mean if mean > 0 else 0.0


def rounding(question: Question, sampled: Sampled) -> float:
    """The largest error of a difference of two samples' log-likelihoods, nats."""
    single = question.arguments
    positions = sampled.posterior.positions[:ROUNDED]
    found = np.asarray(jax.jit(log_likelihood)(single, positions), np.float64)
    with jax.enable_x64(True):
        double, exact = jax.tree.map(
            lambda a: jnp.asarray(a, jnp.float64) if a.dtype == jnp.float32 else a, (single, positions)
        )
        expected = np.asarray(jax.jit(plain_log_likelihood)(double, exact))
    return float(np.ptp(found - expected))


@dataclass(frozen=True)
class Options(PriorOptions):
    """Chains that get stuck, draws that collapse, and what float32 costs."""

    n: int = 8
    """Views."""

    @property
    def compared(self) -> tuple[Method, ...]:
        """Methods: a quick run asks one."""
        return (SMC,) if self.quick else COMPARED


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=1)
    prior, results = load_prior(options.prior), results_of("chains", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config = ControllerConfig()
    for number, picture in enumerate(faultless_pictures(options.n), start=1):
        view = vessel_view(picture)
        common = {"prior": prior.identity, "condition": CONDITION, "object": view.seed, "seed": options.seed}
        for method in options.compared:
            line: Line = {**common, "method": method.name, "settings": settings_of(method, config)}
            if line in results:
                continue
            question = Question(view, prior, config, options.seed)
            found, sampled, _ = answer(method, question)
            refuse_cut(found.result)
            volumes = (found.shapes & ~view.seen).reshape(-1, GRID**3).sum(axis=1).astype(np.float64)
            missed = [round(u, 4) for u in unexplained(question, sampled)]
            line |= {"unexplained": missed, "volume_sd": round(relative_spread(volumes, found.weights), 4)}
            if method is SMC:
                line["rounding"] = float(f"{rounding(question, sampled):.3g}")
            results.add(line)
            say(
                f"view {number} of {options.n}: {method.name}: unexplained {min(missed):.3f} to {max(missed):.3f},"
                f" hidden volume +- {line['volume_sd']:.0%}"
            )


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the first `n` views; None where a method has none."""
    by = {m.name: [line for line in lines if line["method"] == m.name][: options.n] for m in options.compared}
    if not all(by.values()):
        return None
    rows = []
    reference = {line["object"]: line["volume_sd"] for line in by[SMC.name]}
    for name, found in by.items():
        chains = [np.array(line["unexplained"]) for line in found]
        values = {
            "unexplained": [c.mean() for c in chains],
            "unexplained_sd": [c.std() for c in chains],
            "unexplained_worst": [c.max() for c in chains],
            "volume_sd": [line["volume_sd"] for line in found],
        }
        if name == SMC.name:
            values["rounding"] = [line["rounding"] for line in found]
        for metric, each in values.items():
            rows += mean_rows("chains", name, CONDITION, metric, each, "nats" * (metric == "rounding"))
        both = [(line["volume_sd"], reference[line["object"]]) for line in found if line["object"] in reference]
        own, theirs = np.array(both).reshape(-1, 2).T
        rows += gap_rows("chains", name, CONDITION, "volume_sd_above_smc", own, theirs, unit="")
    of, worst = Figures(rows), max(line["rounding"] for line in by[SMC.name])
    metrics = ("unexplained", "unexplained_sd", "unexplained_worst", "volume_sd")
    cells = [
        [
            name, str(len(by[name])), *(f"{of(CONDITION, name, m):.3f}" for m in metrics),
            ranged(of.interval(CONDITION, name, "volume_sd_above_smc"), sign="+"),
        ]
        for name in by
    ]  # fmt: skip
    header = ("method", "views", "unexplained", "sd of chains", "worst chain", "volume_sd", "above smc's")
    tables = [
        Table("Chains and draws, means over views", header, cells),
        Table(
            "The kernel's float32 against float64",
            ("", "nats"),
            [["largest error of a difference of two samples' log-likelihoods", f"{worst:.2g}"]],
        ),
    ]
    return Summary(rows, tables, lambda: _draw(by))


def _draw(by: dict[str, list[Line]]) -> Figure:
    figure = Figure(figsize=(11, 4), layout="constrained")
    stuck, wide = figure.subplots(1, 2)
    colours = ("tab:blue", "tab:orange", "tab:red", "tab:green")
    for at, ((name, found), colour) in enumerate(zip(by.items(), colours, strict=False)):
        for view, line in enumerate(found):
            values = np.array(line["unexplained"])
            x = np.full(len(values), view + 0.18 * (at - 1.5))
            stuck.plot(x, values, ".", color=colour, ms=5, label=name if view == 0 else None)
        wide.plot(range(len(found)), [line["volume_sd"] for line in found], "o-", color=colour, label=name)
    stuck.set(title="chains of one view, side by side", xlabel="view", ylabel="pixels left unexplained, share")
    stuck.set_yscale("symlog", linthresh=0.02)
    wide.set(title="volume where nobody saw: spread of the draws", xlabel="view", ylabel="standard deviation / mean")
    for ax in (stuck, wide):
        ax.legend(fontsize=8)
    return figure
