"""A held-out object of known pose, seen from eight sides and rebuilt from four by Adam, and how well it was rebuilt.

The prior's gate (`farside bench prior`) and nothing else uses it.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from benchmarks.measures.metrics import iou, psnr, recall
from probnerf.geometry import look_at, pinhole_rays
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.ray_tracer import handle_occupancy, solid_occupancy, trace
from probnerf.objects.tabletop import TabletopObject, sample_object
from probnerf.objects.tabletop_sampler import KINDS, TEXTURES
from probnerf.pixel_status import FREE, OBJECT
from probnerf.prior.encoder_input import ENCODER_RADIUS, camera_features, encoder_image
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.rendering.occupancy import coarsen, solid
from probnerf.sampling.ascent import ascend
from probnerf.settings import AdamConfig
from probnerf.shapes import opacity_grids
from probnerf.types import Observation, Rays

VIEWS = 4  # given; as many held out
GRID = 64


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
        through which even the true solid has a ragged outline.
        """
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
