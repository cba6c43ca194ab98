"""Things that no one trained on, at rest on a table: what is said of the space behind what was seen, beside a map
without shapes.

Scans of household things at true scale (to choose by) and Bullet's meshes (test only) lie in a stable pose on a plane.
A library's ray caster renders them, not this project's: 640 x 480 pixels from 0.45 to 0.8 m away and 25 to 60 degrees
up, depth with white noise of 1 mm + 2 mm z^2 (z in m) and none at edges; the true mask is given. Perception answers
over the whole path from frame to hypotheses, by default with a limit of stages, so that the load of the machine does
not enter. Points are uniform in the object's box enlarged by 3 cm, above the table and 5 mm or more behind the true
depth; which are occupied, the generalised winding number says.

Methods: the hypotheses alone (*tempered_smc*), the same as a query answers them, which is with caution where the answer
is flagged, and a Bayesian Hilbert map as V-PRISM makes it (*hilbert_map*, with its published numbers); and, of a prior
with a posterior network, the first answer, which is the network's alone (*first answer*). To answer one half everywhere
scores 0.693.

- log_score: mean -log of the probability of a point's truth. balanced: half the mean -log p over occupied points and
  half the mean -log(1 - p) over free ones, p clipped to 0.001 ... 0.999. Both are means over objects.
- ece: calibration error in 15 bins that pool all objects, each with the same weight. ece_object: the mean over objects
  of each one's own error, which is larger, as points of one object err together.
- free: share of points with p <= 0.05. free_occupied: share of these that are occupied. Every object has the same
  weight, whatever the number of its points.
- out_of_model: share of objects that are flagged. explained_q05: the share of its pixels that the shapes explain of
  all but the worst 5% of the objects.
- outside: share of the occupied points that lie outside the cube in which perception looks for the object, where an
  answer is always "free".
- refused: objects that perception does not take. They have no answer, and no part in any mean.
"""

import time
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from tyro.conf import arg

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, read_lines
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.point_scores import point_scores, pooled_ece
from benchmarks.scenes.strangers import DATA, SETS, Stranger, StrangerConfig, files, hidden_points, stranger
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import estimate
from perception.inference.hilbert_map import HilbertMapConfig, hilbert_map
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment, segment
from perception.simulation.sensor_draws import told_pose
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior, load_prior

ALONE, QUERIED, RIVAL = "tempered_smc", "tempered_smc, as queried", "hilbert_map"
FIRST = "first answer"
METHODS = (ALONE, QUERIED, RIVAL, FIRST)
DONT_KNOW = float(np.log(2.0))  # nats; what one half everywhere scores
WITHOUT = ", without depth"  # after a set's name: the camera's pose is told instead, with an error (`told_pose`)
BEFORE = "before"  # the method's name in rows of an older file
AIMS = {"balanced": 0.5, "ece": 0.08, "free_occupied": 0.05, "free": 0.15, "out_of_model": 0.20}
SCORES = ("log_score", "balanced", "ece")


@dataclass(frozen=True)
class Options(PriorOptions):
    """Things that no one trained on: the space behind what was seen, beside a map without shapes."""

    set: Literal["gso", "bullet", "both", "household"] = "gso"
    """Scans, to choose by; Bullet's meshes, for the test alone; both; or the household generator's validation objects,
    which are no strangers to a prior that learnt it."""
    n: int = 100
    """Objects of each set at most."""
    without_depth: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Drop the depth, and tell the camera's pose with an error. The map without shapes has no answer then."""
    stages: int = 60
    """Stages that the sampler may take."""
    budget_s: float = 0.0
    """Seconds that an object may take, instead of the stages (0: the stages hold)."""
    before: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: no)")] = None
    """Rows of another revision or prior to compare with, on the same objects."""
    data: Path = DATA
    """Folder of the data."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=min(options.n, 1), stages=min(options.stages, 10))
    prior, results = load_prior(options.prior), results_of("strangers", options)
    return resumed(
        results,
        options,
        partial(_measure, options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config, scene, map_config = ControllerConfig(), StrangerConfig(), HilbertMapConfig()
    limit = {"budget_s": options.budget_s} if options.budget_s else {"stages": options.stages}
    ours = {"digest": digest([asdict(config), asdict(scene)], options.quick), **limit}
    rival = {"digest": digest([asdict(map_config), asdict(scene)], options.quick)}
    settings = {ALONE: ours, QUERIED: ours} | ({} if options.without_depth else {RIVAL: rival})
    if prior.network is not None:
        settings[FIRST] = ours
    for name in ["gso", "bullet"] if options.set == "both" else [options.set]:
        for path in files(SETS[name], options.data, options.n):
            condition = SETS[name] + WITHOUT * options.without_depth
            common = {"prior": prior.identity, "condition": condition, "object": path.stem, "seed": options.seed}
            lines = {method: {**common, "method": method, "settings": own} for method, own in settings.items()}
            if all(line in results for line in lines.values()):
                continue
            for method, told in _answers(path, prior, config, map_config, scene, options).items():
                results.add({**lines[method], **told})
                say(f"{path.stem}, {method}: " + ", ".join(f"{k} {v}" for k, v in told.items() if k != "errors"))


def _answers(
    path: Path,
    prior: Prior,
    config: ControllerConfig,
    map_config: HilbertMapConfig,
    scene: StrangerConfig,
    options: Options,
) -> dict[str, dict[str, Any]]:
    """What is kept of each method's answer to one object; `refused` where perception does not take it."""
    seen = stranger(path, scene)
    points, occupied = hidden_points(seen, scene)
    ours = (QUERIED, ALONE) if prior.network is None else (QUERIED, ALONE, FIRST)
    try:
        if not len(points):
            raise ValueError("no point about it is hidden")
        frame = _blind(seen) if options.without_depth else seen.frame
        found = segment(frame, 1)[0]
    except ValueError as error:
        return {m: {"refused": str(error)} for m in (ours if options.without_depth else (*ours, RIVAL))}
    answered: dict[str, dict[str, Any]] = {}
    if not options.without_depth:
        begun = time.monotonic()
        smooth = hilbert_map(frame, found, map_config).p_occupied(points)
        answered[RIVAL] = {**_told(smooth, occupied), "seconds": round(time.monotonic() - begun, 2)}
    try:
        return answered | _of_perception(frame, found, points, occupied, prior, config, options)
    except ValueError as error:
        return answered | {method: {"refused": str(error)} for method in ours}


def _blind(seen: Stranger) -> Frame:
    """The frame without depth, and with the camera's pose over the table as a user might tell it."""
    told = told_pose(seen.T_world_camera, np.random.default_rng([zlib.crc32(seen.name.encode()), 71]))
    return replace(seen.frame, depth=None, T_world_camera=told)


def _of_perception(
    frame: Frame,
    found: Segment,
    points: Float[np.ndarray, "n 3"],
    occupied: Bool[np.ndarray, "n"],
    prior: Prior,
    config: ControllerConfig,
    options: Options,
) -> dict[str, dict[str, Any]]:
    """The hypotheses' answer by the public query, before any alarm's caution and with it, and a network's."""
    answers: list[Hypotheses] = []
    first = time.monotonic()
    seconds: list[float] = []

    def keep(h: Hypotheses) -> None:
        answers.append(h)
        seconds.append(round(time.monotonic() - first, 2))

    made = estimate(
        frame,
        found,
        prior,
        config,
        seed=options.seed,
        budget_s=options.budget_s or None,
        stages=None if options.budget_s else options.stages,
        on_answer=keep if prior.network is not None else None,
    )
    h, checks = made.hypotheses, made.hypotheses.diagnostics
    beyond = h.voxels("camera", *points[occupied].T) < 0
    state = {
        "outside": round(float(beyond.mean()), 4) if len(beyond) else None,
        "out_of_model": bool(h.out_of_model),
        "explained": round(checks.explained, 4),
        "failed": int(np.nan_to_num(checks.failed_populations)),
        "stage": int(h.stage),
        "result": str(h.result),
        "seconds": round(made.seconds, 2),
    }
    given = {QUERIED: h, ALONE: replace(h, out_of_model=False)}
    told = {method: {**_asked(g, points, occupied), **state} for method, g in given.items()}
    if prior.network is not None:
        told[FIRST] = {**_asked(replace(answers[0], out_of_model=False), points, occupied), "seconds": seconds[0]}
    return told


def _asked(h: Hypotheses, points: Float[np.ndarray, "n 3"], occupied: Bool[np.ndarray, "n"]) -> dict[str, Any]:
    return _told(np.array(query([h], Points(points), "camera", now_ns=h.stamp_ns).p_occupied_few), occupied)


def _told(p: Float[np.ndarray, "n"], occupied: Bool[np.ndarray, "n"]) -> dict[str, Any]:
    """Scores, rounded; null for NaN."""
    told = {"points": len(p), "occupied": int(occupied.sum()), **point_scores(p, occupied)}
    told |= {name: None if np.isnan(told[name]) else round(told[name], 4) for name in SCORES}
    return {**told, "errors": [round(error, 4) for error in told["errors"]]}


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the sets that have answers; None where none has."""
    older = read_lines(options.before) if options.before is not None else []
    if older:
        older = [line for line in newest(older, older[-1]["prior"]) if line["method"] == ALONE]
    rows: list[Row] = []
    for condition in (name + suffix for suffix in ("", WITHOUT) for name in SETS.values()):
        of = {method: _by_object(lines, method, condition) for method in METHODS}
        if not of[ALONE]:
            continue
        of[BEFORE] = _by_object(older, ALONE, condition)
        for method, own in of.items():
            rows += _method_rows(method, condition, list(own.values())) if own else []
        rows += _gaps(condition, of)
        refused = sum(line["condition"] == condition and line["method"] == ALONE for line in lines) - len(of[ALONE])
        rows.append(Row("strangers", ALONE, condition, "refused", float(refused), "", len(of[ALONE]) + refused))
    tables = [_score_table(figures := Figures(rows)), _gap_table(figures)]
    return Summary(rows, tables, lambda: _draw(lines)) if rows else None


def _by_object(lines: Sequence[Line], method: str, condition: str) -> dict[str, Line]:
    own = (line for line in lines if line["method"] == method and line["condition"] == condition)
    return {line["object"]: line for line in own if "refused" not in line}


def _values(own: Sequence[Line], metric: str) -> Float[np.ndarray, "n"]:
    return np.array([np.nan if line[metric] is None else line[metric] for line in own], np.float64)


def _method_rows(method: str, condition: str, own: list[Line]) -> list[Row]:
    count = np.array([line["points"] for line in own], np.float64)
    called, wrong = _values(own, "free") / count, _values(own, "free_occupied") / count
    values = {"ece": pooled_ece([line["errors"] for line in own]), "ece_object": float(np.mean(_values(own, "ece")))}
    values |= {
        "free": float(called.mean()),
        "free_occupied": float(wrong.sum() / called.sum()) if called.any() else 0.0,
    }
    values |= {k: float(np.nanmean(_values(own, k))) for k in ("out_of_model", "outside", "seconds") if k in own[0]}
    if "explained" in own[0]:
        values["explained_q05"] = float(np.quantile(_values(own, "explained"), 0.05))
    rows = [Row("strangers", method, condition, k, v, "s" * (k == "seconds"), len(own)) for k, v in values.items()]
    for metric in ("log_score", "balanced"):
        rows += mean_rows("strangers", method, condition, metric, _values(own, metric), "nats")
    return rows


def _gaps(condition: str, of: dict[str, dict[str, Line]]) -> list[Row]:
    """Paired differences of the hypotheses alone from the rival, from one half, and from older rows.

    Raises ValueError where the older rows score other points.
    """
    rows = gap_rows(
        "strangers",
        ALONE,
        condition,
        "balanced_over_one_half",
        _values(list(of[ALONE].values()), "balanced"),
        np.full(len(of[ALONE]), DONT_KNOW),
    )
    for other in (RIVAL, BEFORE):
        names = [name for name in of[ALONE] if name in of[other]]
        for name in names:
            scored = {(own[name]["points"], own[name]["occupied"]) for own in (of[ALONE], of[other])}
            if len(scored) > 1:
                raise ValueError(f"{name}: rows of {other} are of other points; measure both with the same scenes")
        if names:
            a, b = (_values([of[method][name] for name in names], "balanced") for method in (ALONE, other))
            rows += gap_rows("strangers", ALONE, condition, f"balanced_over_{other}", a, b)
            rows.append(Row("strangers", ALONE, condition, f"better_than_{other}", float(np.mean(a < b)), "", len(a)))
    return rows


def _score_table(of: Figures) -> Table:
    lines = []
    for c in of.conditions():
        for method in of.methods(c):
            values = {metric: of(c, method, metric) for metric in AIMS}
            texts = {metric: f"{value:.3f}" for metric, value in values.items()}
            texts["balanced"] = ranged(of.interval(c, method, "balanced"))
            if method == ALONE:
                for metric, aim in AIMS.items():
                    least = aim if metric == "free" else float("-inf")
                    texts[metric] = gated(texts[metric], values[metric], least, 1.0 if metric == "free" else aim)
            if np.isnan(values["out_of_model"]):
                texts["out_of_model"] = ""
            score = ranged(of.interval(c, method, "log_score"))
            lines.append([f"{c} ({of.count(c, method, 'ece')})", method, score, *texts.values()])
    header = (
        "condition (objects)", "method", "log score, nats", "balanced, gate <= 0.5", "calibration error, gate <= 0.08",
        "of those called free, occupied, gate <= 0.05", "called free (p <= 0.05), gate >= 0.15",
        "out_of_model, gate <= 0.20",
    )  # fmt: skip
    return Table("Unseen points about strangers (one half everywhere scores 0.693)", header, lines)


def _gap_table(of: Figures) -> Table:
    lines = []
    for c in of.conditions():
        for other in ("one_half", RIVAL, BEFORE):
            if (c, ALONE, metric := f"balanced_over_{other}") not in of:
                continue
            gap = of.interval(c, ALONE, metric)
            text = ranged(gap, sign="+")
            better = of(c, ALONE, f"better_than_{other}")
            share = "" if np.isnan(better) else f"{better:.0%} of {gap.n}"
            lines.append(
                [c, other.replace("_", " "), text if other == BEFORE else gated(text, gap.high, most=0), share]
            )
        refused = of(c, ALONE, "refused")
        lines[-1][0] += f" ({refused:.0f} of {of.count(c, ALONE, 'refused')} refused)"
    title = "Balanced score of the hypotheses alone less another's, nats, paired; gate: the interval's upper end <= 0"
    return Table(title, ("condition", "other", "difference", "better"), lines)


def _draw(lines: Sequence[Line]) -> Figure:
    """Balanced scores of every object beside the rival's."""
    figure = Figure(figsize=(6, 6), layout="constrained")
    ax = figure.subplots()
    most = 1.0
    for condition, colour in zip(SETS.values(), ("tab:blue", "tab:red", "tab:green"), strict=True):
        ours, rival = (_by_object(lines, method, condition) for method in (ALONE, RIVAL))
        if names := [name for name in ours if name in rival]:
            a, b = (_values([own[name] for name in names], "balanced") for own in (rival, ours))
            ax.plot(a, b, "o", color=colour, label=f"{condition} ({len(names)})", markersize=4)
            most = max(most, float(np.nanmax([a, b])))
    ax.axline((0.5, 0.5), slope=1.0, color="0.7", linewidth=0.8)
    ax.axhline(DONT_KNOW, color="k", linewidth=0.8, linestyle=":", label="one half everywhere")
    ax.axvline(DONT_KNOW, color="k", linewidth=0.8, linestyle=":")
    ax.set(xlim=(0.0, 1.05 * most), ylim=(0.0, 1.05 * most), aspect="equal")
    ax.set(xlabel="balanced score of the map without shapes, nats", ylabel="of the hypotheses, nats")
    ax.legend(fontsize=8)
    return figure
