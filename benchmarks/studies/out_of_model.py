"""Objects that the prior does not know: whether the answer is flagged, and what it says of the space behind them.

Three conditions, over the whole path from RGB-D frame to hypotheses: objects of the family (test seeds, a random
camera); meshes of other sources (`*.obj` under `meshes`, the largest side drawn from 10 to 20 cm, standing on their
own base); and noise, objects of the family whose depths are all drawn anew. A predictive check, the share of
informative pixels that the shapes explain, raises `out_of_model` below a bound that was set on validation objects. The
evidence per informative pixel is shown beside it.

- detected_at_5: share of the strangers below a bound that 5% of the family's objects fail. auc: the probability that a
  check is lower for a random stranger than for a random object of the family. Both use these objects themselves, which
  the shipped bound does not.
- flagged: share with `out_of_model`.
- falsely_free: of random unseen boxes with p_free > 0.95, the share that is truly occupied, for the hypotheses alone
  and as a query answers (with caution where flagged). free: the share of all boxes that is called free.
- hidden_nll: as in `farside bench hidden`, of the answer as a query gives it.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated
from benchmarks.measures.metrics import falsely_free, scored_voxels
from benchmarks.measures.scores import BOXES, Answer, as_queried, random_boxes, score
from benchmarks.scenes.conditions import any_view
from benchmarks.scenes.faults import noise_frame
from benchmarks.scenes.meshes import mesh_view
from benchmarks.scenes.vessels import GRID, VesselView, base_rate, vessel_view
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.sources.frame import Frame
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.pixel_status import UNKNOWN
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.rendering.occupancy import coarsen

MESHES = Path(__file__).resolve().parent.parent.parent.parent / "shared" / "data" / "meshes" / "bullet3"
FAMILY, STRANGERS, NOISE = CONDITIONS = ("the family", "others' meshes", "noise")
METHOD = "tempered_smc"
FIRST = 8000  # of the test seeds: none of the other benchmarks' objects
CHECKS = {"explained": "share of pixels explained", "evidence": "log evidence a pixel"}
COLOURS = {STRANGERS: "tab:red", NOISE: "tab:gray"}


@dataclass(frozen=True)
class Options(PriorOptions):
    """Whether strangers to the prior are flagged, and what is said of the space behind them."""

    n: int = 60
    """Objects of the family, and meshes at most."""
    noise: int = 20
    """Objects of noise."""
    meshes: Path = MESHES
    """Folder under which the meshes (.obj) lie."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=min(options.n, 1), noise=min(options.noise, 1))
    prior, results = load_prior(options.prior), results_of("out_of_model", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config = ControllerConfig()
    settings = {"digest": digest(asdict(config), options.quick)}
    common = {"prior": prior.identity, "method": METHOD, "settings": settings, "seed": options.seed}
    views = list(_views(options.n, options.noise, options.meshes))  # before what takes long: without meshes it raises
    rate = base_rate(128 if options.quick else 1024, config=config.observe)
    for condition, name, make in views:
        line: Line = {**common, "condition": condition, "object": name}
        if line in results:
            continue
        try:
            view = make()
            answered = _answered(view, prior, config, rate, options.seed)
        except ValueError as error:
            answered = {"refused": str(error)}
        results.add({**line, **answered})
        say(f"{condition}, {name}: " + json.dumps({k: v for k, v in answered.items() if not isinstance(v, list)}))


def _views(n: int, noise: int, meshes: Path) -> Iterator[tuple[str, int | str, Callable[[], VesselView]]]:
    """(condition, object, a function that makes its view or raises ValueError)."""
    files = sorted(meshes.rglob("*.obj"))
    if not files:
        raise ValueError(f"no mesh (*.obj) under {meshes}: name a folder that holds some with --meshes")
    for number in TEST_SEEDS[FIRST : FIRST + n]:
        yield FAMILY, number, partial(_of_family, number)
    for i, path in enumerate(files[:n]):
        yield STRANGERS, str(path.relative_to(meshes)), partial(mesh_view, path, i)
    for number in TEST_SEEDS[FIRST + 500 : FIRST + 500 + noise]:
        yield NOISE, number, partial(_of_family, number, lambda frame: noise_frame(frame, 1.0))


def _of_family(number: int, fault: Callable[[Frame], Frame] | None = None) -> VesselView:
    return vessel_view(any_view(number), fault=fault)


def _answered(
    view: VesselView, prior: Prior, config: ControllerConfig, rate: Float[np.ndarray, "32 32 32"], seed: int
) -> dict[str, Any]:
    """What is kept of one answer: the checks, and boxes before and after caution. ValueError: nothing to score."""
    found = estimate(view.frame, view.segment, prior, config, seed=seed, stages=240)
    refuse_cut(found.hypotheses.result)
    h, scored = found.hypotheses, scored_voxels(view.seen, rate)
    if not scored.any():
        raise ValueError("nothing unseen")
    observation = found.observation
    pixels = int(np.sum((np.asarray(observation.status) != UNKNOWN) | (np.asarray(observation.limit) > 0)))
    boxes = random_boxes(scored, BOXES, np.random.default_rng([seed, view.seed, 31]))
    given = {"alone": Answer(coarsen(h.solid, GRID), h.weights, found.seconds), "queried": as_queried(h, found.seconds)}
    judged = {k: score(view, a, rate, boxes, np.random.default_rng(0)) for k, a in given.items()}
    evidence = h.diagnostics.log_evidence / max(pixels, 1)
    return {
        "explained": round(h.diagnostics.explained, 4),
        "evidence": round(evidence, 4) if np.isfinite(evidence) else -1e9,
        "flagged": bool(h.out_of_model),
        "seconds": round(found.seconds, 2),
        **{f"hidden_nll_{k}": round(float(s.values["hidden_nll"]), 4) for k, s in judged.items()},
        **{f"p_free_{k}": s.p_free.round(4).tolist() for k, s in judged.items()},
        "occupied": judged["alone"].occupied.astype(int).tolist(),
    }


def detection(
    family: Float[np.ndarray, "n"], strangers: Float[np.ndarray, "m"], alarms: float = 0.05
) -> tuple[float, float]:
    """(share of the strangers below the family's `alarms` quantile, area under the ROC curve); low means strange."""
    bound = np.quantile(family, alarms)
    below = (strangers[:, None] < family).mean() + 0.5 * (strangers[:, None] == family).mean()
    return float(np.mean(strangers < bound)), float(below)


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the three conditions; None where one has no answers."""
    by = {c: [line for line in lines if line["condition"] == c and "refused" not in line] for c in CONDITIONS}
    if not all(by.values()):
        return None
    rows = []
    for condition, own in by.items():
        values = {"flagged": float(np.mean([line["flagged"] for line in own]))}
        occupied = np.concatenate([line["occupied"] for line in own]).astype(bool)
        for k in ("alone", "queried"):
            p_free = np.concatenate([line[f"p_free_{k}"] for line in own])
            values[f"falsely_free_{k}"] = falsely_free(p_free, occupied)
            values[f"free_{k}"] = float(np.mean(p_free > 0.95))
        if condition != FAMILY:
            for check in CHECKS:
                family, strangers = (np.array([line[check] for line in by[c]]) for c in (FAMILY, condition))
                values[f"detected_at_5_{check}"], values[f"auc_{check}"] = detection(family, strangers)
        rows += [Row("out_of_model", METHOD, condition, k, v, "", len(own)) for k, v in values.items()]
        nll = [line["hidden_nll_queried"] for line in own]
        rows += mean_rows("out_of_model", METHOD, condition, "hidden_nll", nll, "nats")
        refused = sum(line["condition"] == condition for line in lines) - len(own)
        rows.append(Row("out_of_model", METHOD, condition, "refused", float(refused), "", len(own) + refused))
    return Summary(rows, _tables(Figures(rows)), lambda: _draw(lines))


def _tables(of: Figures) -> list[Table]:
    flags, boxes = [], []
    for c in CONDITIONS:
        named = f"{c} ({of.count(c, METHOD, 'flagged')}, {of(c, METHOD, 'refused'):.0f} refused)"
        found = [
            f"{of(c, METHOD, f'detected_at_5_{k}'):.0%} ({of(c, METHOD, f'auc_{k}'):.2f})" if c != FAMILY else ""
            for k in CHECKS
        ]
        flags.append([named, f"{of(c, METHOD, 'flagged'):.1%}", *found, f"{of(c, METHOD, 'hidden_nll'):.3f}"])
        called = []
        for k in ("alone", "queried"):
            wrong, free = of(c, METHOD, f"falsely_free_{k}"), of(c, METHOD, f"free_{k}")
            count = round(free * BOXES * of.count(c, METHOD, "flagged"))
            called.append(f"{wrong:.2f} of {count} ({free:.1%})" if count else "none is called free")
        wrong = of(c, METHOD, "falsely_free_queried")
        boxes.append([named, called[0], gated(called[1], 0.0 if np.isnan(wrong) else wrong, most=0.05)])
    checks = [f"found at 5% false alarms by the {title} (area under the curve)" for title in CHECKS.values()]
    return [
        Table("What is flagged", ("condition (objects)", "flagged", *checks, "hidden_nll, nats"), flags),
        Table(
            "Of boxes called free (0.95), those that are not (share called)",
            ("condition (objects)", "by the hypotheses alone", "as a query answers, gate <= 0.05"),
            boxes,
        ),
    ]


def _draw(lines: Sequence[Line]) -> Figure:
    """ROC of both checks; and where the share that is explained lies, with the bound of the flag."""
    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, 3)
    by = {c: [line for line in lines if line["condition"] == c and "refused" not in line] for c in CONDITIONS}
    for ax, (check, title) in zip(axes, CHECKS.items(), strict=False):
        family = np.sort([line[check] for line in by[FAMILY]])
        bounds = np.concatenate([[-np.inf], np.unique([line[check] for line in lines if check in line]), [np.inf]])
        for condition, colour in COLOURS.items():
            own = np.array([line[check] for line in by[condition]])
            at = [(np.mean(family < b), np.mean(own < b)) for b in bounds]
            ax.step(*np.transpose(at), color=colour, label=f"{condition} ({len(own)})", where="post")
        ax.axvline(0.05, color="0.7", linewidth=0.8)
        ax.set(title=title, xlabel=f"of the family's {len(family)} flagged", ylabel="of the strangers flagged")
    axes[0].legend(fontsize=8)
    bins = np.linspace(0.0, 1.0, 41)
    for condition, colour in {FAMILY: "tab:blue", **COLOURS}.items():
        values = [line["explained"] for line in by[condition]]
        axes[2].hist(values, bins, histtype="step", color=colour, label=condition, linewidth=1.5)
    flagged, left = (
        [x["explained"] for own in by.values() for x in own if x["flagged"] is is_so] for is_so in (True, False)
    )
    if flagged and left:  # each prior has its own bound, which lies between these
        axes[2].axvline(0.5 * (max(flagged) + min(left)), color="k", linewidth=0.8, label="flagged below")
    axes[2].set(title="share of pixels explained", ylabel="objects")
    axes[2].legend(fontsize=8)
    return figure
