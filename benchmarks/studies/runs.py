"""What further runs of the sampler bring: an answer after one run, two, three and four.

Strangers as `farside bench strangers` shows them: scans to choose by, and the household generator's validation objects.
All four runs are made of each, with two seeds; after each the answer is published and scored. A run begins anew; the
answer is of all runs together, and has 48 shapes however many there are.

- balanced: as in `farside bench strangers`, the mean of an object's seeds; above_one: less that of one run, paired.
- spread: the larger seed's score less the smaller one's, mean over objects with both.
- expected_loss: what the answer itself expects to lose by few populations (`publish.expected_loss`), nats a voxel.
- seconds: until the answer, a mean, with the answers published after the runs before, and what had to be compiled.
"""

import time
from collections import defaultdict
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from matplotlib.figure import Figure
from tyro.conf import arg

from benchmarks.harness.intervals import Figures, gap_rows, interval, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, ranged
from benchmarks.measures.point_scores import point_scores
from benchmarks.scenes.strangers import DATA, SETS, StrangerConfig, files, hidden_points, stranger
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import inference_of
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import segment
from probnerf.prior.checkpoint import Prior, load_prior

SEEDS = (0, 1)
COUNTS = (1, 2, 3, 4)
SHOWN = (SETS["gso"], SETS["household"])


@dataclass(frozen=True)
class Options(PriorOptions):
    """What further runs of the sampler bring."""

    set: Literal["gso", "household", "both"] = "both"
    """Scans, the household generator's validation objects, or both."""
    n: int = 100
    """Objects of each set at most."""
    data: Annotated[Path, arg(metavar="DIR")] = DATA
    """Folder of the data."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    prior, results = load_prior(options.prior), results_of("runs", options)
    measure = partial(_measure, options, prior, results)
    return resumed(results, options, measure, lambda: summary(newest(results.lines, prior.identity), options))


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config, scene = replace(ControllerConfig(), runs=COUNTS[-1]), StrangerConfig()
    settings = {"digest": digest([asdict(config), asdict(scene)], options.quick)}
    count = 1 if options.quick else options.n
    for name in ("gso", "household") if options.set == "both" else (options.set,):
        for seed in SEEDS[:1] if options.quick else SEEDS:
            for path in files(SETS[name], options.data, count):
                same = {"prior": prior.identity, "condition": SETS[name], "object": path.stem, "seed": seed}
                lines = [{**same, "method": method_of(number), "settings": settings} for number in COUNTS]
                if all(line in results for line in lines):
                    continue
                for line, told in zip(lines, answers(path, prior, config, scene, seed), strict=True):
                    if line not in results:
                        results.add({**line, **told})
                        shown = ", ".join(f"{k} {v}" for k, v in told.items())
                        say(f"{path.stem}, seed {seed}, {line['method']}: {shown}")


def method_of(number: int) -> str:
    """The name of so many runs in rows."""
    return f"{number} run" + "s" * (number > 1)


def answers(
    path: Path, prior: Prior, config: ControllerConfig, scene: StrangerConfig, seed: int
) -> list[dict[str, Any]]:
    """What is kept of the answer after each run, null for NaN; `refused` where perception does not take the object.

    Raises KeyboardInterrupt where that ended a run.
    """
    seen = stranger(path, scene)
    points, occupied = hidden_points(seen, scene)
    begun = time.monotonic()
    try:
        if not len(points):
            raise ValueError("no point about it is hidden")
        inference = inference_of(seen.frame, segment(seen.frame, 1)[0], prior, config, seed=seed)
        inference.begin()
    except ValueError as error:
        return [{"refused": str(error)} for _ in COUNTS]
    found = []
    while not inference.done:
        inference.step()
        assert inference.answer is not None
        refuse_cut(inference.answer.result)
        seconds = time.monotonic() - begun
        h = replace(inference.answer, out_of_model=False)  # before any alarm's caution
        p = np.array(query([h], Points(points), "camera", now_ns=h.stamp_ns).p_occupied_few)
        values = {
            "balanced": round(float(point_scores(p, occupied)["balanced"]), 4),
            "expected_loss": round(h.diagnostics.expected_loss, 5),
            "explained": round(h.diagnostics.explained, 4),
            "seconds": round(seconds, 1),
        }
        found.append({name: None if np.isnan(value) else value for name, value in values.items()})
    return found


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of each set that has answers; None where none has."""
    rows: list[Row] = []
    for condition in SHOWN:
        own: dict[tuple[str, int], dict[str, Line]] = defaultdict(dict)
        for line in lines:
            if line["condition"] == condition and "refused" not in line:
                own[line["object"], line["seed"]][line["method"]] = line
        if whole := {key: by for key, by in own.items() if len(by) == len(COUNTS)}:
            rows += _rows(condition, whole)
    return Summary(rows, _tables(Figures(rows)), lambda: _draw(Figures(rows))) if rows else None


def _rows(condition: str, whole: dict[tuple[str, int], dict[str, Line]]) -> list[Row]:
    objects = list(dict.fromkeys(name for name, _ in whole))

    def by_object(number: int, metric: str = "balanced") -> list[list[float]]:
        return [
            [_value(by[method_of(number)], metric) for (own, _), by in whole.items() if own == name] for name in objects
        ]

    one, rows = [float(np.mean(values)) for values in by_object(1)], []
    for number in COUNTS:
        name, scores = method_of(number), by_object(number)
        means = [float(np.mean(values)) for values in scores]
        rows += mean_rows("runs", name, condition, "balanced", means, "nats")
        if number > 1:
            rows += gap_rows("runs", name, condition, "above_one", means, one)
        spread = [float(np.ptp(values)) for values in scores if len(values) > 1]
        rows += mean_rows("runs", name, condition, "spread", spread, "nats") if spread else []
        for metric, unit in (("expected_loss", "nats"), ("seconds", "s")):
            value = interval([float(np.mean(values)) for values in by_object(number, metric)]).mean
            rows.append(Row("runs", name, condition, metric, value, unit, len(whole)))
    return rows


def _value(line: Line, metric: str) -> float:
    return float("nan") if line[metric] is None else line[metric]


def _tables(of: Figures) -> list[Table]:
    header = (
        "runs", "objects", "balanced, nats", "above one run's, paired", "largest less smallest seed",
        "expected loss, nats a voxel", "seconds",
    )  # fmt: skip
    found = []
    for c in of.conditions():
        lines = [
            [
                m,
                str(of.count(c, m, "balanced")),
                ranged(of.interval(c, m, "balanced")),
                ranged(of.interval(c, m, "above_one"), sign="+") if (c, m, "above_one") in of else "",
                ranged(of.interval(c, m, "spread")) if (c, m, "spread") in of else "",
                f"{of(c, m, 'expected_loss'):.4f}",
                f"{of(c, m, 'seconds'):.0f}",
            ]
            for m in of.methods(c)
        ]
        found.append(Table(c, header, lines))
    return found


def _draw(of: Figures) -> Figure:
    """Score against seconds, a line a set."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    ax = figure.subplots()
    for c in of.conditions():
        at = [of.interval(c, m, "balanced") for m in of.methods(c)]
        seconds = [of(c, m, "seconds") for m in of.methods(c)]
        ax.errorbar(
            seconds,
            [i.mean for i in at],
            [[i.mean - i.low for i in at], [i.high - i.mean for i in at]],
            marker="o",
            capsize=3,
            label=c,
        )
    ax.set(xlabel="seconds until the answer, after 1, 2, 3 and 4 runs", ylabel="balanced score, nats", ylim=(0.0, None))
    ax.legend(fontsize=8)
    return figure
