"""The weights' perturbation delta: a sweep of its scale, and objects that the prior does not know."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.harness.intervals import Figures, gap_rows
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, ranged
from benchmarks.paper.conditioned import PLACES, Conditioned
from benchmarks.paper.experiment import Run, answer_table
from benchmarks.paper.families import Subject
from benchmarks.paper.methods import DELTA_SCALE, HMC, HMC_DELTA, OWN, SWEEP
from benchmarks.paper.posteriors import Rated, keep_answer, keep_rival
from benchmarks.paper.rival_answers import TrainedRival
from benchmarks.scenes.road_meshes import MODELS, read_road_mesh, road_mesh_file

TELLING = PLACES["cars"][1]
INFORMATIVE = f"cars, {TELLING.name}"
OTHERS = "other people's cars"
SCALES = {HMC.name: 0.0, HMC_DELTA.name: DELTA_SCALE, **{m.name: m.delta_scale for m in SWEEP}}
ON_OTHERS = (HMC, HMC_DELTA, OWN)


def measure_sweep(run: Run) -> None:
    """HMC with other scales of delta on informative views; two of them are in the posterior inference already."""
    rate = Rated(run)
    for seed in run.seeds:
        view = Conditioned(run.family, seed, TELLING, run.prior.model.preset.image_size)
        for method in (HMC, HMC_DELTA, *SWEEP):
            keep_answer(run, method, view, INFORMATIVE, seed, rate)


def check_others(folder: Path) -> None:
    """Raises FileNotFoundError if the folder lacks one of the others' cars."""
    for name in MODELS:
        road_mesh_file(folder, name)


def measure_others(run: Run, folder: Path, rivals: Sequence[TrainedRival]) -> None:
    """Others' cars (`scenes.road_meshes`), seen as the family's are, by HMC with delta and without, and by rivals."""
    rate = Rated(run)
    for index, name in enumerate(MODELS[: run.count]):
        subject = read_road_mesh(folder, name)
        family = replace(run.family, draw=partial(_always, subject))
        for place in PLACES[run.family.name]:
            view = Conditioned(family, index, place, run.prior.model.preset.image_size)
            for method in ON_OTHERS:
                keep_answer(run, method, view, f"{OTHERS}, {place.name}", name, rate)
            for rival in (r for r in rivals if r.answers):
                keep_rival(run, rival, view, f"{OTHERS}, {place.name}", name)


def _always(subject: Subject, seed: int) -> Subject:
    return subject


def tables(lines: Sequence[Line], rows: list[Row], seeds: range) -> list[Table]:
    """The sweep, by scale, each paired with delta 0; and the answers to others' cars."""
    found = []
    own = [x for x in lines if x["condition"] == INFORMATIVE and x["object"] in seeds and x["method"] in SCALES]
    if any(x["method"] in [m.name for m in SWEEP] for x in own):
        cells = []
        for method, scale in sorted(SCALES.items(), key=lambda item: item[1]):
            values = {x["object"]: x for x in own if x["method"] == method}
            base = {x["object"]: x for x in own if x["method"] == HMC.name}
            swept = {x["object"] for x in own if x["method"] in [m.name for m in SWEEP]}
            both = [seed for seed in values if seed in base and seed in swept]
            if not both:
                continue
            shown = []
            for metric in ("psnr_given", "psnr_heldout"):
                mean = float(np.mean([values[seed][metric] for seed in both]))
                pair = ([x[seed][metric] for seed in both] for x in (values, base))
                rows += gap_rows("paper", method, "sweep of delta", f"{metric}_above_0", *pair, unit="dB")
                gap = Figures(rows).interval("sweep of delta", method, f"{metric}_above_0")
                shown += [f"{mean:.1f}", "" if scale == 0 else ranged(gap, 1, "+")]
            cells.append([f"{scale:g}", str(len(both)), *shown])
        header = ("sqrt(alpha)", "n", "psnr_given", "above 0's", "psnr_heldout", "above 0's")
        found.append(Table(f"{INFORMATIVE}: HMC with delta of scale sqrt(alpha), dB", header, cells))
    for condition in (f"{OTHERS}, {place.name}" for place in PLACES["cars"]):
        if others := [x for x in lines if x["condition"] == condition]:
            found.append(answer_table(condition, others, rows, [m.name for m in ON_OTHERS]))
    return found
