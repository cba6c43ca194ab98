"""What kind of thing it is: the posterior network's probabilities beside the base rate, on held-out objects.

Every object is seen once on a simulated table, among others, with the faults that a depth camera has and through
perception's own code, segmentation included; a quarter of the pictures have no range, half are behind an occluder. What
perception refuses is not scored. Sources: objects of the tabletop family (validation seeds), of the household generator
(validation seeds), of the held-out classes of the training meshes, and scans. A mesh's kind is told by its file's name.

- log_score: mean -log of the probability of the true kind, nats.
- base: the same of a constant forecast, the shares of the kinds among the very objects that are scored, which is the
  best that a constant can do.
- gap: log_score - base, paired over objects.
- ece: calibration error of all kinds' probabilities in 15 bins.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.metrics import LOG_SCORE_CLIP, hidden_ece
from probnerf.objects.tabletop import VALIDATION_SEEDS
from probnerf.prior.checkpoint import load_prior
from probnerf.training.settings import PosteriorTrainConfig
from probnerf.types import KINDS

GATE_ECE = 0.05
METHOD = "network"
ALL = "all"
BINS = 10  # of the picture
_CHUNK = 64  # objects drawn, and pictures judged, at a time

Judged = tuple[Float[np.ndarray, "n kinds"], Int[np.ndarray, "n"]]  # probabilities of `KINDS`, and the true kind


@dataclass(frozen=True)
class Options(TableOptions):
    """The probabilities of what kind of thing it is, on held-out objects. It needs `farside[meshes]`."""

    prior: Path | None = None
    """Weights whose network is judged; the shipped ones by default."""
    n: int = 300
    """Objects of the tabletop family and of the household generator, each."""


def main(options: Options) -> Summary:
    """Measure, and sum up. Raises ValueError for a prior without a network."""
    n = min(options.n, 8) if options.quick else options.n
    parts: dict[str, list[Judged]] = {}
    for source, p, kind in _judged(options.prior, n):
        parts.setdefault(source, []).append((p, kind))
        say(f"{source}: {sum(len(each) for _, each in parts[source])} objects")
    return summary({source: _joined(each) for source, each in parts.items()})


def _judged(weights: Path | None, n: int) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """(source, probabilities, true kinds) of some objects at a time."""
    from benchmarks.scenes.held_out import held_out_things  # these need the extra `meshes`
    from perception.simulation.training_pictures import LOOKS, draw_views, picture_set
    from probnerf.training.learnt_objects import FOLDER, learnt, tabletop_objects
    from probnerf.training.picture_set import changed
    from probnerf.training.posterior_flow import log_kinds

    prior = load_prior(weights)
    if prior.network is None:
        raise ValueError(f"{weights or 'the shipped prior'} has no posterior network; name one that has with --prior")
    things = {"tabletop": tabletop_objects(np.asarray(VALIDATION_SEEDS[:n]))}
    for source, thing, seed in held_out_things(n):
        things.setdefault(source, []).append(learnt(thing, seed, 0, FOLDER))
    config, rng = replace(PosteriorTrainConfig(), known_pose=0.0), np.random.default_rng(7)
    for source, objects in things.items():
        for start in range(0, len(objects), _CHUNK):
            part, _ = draw_views(rng, objects[start : start + _CHUNK], 1, prior.network.sizes.image_size, looks=LOOKS)
            pictures = picture_set([part], None)
            rows = np.resize(np.arange(len(pictures)), _CHUNK)  # one compiled size
            told = np.exp(np.asarray(log_kinds(prior.network, changed(pictures, rows, rng, config)), np.float64))
            yield source, told[: len(pictures)], np.asarray(pictures.kind, int)


def _joined(parts: Iterable[Judged]) -> Judged:
    p, kind = zip(*parts, strict=True)
    return np.concatenate(p), np.concatenate(kind)


def summary(judged: dict[str, Judged]) -> Summary:
    """Figures of each source, and of all objects together."""
    together = _joined(judged.values())
    rows: list[Row] = []
    for source, (p, kind) in {**judged, ALL: together}.items():
        rows += source_rows(source, p, kind)
    of, lines = Figures(rows), []
    for source in (*judged, ALL):
        gap, ece = of.interval(source, METHOD, "gap"), of(source, METHOD, "ece")
        shown = ranged(gap, sign="+")
        calibrated = f"{ece:.3f}"
        if source == ALL:
            shown, calibrated = gated(shown, gap.high, most=0.0), gated(calibrated, ece, most=GATE_ECE)
        scores = (f"{of(source, METHOD, metric):.3f}" for metric in ("log_score", "base"))
        lines.append([source, str(gap.n), *scores, shown, calibrated])
    columns = ("source", "objects", "log score, nats", "base rate's", "gap (95%): below 0", f"ece: <= {GATE_ECE:g}")
    return Summary(rows, [Table("What kind of thing it is", columns, lines)], lambda: _draw(*together))


def source_rows(source: str, p: Float[np.ndarray, "n kinds"], kind: Int[np.ndarray, "n"]) -> list[Row]:
    """Scores of some objects: probabilities of `KINDS`, and which is true."""
    truth = kind[:, None] == np.arange(len(KINDS))
    scores = -np.log(np.clip(p[truth], LOG_SCORE_CLIP, 1.0))
    base = -np.log(truth.mean(axis=0))[kind]
    ece = hidden_ece(p, truth, np.ones_like(truth))
    return [
        *mean_rows("kinds", METHOD, source, "log_score", scores, "nats"),
        *mean_rows("kinds", METHOD, source, "base", base, "nats"),
        *gap_rows("kinds", METHOD, source, "gap", scores, base),
        Row("kinds", METHOD, source, "ece", ece, "", len(kind)),
    ]


def _draw(p: Float[np.ndarray, "n kinds"], kind: Int[np.ndarray, "n"]) -> Figure:
    """How often it was that kind, against the probability that was told: each kind a line."""
    figure = Figure(figsize=(5.2, 4.6), layout="constrained", dpi=110)
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color="0.8", linewidth=1)
    for which, name in enumerate(KINDS):
        true, bins = kind == which, np.minimum((p[:, which] * BINS).astype(int), BINS - 1)
        shown = [b for b in range(BINS) if (bins == b).sum() >= 5]
        told = [p[bins == b, which].mean() for b in shown]
        ax.plot(told, [true[bins == b].mean() for b in shown], "o-", label=f"{name} ({true.sum()} of {len(true)})")
    ax.set(xlabel="probability that was told", ylabel="how often it was so", xlim=(0, 1), ylim=(0, 1))
    ax.legend(frameon=False)
    return figure
