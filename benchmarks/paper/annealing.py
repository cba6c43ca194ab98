"""Annealing: vehicles from behind, 8 chains of HMC as the paper anneals it and at one temperature.

At one temperature with the paper's step, and with a step that is tuned, over the same iterations and to the same
acceptance as the annealed chains', which the paper did not do. All begin at the same states and take as many gradients.
"""

from collections.abc import Sequence

import numpy as np

from benchmarks.harness.intervals import Figures, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, ranged
from benchmarks.measures.metrics import psnr
from benchmarks.paper.cars import Car
from benchmarks.paper.conditioned import PLACES, Conditioned
from benchmarks.paper.experiment import Run
from benchmarks.paper.families import FAMILIES, SPLITS
from benchmarks.paper.judged import pictures
from benchmarks.paper.methods import CHAINS, FIXED, FIXED_TUNED, HMC, Question

BACK = PLACES["cars"][0]
ANNEALING = "annealing, cars from behind"
COMPARED = (HMC, FIXED, FIXED_TUNED)
ORDER = ("best", "4th", "worst", "spread")


def rear_seeds(count: int) -> list[int]:
    """Vehicles of the annealing: the first ambulance of the test seeds, then the first others."""
    seeds, ambulance = SPLITS["test"], None
    for seed in seeds:
        car = FAMILIES["cars"].draw(seed)
        if isinstance(car, Car) and car.style == "ambulance":
            ambulance = seed
            break
    assert ambulance is not None
    return [ambulance, *(seed for seed in seeds[:count] if seed != ambulance)][:count]


def measure(run: Run) -> None:
    """The chains' last pictures of the given view."""
    for seed in rear_seeds(run.count):
        view = Conditioned(FAMILIES["cars"], seed, BACK, run.prior.model.preset.image_size)
        for method in COMPARED:
            if (line := run.missing(method.name, method.settings(run.effort), ANNEALING, seed)) is None:
                continue
            found = method.answer(Question(view, run.prior.model, run.effort, run.seed))
            last = found.posterior.positions[-CHAINS:]  # the chains' last states
            made = pictures(run.prior.model, found.likelihood, last, view.T_object_camera)[:, 0]
            each = [round(psnr(picture, view.given.rgb[0] / 255.0), 3) for picture in made]
            acceptance = round(float(found.posterior.diagnostics.acceptance), 3)
            run.results.add({**line, "chains": each, "acceptance": acceptance, "result": found.posterior.result})
            say(f"{ANNEALING}, {seed}, {method.name}: {min(each):.1f} to {max(each):.1f} dB, acceptance {acceptance}")


def by_chain(lines: Sequence[Line], method: str) -> dict[int, dict[str, float]]:
    """`ORDER`'s figures of each object, dB."""
    found = {}
    for line in lines:
        if line["condition"] == ANNEALING and line["method"] == method:
            each = np.sort(line["chains"])[::-1]
            values = (each[0], each[3], each[-1], each[0] - each[-1])
            found[line["object"]] = dict(zip(ORDER, map(float, values), strict=True))
    return found


def accepted(lines: Sequence[Line], method: str) -> float:
    """Mean acceptance of the last iterations; NaN where nothing was measured."""
    own = [x["acceptance"] for x in lines if x["condition"] == ANNEALING and x["method"] == method]
    return float(np.mean(own)) if own else float("nan")


def tables(lines: Sequence[Line], rows: list[Row]) -> list[Table]:
    """One."""
    cells = []
    for method in (m.name for m in COMPARED):
        values = by_chain(lines, method)
        if not values:
            continue
        for name in ORDER:
            each = [value[name] for value in values.values()]
            rows += mean_rows("paper", method, ANNEALING, f"psnr_given, {name}", each, "dB")
        of = Figures(rows)
        shown = [ranged(of.interval(ANNEALING, method, f"psnr_given, {name}"), 1) for name in ORDER]
        cells.append([method, str(len(values)), *shown, f"{accepted(lines, method):.2f}"])
    title = f"{ANNEALING}: psnr of the given view by chain, dB"
    return [Table(title, ("method", "n", *ORDER, "acceptance"), cells)] if cells else []
