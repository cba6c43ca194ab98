"""The prior's gate: z~ is fitted to the solid of held-out objects."""

from collections.abc import Sequence

from benchmarks.harness.intervals import Figures, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.refitted import refit
from benchmarks.paper.experiment import Run

FIT, GATE, LEAST_IOU = "fit to the solid", "the prior's gate", 0.85


def measure(run: Run) -> None:
    """Fit each object."""
    for seed in run.seeds:
        if (line := run.missing(FIT, {}, f"{run.family.name}, {GATE}", seed)) is not None:
            iou = round(refit(run.prior.model, run.family.name, run.family.draw(seed).mesh, seed).iou, 4)
            run.results.add({**line, "iou": iou})
            say(f"{line['condition']}, {seed}: iou {iou:.3f}")


def tables(lines: Sequence[Line], rows: list[Row], seeds: range) -> list[Table]:
    """One, of all families."""
    lines = [line for line in lines if line["method"] == FIT and line["object"] in seeds]
    cells = []
    for condition in dict.fromkeys(line["condition"] for line in lines):
        values = [line["iou"] for line in lines if line["condition"] == condition]
        rows += mean_rows("paper", FIT, condition, "iou", values, "")
        mean = Figures(rows).interval(condition, FIT, "iou")
        cells.append(
            [condition, str(len(values)), gated(ranged(mean), mean.mean, least=LEAST_IOU), f"{min(values):.3f}"]
        )
    return [Table("z~ fitted to the solid", ("", "n", f"iou, gate >= {LEAST_IOU:g}", "lowest"), cells)] if cells else []
