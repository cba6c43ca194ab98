"""The prior's gate: 100 held-out objects of known pose, rebuilt from four views by 300 Adam steps.

Each object of the first test seeds is seen without occlusion from four sides, evenly spread in azimuth, 15 to 60
degrees above the table (64 x 64 pixels: colour, range, mask). z~ starts at the encoder's mean of the same views and
climbs the joint pixel likelihood plus log prior for 300 Adam steps. Every step draws `rays` fresh pixels (55% object,
25% near its outline, 20% elsewhere) and counts them as `counted` independent ones. Judged on four views from between:

- psnr: in the bounding rectangle of the true mask, on white, mean over the four views, rendered through faces twice as
  dense as the fit's; the gate is the mean over plain and banded objects. Labelled and printed ones are reported.
- iou: solid occupancy, truth and reconstruction through the same operator on 64^3 voxels; and of both at 32^3.
- handle_recalled: share of the objects with a handle in which at least half of the true handle's voxels (those that
  meet the handle outside the body, 64^3) are solid in the reconstruction.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.figure import Figure
from scipy import ndimage

from benchmarks.harness.intervals import interval, mean_rows
from benchmarks.harness.progress import say, table
from benchmarks.harness.rows import Row
from benchmarks.measures.metrics import iou, psnr, recall
from probnerf.geometry import look_at, pinhole_rays
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.ray_tracer import handle_occupancy, solid_occupancy, trace
from probnerf.objects.tabletop import TEST_SEEDS, TabletopObject, sample_object
from probnerf.objects.tabletop_sampler import KINDS, TEXTURES
from probnerf.prior.checkpoint import load_prior
from probnerf.prior.encoder_input import ENCODER_RADIUS, camera_features, encoder_image
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.rendering.occupancy import coarsen, solid
from probnerf.sampling.ascent import ascend
from probnerf.settings import AdamConfig
from probnerf.shapes import opacity_grids
from probnerf.types import FREE, OBJECT, Observation, Rays

VIEWS = 4  # given; as many held out
GRID = 64
PSNR_DB, IOU, RECALLED = 25.0, 0.8, 0.9  # the gate


@dataclass(frozen=True)
class GateConfig:
    """How the held-out objects are seen and rebuilt."""

    fit: AdamConfig = field(default_factory=AdamConfig)
    rays: int = 256  # pixels drawn afresh every step, from the four views
    counted: float = 1024.0  # independent residuals that they stand for
    size: int = 64  # pixels a side
    range_sigma: float = 0.005  # cube units; the views have no noise
    crossings: int = 80  # kept per ray: the few longer rays leave the cube's far corner out
    chunk: int = 2048  # rays rendered at a time

    @property
    def likelihood(self) -> Likelihood:
        """The pixel model of inference, its pose known."""
        return Likelihood(lattice=foam.Lattice(32, 1.1, self.crossings), sample_pose=False)

    @property
    def pictures(self) -> foam.Lattice:
        """Faces of the pictures that are judged, as fine as the voxels: a pixel is half a cube of inference's lattice,
        through which even the true solid has a ragged outline."""
        return foam.Lattice(GRID, 1.1, 2 * self.crossings)


@dataclass(frozen=True, eq=False)
class SeenObject:
    """An object and its pictures, the four given ones first; range 0 marks a miss."""

    seed: int
    truth: TabletopObject
    T_object_camera: Float[np.ndarray, "8 4 4"]
    tan_half_fov: Float[np.ndarray, "8"]
    origin: Float[np.ndarray, "n 3"]  # rays of all pixels of all views
    direction: Float[np.ndarray, "n 3"]
    rgb: Float[np.ndarray, "8 s s 3"]
    range: Float[np.ndarray, "8 s s"]
    encoder_rgb: Float[np.ndarray, "4 e e 3"]  # the given views at the encoder's size
    encoder_range: Float[np.ndarray, "4 e e"]


@dataclass(frozen=True, eq=False)
class Rebuilt:
    """One object's figures, and what its picture needs."""

    seen: SeenObject
    z_tilde: Float[np.ndarray, "k"]
    psnr: float  # dB, held-out views
    iou: float
    iou_32: float
    handle: float  # share of the handle's voxels recalled; NaN without a handle
    solid: Bool[np.ndarray, "G G G"]
    true_solid: Bool[np.ndarray, "G G G"]

    @property
    def texture(self) -> str:
        return TEXTURES[int(self.seen.truth.texture)]

    @property
    def kind(self) -> str:
        return KINDS[int(self.seen.truth.kind)]


def see(seed: int, size: int, encoder_size: int) -> SeenObject:
    """The eight pictures of a seed's object; azimuths 45 degrees apart, given and held out in turn."""
    obj = sample_object(seed)
    rng = np.random.default_rng([seed, 13])
    start = rng.uniform(0.0, 2.0 * np.pi)
    azimuth = start + np.deg2rad([0, 90, 180, 270, 45, 135, 225, 315])
    elevation = np.deg2rad(rng.uniform(15.0, 60.0, 2 * VIEWS))
    distance = rng.uniform(3.0, 10.0, 2 * VIEWS)
    towards = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    targets = rng.normal(0.0, 0.08, (2 * VIEWS, 3))
    T = np.stack([look_at(p, target) for p, target in zip(distance[:, None] * towards, targets, strict=True)])
    tangent = ENCODER_RADIUS / distance * np.exp(rng.normal(0.0, 0.1, 2 * VIEWS))

    def pictures(views: int, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        pixels = [pinhole_rays(T[v], 0.5 * side / tangent[v], side) for v in range(views)]
        origin, direction = (np.concatenate(a) for a in zip(*pixels, strict=True))
        _, length, rgb = trace(obj, origin, direction)
        length = np.where(np.isfinite(length), length, 0.0).reshape(views, side, side)
        return origin, direction, np.asarray(rgb).reshape(views, side, side, 3), length

    *_, encoder_rgb, encoder_range = pictures(VIEWS, encoder_size)
    return SeenObject(seed, obj, T, tangent, *pictures(2 * VIEWS, size), encoder_rgb, encoder_range)


@jax.jit
def encoder_mean(model: ProbNeRF, rgb: Array, distance: Array, T: Array, tangent: Array) -> Float[Array, "k"]:
    """z~ of the encoder's mean, given all four views."""
    images = jax.vmap(encoder_image)(rgb, distance, jnp.zeros_like(distance), T, tangent)
    mean, _ = model.encoder(images, jax.vmap(camera_features)(T, tangent), jnp.ones(len(T)))
    return model.flow.inverse(mean)[0]


def _batches(seen: SeenObject, config: GateConfig) -> Observation:
    """The pixels of every step, with a leading axis of steps: a function of the object's seed."""
    rng = np.random.default_rng([seen.seed, 17])
    mask = seen.range[:VIEWS] > 0
    near = ndimage.binary_dilation(mask, np.ones((1, 9, 9), bool)) & ~mask
    strata = [np.flatnonzero(m) for m in (mask, near, ~(mask | near))]
    counts = [round(0.55 * config.rays), round(0.25 * config.rays)]
    counts.append(config.rays - sum(counts))
    steps = config.fit.steps
    pick = np.concatenate(
        [rng.choice(s if len(s) else strata[2], (steps, n)) for s, n in zip(strata, counts, strict=True)], axis=1
    )
    shape = pick.shape
    hit = seen.range.ravel()[pick] > 0
    return Observation(
        rays=Rays(jnp.asarray(seen.origin[pick]), jnp.asarray(seen.direction[pick])),
        status=jnp.asarray(np.where(hit, OBJECT, FREE), jnp.int32),
        rgb=jnp.asarray(seen.rgb.reshape(-1, 3)[pick], jnp.float32),
        rgb_valid=jnp.asarray(hit),
        range=jnp.asarray(seen.range.ravel()[pick], jnp.float32),
        range_sigma=jnp.full(shape, config.range_sigma),
        range_valid=jnp.asarray(hit),
        limit=jnp.asarray(np.where(hit, 0.0, foam.FAR), jnp.float32),
        pose_sigma=jnp.zeros((steps, 5)),
        colour_count=counts[0],
    )


def _log_posterior(args: tuple, batch: Observation, z_tilde: Float[Array, "p k"]) -> Float[Array, "p"]:
    """counted times the mean pixel log-likelihood, plus the log prior."""
    model, likelihood, counted = args
    t = foam.crossings(batch.rays, likelihood.lattice)
    mean = log_likelihood((model, likelihood, batch, t), z_tilde) / len(batch.status)
    return counted * mean - 0.5 * jnp.sum(z_tilde**2, axis=-1)


@partial(jax.jit, static_argnames="lattice")
def _render(model: ProbNeRF, weights: Float[Array, "w"], rays: Rays, lattice: foam.Lattice) -> Float[Array, "n 3"]:
    """Colour on white."""
    picture = foam.render(model.field, weights, rays, lattice)
    return picture.colour + (1.0 - picture.opacity)[:, None]


def render_pixels(
    model: ProbNeRF, z_tilde: Float[Array, "k"], seen: SeenObject, pixels: np.ndarray, config: GateConfig
) -> Float[np.ndarray, "n 3"]:
    """The reconstruction at flat pixel indices (into all views), in chunks of one compiled size."""
    weights, parts = jax.jit(type(model).decode)(model, z_tilde), []
    for start in range(0, len(pixels), config.chunk):
        chosen = np.resize(pixels[start : start + config.chunk], config.chunk)
        rays = Rays(jnp.asarray(seen.origin[chosen]), jnp.asarray(seen.direction[chosen]))
        parts.append(np.asarray(_render(model, weights, rays, config.pictures)))
    return np.concatenate(parts)[: len(pixels)]


def _boxes(seen: SeenObject) -> list[np.ndarray]:
    """Flat pixel indices of the true mask's bounding rectangle in each held-out view that shows the object."""
    index = np.arange(seen.range.size).reshape(seen.range.shape)
    boxes = []
    for v in range(VIEWS, 2 * VIEWS):
        rows, columns = np.nonzero(seen.range[v] > 0)
        if len(rows):
            boxes.append(index[v, rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].ravel())
    return boxes


def rebuild(model: ProbNeRF, seed: int, config: GateConfig) -> Rebuilt:
    """See, fit and judge one object."""
    seen = see(seed, config.size, model.preset.image_size)
    start = encoder_mean(
        model, seen.encoder_rgb, seen.encoder_range, seen.T_object_camera[:VIEWS], seen.tan_half_fov[:VIEWS]
    )
    args = (model, config.likelihood, config.counted)
    z, _ = ascend(_log_posterior, args, start[None], config.fit, _batches(seen, config))
    boxes = _boxes(seen)
    rendered = render_pixels(model, z[0], seen, np.concatenate(boxes), config)
    parts = np.split(rendered, np.cumsum([len(b) for b in boxes])[:-1])
    truth = seen.rgb.reshape(-1, 3)
    occupied = solid(
        np.asarray(opacity_grids(model, config.likelihood, z, jnp.zeros(5), jnp.ones((GRID,) * 3, bool)))[0]
    )
    true_solid = solid(np.asarray(solid_occupancy(seen.truth, GRID), np.float32))
    return Rebuilt(
        seen=seen,
        z_tilde=np.asarray(z[0]),
        psnr=float(np.mean([psnr(p, truth[b]) for p, b in zip(parts, boxes, strict=True)])),
        iou=float(iou(occupied, true_solid)),
        iou_32=float(iou(coarsen(occupied, 32), coarsen(true_solid, 32))),
        handle=recall(occupied, np.asarray(handle_occupancy(seen.truth, GRID))),
        solid=occupied,
        true_solid=true_solid,
    )


def rebuild_all(model: ProbNeRF, seeds: Sequence[int], config: GateConfig) -> Iterator[Rebuilt]:
    """Every object in order, one per core at a time: a fit's small steps fill one core only."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        yield from pool.map(lambda seed: rebuild(model, seed, config), seeds)


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


def gate(model: ProbNeRF, seeds: Sequence[int], config: GateConfig | None = None) -> dict[str, float | bool]:
    """The gate's figures of a model on the objects of `seeds`: what training writes beside the weights."""
    return figures(list(rebuild_all(model, seeds, config or GateConfig())))


def main(
    out: Path, quick: bool = False, prior: Path | None = None, n: int = 100, steps: int = 300, rays: int = 256
) -> list[Row]:
    """The prior's gate on held-out objects.

    Args:
        prior: weights to judge; the shipped ones by default
        n: objects, the first test seeds
        steps: Adam steps per object
        rays: pixels drawn in each step
    """
    model = load_prior(prior).model
    config = GateConfig(fit=AdamConfig(steps=steps), rays=rays)
    rebuilt: list[Rebuilt] = []
    for r in rebuild_all(model, TEST_SEEDS[: min(n, 10) if quick else n], config):
        rebuilt.append(r)
        handle = "" if np.isnan(r.handle) else f", handle {r.handle:.2f}"
        say(f"{len(rebuilt):4d} {r.kind:8s} {r.texture:9s} psnr {r.psnr:5.2f} dB, iou {r.iou:.3f}{handle}")
    found = figures(rebuilt)
    rows = _rows(rebuilt)
    _print_gate(found, rows)
    rows.append(Row("prior", "map", f"{VIEWS} views", "passed", float(found["passed"]), "", len(rebuilt)))
    _draw(model, rebuilt, config, out / "prior.png")
    return rows


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


def _print_gate(found: dict[str, float | bool], rows: Sequence[Row]) -> None:
    limits = (("psnr", PSNR_DB, "plain and banded, dB"), ("iou", IOU, "64^3"), ("handle_recalled", RECALLED, ""))
    lines = []
    for metric, limit, note in limits:
        row = {r.metric: r for r in reversed(rows)}  # the first row of a metric
        ends = f"{row[f'{metric}_q025'].value:.3f} .. {row[f'{metric}_q975'].value:.3f}" if metric in row else ""
        verdict = "pass" if found[metric] >= limit else "FAIL"
        lines.append((metric, note, f"{found[metric]:.3f}", ends, f">= {limit:g}", verdict))
    say_title = f"The prior's gate on {found['objects']} held-out objects: {'passed' if found['passed'] else 'FAILED'}"
    table(say_title, ("figure", "", "mean", "95% interval", "gate", ""), lines)


def _draw(model: ProbNeRF, rebuilt: Sequence[Rebuilt], config: GateConfig, path: Path) -> None:
    """Twelve objects from the best psnr to the worst: a held-out view, its reconstruction, and the section y = 0."""
    order = np.argsort([-r.psnr for r in rebuilt])
    chosen = [rebuilt[i] for i in order[np.unique(np.linspace(0, len(order) - 1, 12).round().astype(int))]]
    pixels = config.size**2
    figure = Figure(figsize=(13, 2.5 * -(-len(chosen) // 2)), layout="constrained")
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
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
