"""The prior's gate: 100 held-out objects of known pose, rebuilt from four views by 300 Adam steps.

Each object of the first test seeds is seen without occlusion from four sides, evenly spread in azimuth, 15 to 60
degrees above the table (64 x 64 pixels: colour, range, mask). z~ starts at the encoder's mean of the same views and
climbs the joint pixel likelihood plus log prior for 300 Adam steps. Each step draws 256 new pixels (55% object, 25%
near its outline, 20% elsewhere) and counts them as 1024 independent ones. Four views from between are judged:

- psnr: in the bounding rectangle of the true mask, on white, mean over the four views, rendered through faces twice as
  dense as in the fit. The gate is the mean over plain and banded objects. Labelled and printed ones are reported.
- iou: solid occupancy on 64^3 voxels, truth and reconstruction by the same operator; iou_32: both on 32^3 voxels.
- handle_recalled: share of the objects with a handle of which at least half of the true handle's voxels (those that
  meet the handle outside the body, 64^3) are solid in the reconstruction.

With --household N, household things are judged, too: N of the generator's validation seeds, the held-out classes of the
training meshes, and scanned things that nothing is trained on. No camera sees them: z~ is fitted to the solid itself
(`measures.refitted`). thin_recalled is the share of objects with parts below 1 cm of which at least half is solid.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, interval, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table, between, verdict
from benchmarks.measures.rebuilt import GRID, VIEWS, GateConfig, Rebuilt, rebuild_all, render_pixels
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import SHIPPED, Prior, load_prior, load_recognition, recognition_path
from probnerf.prior.networks import ProbNeRF, Recognition
from probnerf.settings import AdamConfig

PSNR_DB, IOU, RECALLED = 25.0, 0.8, 0.9  # the gate
HOUSEHOLD_IOU, LEAST_IOU, LEAST_SHARE, THIN_RECALLED = 0.85, 0.7, 0.9, 0.8  # of household things


def figures(rebuilt: Sequence[Rebuilt]) -> dict[str, float | bool]:
    """The gate's figures; `passed` where all three hold."""
    shade = np.array([r.texture in ("plain", "banded") for r in rebuilt])
    decibels = np.array([r.psnr for r in rebuilt])
    handles = np.array([r.handle for r in rebuilt])
    recalled = handles[~np.isnan(handles)] >= 0.5
    result: dict[str, float | bool] = {
        "objects": len(rebuilt),
        "psnr": interval(decibels[shade]).mean,
        "psnr_labelled_printed": interval(decibels[~shade]).mean,
        "iou": interval([r.iou for r in rebuilt]).mean,
        "iou_32": interval([r.iou_32 for r in rebuilt]).mean,
        "handle_recalled": float(recalled.mean()) if len(recalled) else float("nan"),
    }
    passed = result["psnr"] >= PSNR_DB and result["iou"] >= IOU and result["handle_recalled"] >= RECALLED
    return {**result, "passed": bool(passed)}


@dataclass(frozen=True)
class Options(TableOptions):
    """The prior's gate on held-out objects."""

    prior: Path | None = None
    """Weights to judge; the shipped ones by default."""
    n: int = 100
    """Objects, the first test seeds."""
    steps: int = 300
    """Adam steps per object."""
    rays: int = 256
    """Pixels drawn in each step."""
    household: int = 0
    """Things of the household generator; with 1 or more, held-out meshes and scans, too. It needs `farside[meshes]`."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    prior = load_prior(options.prior)
    model = prior.model
    config = GateConfig(fit=AdamConfig(steps=options.steps), rays=options.rays)
    n = min(options.n, 10) if options.quick else options.n
    rebuilt: list[Rebuilt] = []
    for r in rebuild_all(model, TEST_SEEDS[:n], config):
        rebuilt.append(r)
        handle = "" if np.isnan(r.handle) else f", handle {r.handle:.2f}"
        say(f"{len(rebuilt):4d} {r.kind:8s} {r.texture:9s} psnr {r.psnr:5.2f} dB, iou {r.iou:.3f}{handle}")
    found = figures(rebuilt)
    rows = _rows(rebuilt)
    tables = [_gate_table(found, rows)] if rebuilt else []
    rows.append(Row("prior", "map", f"{VIEWS} views", "passed", float(found["passed"]), "", len(rebuilt)))
    if options.household:
        count = min(options.household, 5) if options.quick else options.household
        beside = recognition_path(options.prior or SHIPPED)
        recognition = load_recognition(beside, prior) if beside.is_file() else None
        more, table = _household(prior, recognition, count)
        rows += more
        tables.append(table)
    return Summary(rows, tables, lambda: _draw(model, rebuilt, config))


def _household(prior: Prior, recognition: Recognition | None, count: int) -> tuple[list[Row], Table]:
    """Figures of household things: of each source, and of all."""
    from benchmarks.measures.refitted import refit  # these need the extra `meshes`
    from benchmarks.scenes.held_out import held_out_things

    fitted = []
    for source, thing, seed in held_out_things(count):
        one = refit(prior.model, source, thing, seed, recognition)
        fitted.append(one)
        say(f"{len(fitted):4d} {source:16s} {one.name:28s} iou {one.iou:.3f}, thin parts {one.thin:.2f}")
    rows, lines = [], []
    for source in (*dict.fromkeys(r.source for r in fitted), "all"):
        chosen = [r for r in fitted if source in (r.source, "all")]
        ious, thin = np.array([r.iou for r in chosen]), np.array([r.thin for r in chosen])
        found = (thin[~np.isnan(thin)] >= 0.5).astype(float)
        for figure, values, least in (
            ("iou", ious, HOUSEHOLD_IOU),
            (f"iou >= {LEAST_IOU:g}", (ious >= LEAST_IOU).astype(float), LEAST_SHARE),
            ("thin_recalled", found, THIN_RECALLED),
        ):
            rows += mean_rows("prior", "fit", f"household, {source}", figure, values, "")
            mean = interval(values).mean
            lines.append([source, figure, f"{mean:.3f}", str(len(values)), f">= {least:g}", verdict(mean, least=least)])
    columns = ("source", "figure", "mean", "objects", "gate", "verdict")
    return rows, Table("household things, z~ fitted to the solid", columns, lines)


def _rows(rebuilt: Sequence[Rebuilt]) -> list[Row]:
    rows = []
    for textures in (("plain", "banded"), ("labelled",), ("printed",)):
        values = [r.psnr for r in rebuilt if r.texture in textures]
        if values:
            rows += mean_rows("prior", "map", f"{VIEWS} views, {' and '.join(textures)}", "psnr", values, "dB")
    handles = [r.handle for r in rebuilt if not np.isnan(r.handle)]
    rows += mean_rows("prior", "map", f"{VIEWS} views", "iou", [r.iou for r in rebuilt], "")
    rows += mean_rows("prior", "map", f"{VIEWS} views", "iou_32", [r.iou_32 for r in rebuilt], "")
    if handles:
        rows += mean_rows("prior", "map", f"{VIEWS} views", "handle_recalled", [float(h >= 0.5) for h in handles], "")
        rows += mean_rows("prior", "map", f"{VIEWS} views", "handle_voxels_recalled", handles, "")
    return rows


def _gate_table(found: dict[str, float | bool], rows: Sequence[Row]) -> Table:
    limits = (("psnr", PSNR_DB, "plain and banded, dB"), ("iou", IOU, "64^3"), ("handle_recalled", RECALLED, ""))
    of, lines = Figures(rows), []
    for metric, limit, note in limits:
        condition = next((row.condition for row in rows if row.metric == metric), "")
        ends = between(of.interval(condition, "map", metric)) if condition else ""
        lines.append([metric, note, f"{found[metric]:.3f}", ends, f">= {limit:g}", verdict(found[metric], least=limit)])
    title = f"{found['objects']} held-out objects: {'passed' if found['passed'] else 'FAILED'}"
    return Table(title, ("figure", "", "mean", "95% interval", "gate", "verdict"), lines)


def _draw(model: ProbNeRF, rebuilt: Sequence[Rebuilt], config: GateConfig) -> Figure:
    """Twelve objects from the best psnr to the worst: a held-out view, its reconstruction, and the section y = 0."""
    order = np.argsort([-r.psnr for r in rebuilt])
    chosen = [rebuilt[i] for i in order[np.unique(np.linspace(0, len(order) - 1, 12).round().astype(int))]]
    pixels = config.size**2
    figure = Figure(figsize=(13, 2.5 * -(-len(chosen) // 2)), layout="constrained", dpi=110)
    axes = np.atleast_2d(figure.subplots(-(-len(chosen) // 2), 6))
    for ax in axes.flat:
        ax.set_axis_off()
    for i, r in enumerate(chosen):
        truth, made, section = axes[i // 2, 3 * (i % 2) : 3 * (i % 2) + 3]
        picture = render_pixels(model, jnp.asarray(r.z_tilde), r.seen, np.arange(pixels) + VIEWS * pixels, config)
        truth.imshow(r.seen.rgb[VIEWS])
        made.imshow(np.clip(picture, 0, 1).reshape(config.size, config.size, 3))
        truth.set_title(f"{r.texture} {r.kind}", fontsize=9)
        made.set_title(f"rebuilt, {r.psnr:.1f} dB", fontsize=9)
        middle, extent = GRID // 2, (-1, 1, -1, 1)
        section.imshow(r.true_solid[:, middle].T, origin="lower", cmap="Greys", vmin=0, vmax=2.5, extent=extent)
        if r.solid[:, middle].any():
            section.contour(r.solid[:, middle].T, [0.5], colors="tab:red", linewidths=1.2, extent=extent)
        handle = "" if np.isnan(r.handle) else f", handle {100 * r.handle:.0f}%"
        section.set_title(f"iou {r.iou:.2f}{handle}", fontsize=9)
    figure.suptitle("Held-out view, its reconstruction, and the section through the handle: truth grey, rebuilt red")
    return figure
