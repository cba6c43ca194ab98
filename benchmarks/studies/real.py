"""Real frames with known models: what is said of the space behind what was seen, beside a map without shapes.

Three frames (YCB-Video 000002, PoseCNN's two demonstration frames), read from ../shared/data beside the checkout,
eleven objects, each with its true mask and with the mask that `segment` finds without the label map, for three seeds of
the sampler. Poses of PoseCNN's objects were fitted to the depth; `fit_mm` says how well. Perception answers over the
whole path from frame to hypotheses with a limit of stages, so that the load of the machine does not enter. Beside it,
on the same masks, a Bayesian Hilbert map as V-PRISM makes it; V-PRISM itself (arXiv 2403.08106) scored on the first
frame, with true masks: can 0.80, pitcher 1.23, sugar box 0.44, meat can 0.15 (whether it left out what is below the
measured table is not known). To answer one half everywhere scores 0.693.

- balanced: half the mean -log p_occupied over points of the hidden surface (at least 10 mm behind the measured depth)
  plus half the mean -log(1 - p_occupied) over unseen free points (`real_objects.free_points`), p clipped to 0.001 ...
  0.999. All above the measured plane, as in the other studies. A score is the mean of an object's seeds; `spread` is
  the largest seed less the smallest.
- in_table: share of the hidden surface that lies below the measured plane, and balanced_with_table the score with it.
  Nothing can be in a table, so that pose and depth contradict each other there.
- ece: calibration error over these points, pooled over objects.
- near: mean p_occupied of hidden points 5 to 15 mm outside of the surface. To dilate a shape raises it.
- in_sight: share of the surface in sight with p_occupied >= 0.9 within one voxel.
- chamfer: between a hypothesis and the true model, mm, the weighted median.

The mean and the gates count objects of the data set's own pose, or with fit_mm <= 4. The masks' rules were developed on
these frames; the prior and the sampler were not.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated
from benchmarks.measures.point_scores import point_scores, pooled_ece
from benchmarks.measures.real_objects import chamfer_mm, free_points, hidden_surface, in_sight, near_points
from benchmarks.scenes.real_frames import DATA, TrueObject, frames, read_truth
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import estimate
from perception.inference.hilbert_map import HilbertMapConfig, hilbert_map
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment, Segments, segment
from perception.sources.frame import Frame
from probnerf.prior.checkpoint import Prior, load_prior

OURS, RIVAL = "tempered_smc", "hilbert_map"
MASKS = ("true mask", "own mask")
SEEDS = (0, 1, 2)
FITTED = 4.0  # mm; poses that were fitted worse count for no gate
AIMS = {"mean": 0.30, "worst": 0.6, "over_rival": 0.1, "ece": 0.06, "spread": 0.05, "in_sight": 0.95}
DIGITS = {"in_sight": 3, "chamfer": 1, "seconds": 1}
ONE_OBJECT = ("balanced_with_table", "in_table", "near", *DIGITS)


@dataclass(frozen=True)
class Options(PriorOptions):
    """Real frames with known models: the space behind what was seen, beside a map without shapes."""

    stages: int = 60
    """Stages that the sampler may take."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, stages=min(options.stages, 10))
    prior, results = load_prior(options.prior), results_of("real", options)
    return resumed(
        results,
        options,
        partial(_measure, options, prior, results),
        lambda: summary(newest(results.lines, prior.identity), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config, map_config = ControllerConfig(), HilbertMapConfig()
    settings = {
        OURS: {"digest": digest([asdict(config)], options.quick), "stages": options.stages},
        RIVAL: {"digest": digest([asdict(map_config)], options.quick)},
    }
    for name, real, frame in frames():
        truth = read_truth(DATA / real.folder)
        for object_id, own in truth.items() if not options.quick else list(truth.items())[:1]:
            for mask in MASKS:
                given = frame if mask == MASKS[0] else replace(frame, label=None)
                for seed in SEEDS if not options.quick else SEEDS[:1]:
                    for method in (OURS, RIVAL) if seed == SEEDS[0] else (OURS,):
                        line = {
                            "prior": prior.identity,
                            "condition": mask,
                            "object": f"{name}: {real.things[object_id]}",
                            "seed": seed,
                            "method": method,
                            "settings": settings[method],
                        }
                        if line in results:
                            continue
                        assert frame.label is not None
                        found = matching(segment(given), frame.label == object_id)
                        told: dict[str, Any] = {"refused": "not found"}
                        if found is not None and method == OURS:
                            told = _of_perception(given, found, truth, object_id, prior, config, seed, options.stages)
                        elif found is not None:
                            told = _of_map(given, found, truth, object_id, map_config)
                        results.add({**line, "fit_mm": own.fit_mm, **told})
                        shown = (f"{k} {v}" for k, v in told.items() if k != "errors")
                        say(f"{line['object']}, {mask}, seed {seed}, {method}: {', '.join(shown)}")


def matching(segments: Segments, mask: Bool[np.ndarray, "h w"]) -> Segment | None:
    """The segment of largest IoU with a mask; None where none overlaps it by a quarter."""
    overlap = [float((s.mask & mask).sum() / (s.mask | mask).sum()) for s in segments]
    best = int(np.argmax(overlap)) if overlap else -1
    return segments[best] if best >= 0 and overlap[best] >= 0.25 else None


def _of_perception(
    frame: Frame,
    found: Segment,
    truth: Mapping[int, TrueObject],
    object_id: int,
    prior: Prior,
    config: ControllerConfig,
    seed: int,
    stages: int,
) -> dict[str, Any]:
    try:
        made = estimate(frame, found, prior, config, seed=seed, budget_s=None, stages=stages)
    except ValueError as error:
        return {"refused": str(error)}
    h, own = made.hypotheses, truth[object_id]
    told = _told(partial(_asked, h), frame, found, truth, object_id)
    own_values = {"in_sight": in_sight(h, frame, own), "chamfer": chamfer_mm(h, own), "seconds": made.seconds}
    told |= {name: round(value, DIGITS[name]) for name, value in own_values.items()}
    state = {"out_of_model": bool(h.out_of_model), "stage": int(h.stage), "result": str(h.result)}
    return told | state | {"r_hat": round(float(h.diagnostics.r_hat), 2)}


def _of_map(
    frame: Frame, found: Segment, truth: Mapping[int, TrueObject], object_id: int, config: HilbertMapConfig
) -> dict[str, Any]:
    begun = time.monotonic()
    smooth = hilbert_map(frame, found, config)
    seconds = round(time.monotonic() - begun, 2)
    return {**_told(smooth.p_occupied, frame, found, truth, object_id), "seconds": seconds}


def _told(
    p_occupied: Any, frame: Frame, found: Segment, truth: Mapping[int, TrueObject], object_id: int
) -> dict[str, Any]:
    """Scores of p_occupied(points in the camera frame), rounded."""
    surface, in_table = hidden_surface(frame, found.plane, truth[object_id])
    free = free_points(frame, found.plane, truth, object_id)
    p = p_occupied(np.concatenate([in_table, surface, free]))
    occupied = np.arange(len(p)) < len(in_table) + len(surface)
    everywhere = point_scores(p, occupied)
    p, occupied = p[len(in_table) :], occupied[len(in_table) :]
    scores = point_scores(p, occupied)
    near = float(np.mean(p_occupied(near_points(frame, found.plane, truth, object_id))))
    return {
        "balanced": round(scores["balanced"], 4),
        "balanced_with_table": round(everywhere["balanced"], 4),
        "in_table": round(len(in_table) / max(len(in_table) + len(surface), 1), 3),
        "near": round(near, 3),
        "free": scores["free"],
        "free_occupied": scores["free_occupied"],
        "points": len(occupied),
        "errors": [round(error, 4) for error in scores["errors"]],
    }


def _asked(h: Hypotheses, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.array(query([h], Points(points), "camera", now_ns=h.stamp_ns).p_occupied_few)


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of each mask; None where nothing was measured."""
    del options
    rows: list[Row] = []
    tables = []
    for mask in MASKS:
        own = [line for line in lines if line["condition"] == mask]
        if own:
            made, table = _of_mask(mask, own)
            rows += made
            tables.append(table)
    return Summary(rows, tables, lambda: _draw(lines)) if rows else None


def _of_mask(mask: str, lines: Sequence[Line]) -> tuple[list[Row], Table]:
    names = list(dict.fromkeys(line["object"] for line in lines))
    rows, cells, counted = list[Row](), list[list[str]](), dict[str, list[float]]()
    errors: dict[str, list[list[float]]] = {OURS: [], RIVAL: []}
    refused = 0
    for name in names:
        of = {
            method: [line for line in lines if line["object"] == name and line["method"] == method]
            for method in (OURS, RIVAL)
        }
        fit = of[OURS][0]["fit_mm"]
        if any("refused" in line for line in of[OURS]):
            refused += 1
            cells.append([name, f"{fit:g}", f"refused: {of[OURS][0].get('refused', '')}", *[""] * 7])
            continue
        values = {metric: _mean(of[OURS], metric) for metric in ("balanced", *ONE_OBJECT)}
        scores = [line["balanced"] for line in of[OURS]]
        values |= {"spread": max(scores) - min(scores), "rival": _mean(of[RIVAL], "balanced")}
        values |= {"out_of_model": float(np.mean([line["out_of_model"] for line in of[OURS]]))}
        rows += [Row("real", OURS, f"{mask}, {name}", metric, v, "", len(scores)) for metric, v in values.items()]
        if fit <= FITTED:
            for metric, v in values.items():
                counted.setdefault(metric, []).append(v)
            for method, own in of.items():
                errors[method] += [line["errors"] for line in own]
        cells.append(
            [
                name,
                f"{fit:g}",
                gated(f"{values['balanced']:.2f}", values["balanced"], most=AIMS["worst"]),
                f"{values['balanced_with_table']:.2f} ({values['in_table']:.0%})",
                f"{values['spread']:.2f}",
                gated(f"{values['rival']:.2f}", values["balanced"] - values["rival"], most=AIMS["over_rival"]),
                gated(f"{values['in_sight']:.2f}", values["in_sight"], least=AIMS["in_sight"]),
                f"{values['near']:.2f}",
                f"{values['chamfer']:.1f}",
                f"{values['out_of_model']:.0%}",
            ]
        )
    if counted:
        ece = {method: pooled_ece(own) for method, own in errors.items()}
        mean, spread = float(np.mean(counted["balanced"])), float(np.median(counted["spread"]))
        with_table, n = float(np.mean(counted["balanced_with_table"])), len(counted["balanced"])
        rows += [Row("real", method, mask, "ece", value, "", n) for method, value in ece.items()]
        rows += [
            Row("real", OURS, mask, "balanced", mean, "nats", n),
            Row("real", OURS, mask, "balanced_with_table", with_table, "nats", n),
            Row("real", RIVAL, mask, "balanced", float(np.mean(counted["rival"])), "nats", n),
            Row("real", OURS, mask, "spread_median", spread, "nats", n),
            Row("real", OURS, mask, "near", float(np.mean(counted["near"])), "", n),
            Row("real", OURS, mask, "refused", float(refused), "", len(names)),
        ]
        cells.append(
            [
                f"mean of the {n} with fit <= {FITTED:g} mm; calibration error "
                + gated(f"{ece[OURS]:.3f} (the map's {ece[RIVAL]:.3f})", ece[OURS], most=AIMS["ece"]),
                "",
                gated(f"{mean:.3f}", mean, most=AIMS["mean"]),
                f"{with_table:.3f}",
                gated(f"median {spread:.3f}", spread, most=AIMS["spread"]),
                f"{np.mean(counted['rival']):.3f}",
                f"{np.mean(counted['in_sight']):.2f}",
                f"{np.mean(counted['near']):.3f}",
                f"{np.mean(counted['chamfer']):.1f}",
                f"{np.mean(counted['out_of_model']):.0%}",
            ]
        )
    header = (
        "object", "fit, mm", "balanced, nats, gates <= 0.6, mean <= 0.30",
        "with the surface in the table (its share)", "largest less smallest seed, gate <= 0.05",
        "the map's, gate: at most 0.1 better", "surface in sight, gate >= 0.95", "p 5 to 15 mm outside",
        "Chamfer, mm", "out_of_model",
    )  # fmt: skip
    return rows, Table(f"Real objects, {mask}, means of three seeds", header, cells)


def _mean(lines: Sequence[Line], metric: str) -> float:
    return float(np.mean([line[metric] for line in lines])) if lines else float("nan")


def _draw(lines: Sequence[Line]) -> Figure:
    """Every object's scores: of the hypotheses (each seed a point) and of the map."""
    names = list(dict.fromkeys(line["object"] for line in lines))
    figure = Figure(figsize=(9, 0.36 * len(names) + 1.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for ax, mask in zip(axes, MASKS, strict=True):
        for method, marker, colour in ((RIVAL, "|", "tab:red"), (OURS, "o", "tab:blue")):
            own = [line for line in lines if line["condition"] == mask and line["method"] == method]
            own = [line for line in own if "refused" not in line]
            at = [names.index(line["object"]) for line in own]
            size = 14 if marker == "|" else 4
            ax.plot([line["balanced"] for line in own], at, marker, color=colour, markersize=size, label=method)
        ax.axvline(np.log(2.0), color="k", linewidth=0.8, linestyle=":", label="one half everywhere")
        ax.set(title=mask, xlabel="balanced log score, nats (less is better)", xlim=(0, None))
    axes[0].set_yticks(range(len(names)), names)
    axes[0].legend(fontsize=7)
    return figure
