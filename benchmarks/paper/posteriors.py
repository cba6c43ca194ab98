"""Posterior inference: an object seen from one place, answered by ProbNeRF's samplers and by the rivals."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from benchmarks.harness.intervals import Figures
from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table
from benchmarks.paper.conditioned import PLACES, Conditioned, base_rate
from benchmarks.paper.experiment import Run, answer_table
from benchmarks.paper.judged import judge, picture_values
from benchmarks.paper.methods import METHODS, SWEEP, Method, Question
from benchmarks.paper.rival_answers import TrainedRival, answered
from foundation.whole_file import whole_file

RATED = range(200)  # training seeds that the base rate is of


class Rated:
    """The base rate of a family's voxels: found when it is first asked for, some minutes, and kept in the run's folder.

    Its file is named by the number of objects and the revision of the code that draws them.
    """

    def __init__(self, run: Run) -> None:
        self._family, self._seeds = run.family, RATED[:20] if run.quick else RATED
        self._file = (
            None
            if run.folder is None
            else run.folder / f"base-rate-{run.family.name}-{len(self._seeds)}-{revision()}.npy"
        )

    def __call__(self) -> Float[np.ndarray, "g g g"]:
        """Share of the training objects that occupy each voxel."""
        if self._file is not None and self._file.is_file():
            return np.load(self._file)
        rate = base_rate(self._family, self._seeds)
        if self._file is not None:
            with whole_file(self._file) as part, part.open("wb") as file:
                np.save(file, rate)
        return rate


def measure(run: Run, methods: Sequence[Method], rivals: Sequence[TrainedRival]) -> None:
    """Answers of all methods and rivals to each object from each place. Rivals answer to whole pictures only."""
    rate = Rated(run)
    for seed in run.seeds:
        for place in PLACES[run.family.name]:
            view = Conditioned(run.family, seed, place, run.prior.model.preset.image_size)
            condition = f"{run.family.name}, {place.name}"
            for method in methods:
                keep_answer(run, method, view, condition, seed, rate)
            for rival in [] if place.left_half else [r for r in rivals if r.answers]:
                keep_rival(run, rival, view, condition, seed)


def keep_answer(run: Run, method: Method, view: Conditioned, condition: str, thing: int | str, rate: Rated) -> None:
    """Add the row of one method's answer, if the file lacks it."""
    if (line := run.missing(method.name, method.settings(run.effort), condition, thing)) is None:
        return
    found = method.answer(Question(view, run.prior.model, run.effort, run.seed))
    kept = _rounded(judge(view, run.prior.model, found, rate()).values)
    run.results.add({**line, **kept, "gradients": found.gradients, "result": found.posterior.result})
    say(f"{condition}, {thing}, {method.name}: {_said(kept)}, hidden {kept['hidden_nll']:.3f} nats")


def keep_rival(run: Run, rival: TrainedRival, view: Conditioned, condition: str, thing: int | str) -> None:
    """Add the row of one rival's answer, if the file lacks it."""
    if (line := run.missing(rival.label, rival.settings, condition, thing)) is None:
        return
    values = picture_values(view, *answered(rival, view, run.seed))
    if not rival.draws:
        del values["pixel_sd"]  # a point estimate
    kept = _rounded(values)
    run.results.add({**line, **kept})
    say(f"{condition}, {thing}, {rival.label}: {_said(kept)}")


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 5) for name, value in values.items()}


def _said(kept: dict[str, float]) -> str:
    sd = f", sd {kept['pixel_sd']:.3f}" if "pixel_sd" in kept else ""
    return f"given {kept['psnr_given']:.1f} dB, held out {kept['psnr_heldout']:.1f} dB{sd}"


def tables(lines: Sequence[Line], rows: list[Row], families: Sequence[str], seeds: range) -> list[Table]:
    """One of each place."""
    found = []
    for name in families:
        for place in PLACES[name]:
            condition = f"{name}, {place.name}"
            swept = [m.name for m in SWEEP]  # in a table of their own
            own = [x for x in lines if x["condition"] == condition and x["object"] in seeds]
            if own := [x for x in own if x["method"] not in swept]:
                found.append(answer_table(condition, own, rows, [m.name for m in METHODS]))
    return found


def drawn(of: Figures, families: Sequence[str]) -> list[str]:
    """Conditions with figures."""
    every = [f"{name}, {place.name}" for name in families for place in PLACES[name]]
    return [condition for condition in every if condition in of.conditions()]
