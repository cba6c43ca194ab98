"""A region's answer in words and as JSON."""

import json
from collections.abc import Sequence
from math import isnan

from rich.console import Console
from rich.table import Table

from perception.answers.hypotheses import FrameName, Hypotheses
from perception.answers.query import QueryResult, query
from perception.answers.regions import Region

CM3 = 1e6  # per cubic metre
SHOWN = 100  # points, each on a line


def answer(
    scene: Sequence[Hypotheses], region: Region, frame: FrameName, risk: float, as_json: bool, out: Console
) -> None:
    """Query the objects of a scene about a region and print the answer, with a verdict at `risk`.

    Raises ValueError in one line.
    """
    result = query(scene, region, frame)
    verdict = result.verdict(risk)
    if as_json:
        content = {"verdict": verdict, "risk": risk, **result.as_dict()}
        out.print(json.dumps(content, indent=1), highlight=False, soft_wrap=True, markup=False)
        return
    table = Table.grid(padding=(0, 2))
    for name, value in ((f"verdict at a risk of {risk:g}", verdict), *rows(result)):
        table.add_row(name, value)
    for object_id, blocking in result.blocked_by.items():
        table.add_row(f"not free in, object {object_id}", _numbers(blocking))
    out.print(table, highlight=False)
    points = result.p_occupied or []
    for i, p in enumerate(points[:SHOWN], start=1):
        out.print(f"  point {i}: occupied with probability {p:.3f}", highlight=False)
    if len(points) > SHOWN:
        out.print(f"  and {len(points) - SHOWN} more points, which --json lists", highlight=False)


def rows(r: QueryResult) -> list[tuple[str, str]]:
    """The answer's names and values with units, in the order of reading."""
    v = {name: CM3 * value for name, value in r.volume_m3.items()}
    return [
        ("all of it is free", "not known" if isnan(r.p_free) else f"{r.p_free:.3f} ± {r.p_free_se:.3f}"),
        ("occupied volume", f"{v['q50']:.1f} cm³ (5 to 95%: {v['q05']:.1f} to {v['q95']:.1f})"),
        ("unseen", f"{100 * r.unseen_fraction:.0f}%"),
        (
            "outside every object's cube",
            f"{100 * r.outside_fraction:.0f}% (or in the table: nobody looked)",
        ),
        ("mean entropy", f"{r.entropy_nats:.3f} nats per voxel"),
        ("effective hypotheses", f"{r.effective_hypotheses:.1f}"),
    ]


def _numbers(rows: list[int], shown: int = 8) -> str:
    """How many hypotheses, and the first few of them."""
    more = " ..." if len(rows) > shown else ""
    return f"{len(rows)} hypotheses: " + " ".join(str(row) for row in rows[:shown]) + more
