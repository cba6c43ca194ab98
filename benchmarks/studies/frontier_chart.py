"""The picture of `farside bench frontier`: measures against cost, one row a condition and one colour a family."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, StrMethodFormatter

from benchmarks.harness.rows import Row
from benchmarks.rivals.methods import CONDITIONS, METHODS

# (measure, cost): title
PANELS = {
    ("hidden_nll", "seconds"): "hidden_nll, nats (lower is better)",
    ("psnr_heldout", "seconds"): "held-out PSNR, dB (higher is better)",
    ("coverage90", "seconds"): "share in the 90% interval (right: 0.9)",
    ("hidden_nll", "point_gradients"): "hidden_nll, nats (lower is better)",
}
COSTS = {"seconds": "seconds an object", "point_gradients": "field evaluations with gradient"}
LEVERS = "lever off"  # methods marked one by one, by a letter
STYLE = {  # colour and marker of each group
    "encoder": ("tab:orange", "^"),
    "map": ("tab:red", "v"),
    "vi": ("tab:brown", "P"),
    "paper": ("k", "o"),
    "fixed temperature": ("tab:gray", "X"),
    "smc": ("tab:blue", "*"),
    LEVERS: ("tab:purple", ""),
    "controller": ("tab:green", "D"),
}
LEGEND = {
    "encoder": "encoder alone",
    "map": "MAP",
    "vi": "mean-field VI",
    "paper": "the paper's annealed HMC",
    "fixed temperature": "HMC at one temperature",
    "smc": "tempered SMC, by runs",
    "controller": "controller, by budget",
}
JOINED = ("paper", "smc", "controller")


def draw_frontier(rows: Sequence[Row]) -> Figure:
    """Every condition that has rows; error bars are 95% intervals over objects."""
    value = {(row.condition, row.method, row.metric): row.value for row in rows}
    counts = [(row.condition, row.n) for row in rows if row.metric == "hidden_nll"]
    conditions = [c for c in CONDITIONS if c in dict(counts)]
    there = {method for _, method, _ in value}
    figure = Figure(figsize=(17, 3.9 * len(conditions) + 1.0), layout="constrained", dpi=80)
    axes = figure.subplots(len(conditions), len(PANELS), squeeze=False, sharex="col")
    for row, condition in zip(axes, conditions, strict=True):
        for ax, ((metric, cost), title) in zip(row, PANELS.items(), strict=True):
            if metric == "coverage90":
                ax.axhline(0.9, color="k", linestyle="--", linewidth=1)
            for group in STYLE:
                _draw_group(ax, value, condition, group, metric, cost)
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))  # also where an axis spans less than a decade
            ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}") if cost == "seconds" else EngFormatter(sep=""))
            ax.xaxis.set_minor_formatter(NullFormatter())
            ax.margins(x=0.18, y=0.08)
            ax.grid(alpha=0.25)
            ax.set_title(title, fontsize=11)
            ax.set_xlabel(COSTS[cost], fontsize=10)
        row[0].set_ylabel(f"{condition}\n({max(n for c, n in counts if c == condition)} vessels)", fontsize=12)
    handles = []
    for group, (colour, marker) in STYLE.items():
        for i, method in enumerate(m for m in METHODS if m.group == group and m.name in there):
            if i and group != LEVERS:
                break
            mark = marker or _letter(method.label)
            label = f"... {method.label[2:]}" if group == LEVERS else LEGEND[group]
            handles.append(Line2D([], [], color=colour, marker=mark, linestyle="", markersize=9, label=label))
            if group in JOINED:
                handles[-1].set_linestyle("-")
    figure.legend(handles=handles, loc="outside lower center", ncols=7, fontsize=11)
    return figure


def _draw_group(
    ax: Axes, value: dict[tuple[str, str, str], float], condition: str, group: str, metric: str, cost: str
) -> None:
    """One family's points, with what tells them apart written beside them."""
    colour, marker = STYLE[group]
    points = []
    for method in (m for m in METHODS if m.group == group):
        x, y = (value.get((condition, method.name, name), np.nan) for name in (cost, metric))
        if not (np.isfinite(y) and x > 0):  # the encoder alone takes no gradients
            continue
        points.append((x, y))
        ends = [value[condition, method.name, f"{metric}_{end}"] for end in ("q025", "q975")]
        if np.isfinite(ends).all():
            ax.errorbar(x, y, [[y - ends[0]], [ends[1] - y]], color=colour, capsize=2, linewidth=1, alpha=0.5)
        if group in JOINED:
            ax.annotate(method.label, (x, y), (5, 5), textcoords="offset points", fontsize=9, color=colour)
        ax.plot(x, y, color=colour, marker=marker or _letter(method.label), markersize=8)
    if group in JOINED and points:
        ax.plot(*np.array(points).T, color=colour, linewidth=1.2)


def _letter(label: str) -> str:
    """A lever's marker: the letter that its label begins with."""
    return f"${label[0]}$"
