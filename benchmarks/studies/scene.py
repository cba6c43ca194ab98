"""A table with ten things on it, half hidden behind each other: when all have an answer, and how good it is by when.

Simulated scenes of the family's test objects (`benchmarks.scenes.crowded`), a depth camera's faults, true masks. All
objects share one budget, which counts from before the masks are read. Unseen space is asked at points about each
object, 5 mm or more behind what is seen there; every object has the same weight.

Methods: the scene in rounds (first answers for all, a run each in its share of the time that is left, then again those
that were cut, while there is room) with a budget and with four times as much, which ends when each has its run; and
*one by one*, each with its tenth of the budget, as before there were rounds.
A scene of another seed is inferred before, so that nothing is compiled within the time.

- log_score: mean -log of the probability of a point's truth, nats, p clipped to 0.001 ... 0.999. gap: of the rounds,
  less that with four times the budget, with a 95% interval over scenes.
- first: seconds until the last object had its first answer. seconds: until the last one was done.
- without_run: objects whose answer is the network's or encoder's guess alone.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.intervals import paired_interval
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated
from benchmarks.measures.point_scores import point_scores
from benchmarks.scenes.crowded import Crowd, crowd, hidden_points
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import inference_of
from perception.inference.inference import Inference
from perception.inference.limits import Callbacks, Limits
from perception.inference.scene import estimate_scene
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment, segment
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.types import StopReason

WARM = 99  # seed of the scene before
AIMS = {"first": 3.0, "gap": 0.01}


@dataclass(frozen=True)
class Options(PriorOptions):
    """Ten things on a table within one budget: when all have an answer, and how good it is by when."""

    n: int = 10
    """Scenes."""
    budget: float = 20.0
    """Seconds for a scene."""


def methods(options: Options) -> dict[str, tuple[float, bool]]:
    """Budget (s), and whether in rounds, by name."""
    return {
        f"rounds, {options.budget:g} s": (options.budget, True),
        f"rounds, {4 * options.budget:g} s": (4 * options.budget, True),
        f"one by one, {options.budget:g} s": (options.budget, False),
    }


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=1, budget=5.0)
    prior, results = load_prior(options.prior), results_of("scene", options)
    return resumed(
        results,
        options,
        partial(_measure, options, prior, results),
        lambda: summary(newest(results.lines, prior.identity), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config = ControllerConfig()
    if not options.quick:
        answers(crowd(WARM), prior, config, 0, options.budget, rounds=True)
    for seed in range(options.n):
        made = None
        for method, (budget, rounds) in methods(options).items():
            settings = {"digest": digest([asdict(config)], options.quick), "budget": budget}
            line = {
                "prior": prior.identity, "condition": "ten things", "object": seed, "seed": options.seed,
                "method": method, "settings": settings,
            }  # fmt: skip
            if line in results:
                continue
            made = made or crowd(seed)
            told = _told(made, *answers(made, prior, config, options.seed, budget, rounds))
            results.add({**line, **told})
            say(f"scene {seed}, {method}: {', '.join(f'{k} {v}' for k, v in told.items())}")


def answers(
    made: Crowd, prior: Prior, config: ControllerConfig, seed: int, budget_s: float, rounds: bool
) -> tuple[dict[int, Hypotheses], float, float, int]:
    """Hypotheses by object, seconds until all had an answer and until the end, and how many were refused."""
    begun = time.monotonic()
    first, done = dict[int, float](), dict[int, Hypotheses]()
    found = segment(made.frame)

    def heard(object_id: int, h: Hypotheses) -> None:
        del h
        first.setdefault(object_id, time.monotonic() - begun)

    def start(one: Segment, deadline: float | None) -> Inference:
        callbacks = Callbacks(on_answer=partial(heard, one.id))
        return inference_of(made.frame, one, prior, config, seed=seed, limits=Limits(deadline), callbacks=callbacks)

    each = [list(found)] if rounds else [[one] for one in found]
    for i, objects in enumerate(each, start=1):
        for one, estimate in estimate_scene(objects, start, begun + budget_s * i / len(each)):
            if not isinstance(estimate, ValueError):
                done[one.id] = estimate.hypotheses
    return done, max(first.values(), default=float("nan")), time.monotonic() - begun, len(found) - len(done)


def _told(made: Crowd, done: dict[int, Hypotheses], first: float, seconds: float, refused: int) -> dict[str, Any]:
    scores = []
    for object_id, h in done.items():
        points, occupied = hidden_points(made, object_id)
        p = np.array(query([h], Points(points), "camera", now_ns=h.stamp_ns).p_occupied_few)
        scores.append(point_scores(p, occupied)["log_score"])
    return {
        "log_score": round(float(np.mean(scores)), 4),
        "first": round(first, 2),
        "seconds": round(seconds, 1),
        "objects": len(done),
        "without_run": sum(h.stage == 0 and h.result != StopReason.CONVERGED for h in done.values()),
        "refused": refused,
    }


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of each method; None where nothing was measured."""
    names = [name for name in methods(options) if any(line["method"] == name for line in lines)]
    if not names:
        return None
    most = f"rounds, {4 * options.budget:g} s"
    rows, cells = list[Row](), []
    for name in names:
        own = {line["object"]: line for line in lines if line["method"] == name}
        best = {line["object"]: line for line in lines if line["method"] == most}
        values = {
            metric: float(np.mean([line[metric] for line in own.values()]))
            for metric in ("log_score", "seconds", "objects", "without_run", "refused")
        }
        values["first"] = max(line["first"] for line in own.values())
        both = sorted(own.keys() & best.keys())
        gap = paired_interval(*([of[i]["log_score"] for i in both] for of in (own, best)))
        rows += [Row("scene", name, "ten things", metric, v, "", len(own)) for metric, v in values.items()]
        if name != most:
            rows.append(Row("scene", name, "ten things", "gap", gap.mean, "nats", gap.n))
        shown = "" if name == most else f"{gap.mean:+.3f} ({gap.low:+.3f} to {gap.high:+.3f})"
        cells.append(
            [
                name,
                f"{values['log_score']:.3f}",
                gated(shown, gap.mean, most=AIMS["gap"]) if name == names[0] and shown else shown,
                gated(f"{values['first']:.1f}", values["first"], most=AIMS["first"])
                if "rounds" in name
                else f"{values['first']:.1f}",
                f"{values['seconds']:.1f}",
                f"{values['objects']:.1f}",
                f"{values['without_run']:.1f}",
                f"{values['refused']:.1f}",
            ]
        )
    header = (
        "method", "log score, nats", "less that with four times the budget, gate <= 0.01",
        "slowest scene's first answers, s, gate <= 3", "seconds", "objects", "with a first answer alone", "refused",
    )  # fmt: skip
    n = len({line["object"] for line in lines})
    return Summary(rows, [Table(f"Ten things on a table, {n} scenes", header, cells)], lambda: _draw(lines, names))


def _draw(lines: Sequence[Line], names: Sequence[str]) -> Figure:
    fig = Figure(figsize=(6.5, 3.6), layout="constrained")
    ax = fig.subplots()
    for i, name in enumerate(names):
        own = [line["log_score"] for line in lines if line["method"] == name]
        ax.plot(np.full(len(own), i), own, "o", alpha=0.5, color=f"C{i}")
        ax.plot([i - 0.2, i + 0.2], [np.mean(own)] * 2, color=f"C{i}", lw=2)
    ax.set_xticks(range(len(names)), names)
    ax.set_ylabel("log score of unseen points, nats\n(lower is better)")
    ax.set_ylim(bottom=0.0)
    return fig
