"""What the paper's experiments have in common: with what they measure, and how answers are shown in a table."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.results import Line, Results
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, ranged
from benchmarks.paper.families import SPLITS, Family
from benchmarks.paper.methods import HMC, Effort
from probnerf.prior.checkpoint import Prior, load_prior

UNITS = {
    "psnr_given": "dB", "psnr_heldout": "dB", "psnr_heldout_of_mean": "dB", "pixel_sd": "", "hidden_nll": "nats",
    "hidden_ece": "",
}  # fmt: skip
COMPARED = ("psnr_given", "psnr_heldout", "pixel_sd", "hidden_nll")  # paired with HMC's


@dataclass(frozen=True, eq=False)
class Run:
    """A family, its prior, and the file that rows are added to."""

    family: Family
    prior: Prior
    results: Results
    count: int  # objects of an experiment
    effort: Effort
    seed: int = 0
    quick: bool = False
    folder: Path | None = None  # for what is found once and serves several runs

    @property
    def seeds(self) -> range:
        """The objects."""
        return SPLITS["test"][: self.count]

    def missing(self, method: str, settings: Line, condition: str, thing: int | str) -> Line | None:
        """A row's identity; None where the file has the row."""
        line: Line = {
            "prior": self.prior.identity, "method": method, "settings": settings, "condition": condition,
            "object": thing, "seed": self.seed,
        }  # fmt: skip
        return None if line in self.results else line


def prior_of(family: Family, path: Path) -> Prior:
    """The family's prior. Raises ValueError where it learnt another family, and as `load_prior` does."""
    prior = load_prior(path)
    if (learnt := prior.metadata.get("family", "another family")) != family.name:
        raise ValueError(
            f"{path} was trained on '{learnt}', not on '{family.name}'; train one with"
            f" `python -m benchmarks.paper.train --family {family.name}`"
        )
    return prior


def answer_table(condition: str, lines: Sequence[Line], rows: list[Row], order: Sequence[str]) -> Table:
    """Means of the answers' figures by method, beside HMC's on the same objects; adds them to `rows`."""
    methods = dict.fromkeys([name for name in order if any(x["method"] == name for x in lines)])
    methods |= dict.fromkeys(line["method"] for line in lines)
    reference = {line["object"]: line for line in lines if line["method"] == HMC.name}
    cells = []
    for method in methods:
        values = {line["object"]: line for line in lines if line["method"] == method}
        for metric, unit in UNITS.items():
            if own := [x[metric] for x in values.values() if metric in x]:
                rows += mean_rows("paper", method, condition, metric, own, unit)
        for metric in COMPARED:
            both = [seed for seed in values if seed in reference and metric in values[seed]]
            if both and method != HMC.name:
                pair = ([x[seed][metric] for seed in both] for x in (values, reference))
                rows += gap_rows("paper", method, condition, f"{metric}_above_hmc", *pair, unit=UNITS[metric])
        of = Figures(rows)

        def shown(metric: str, digits: int, sign: str = "", of: Figures = of, method: str = method) -> str:
            there = (condition, method, metric) in of
            return ranged(of.interval(condition, method, metric), digits, sign) if there else ""

        cells.append(
            [method, str(len(values))]
            + [shown(metric, 1 if unit == "dB" else 3) for metric, unit in UNITS.items()]
            + [shown("psnr_heldout_above_hmc", 1, "+"), shown("hidden_nll_above_hmc", 3, "+")]
        )
    header = ("method", "n", *UNITS, "psnr_heldout above hmc's", "hidden_nll above hmc's")
    return Table(condition, header, cells)
