"""The scores of one answer to one view: unseen voxels, boxes in them, and pictures from places without a camera."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from benchmarks.measures.metrics import (
    hidden_brier,
    hidden_ece,
    hidden_nll,
    psnr,
    randomised_rank,
    scored_voxels,
    smooth_probability,
)
from benchmarks.scenes.vessels import GRID, VesselView
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import CAUTION
from probnerf.fields.base import Model
from probnerf.geometry import look_at, pinhole_rays
from probnerf.inference import without_sizes
from probnerf.likelihood.position import split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.ray_tracer import trace
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.rendering.occupancy import coarsen, solid
from probnerf.shapes import opacity_grids, poses
from probnerf.types import BASE_Z, Rays

BOXES = 16  # random unseen boxes per view


@dataclass(frozen=True, eq=False)
class Answer:
    """Weighted solid shapes of one method, and what they cost."""

    shapes: Bool[np.ndarray, "S 32 32 32"]
    weights: Float[np.ndarray, "S"]
    seconds: float
    result: str = ""  # why the sampler stopped

    @property
    def p_occupied(self) -> Float[np.ndarray, "32 32 32"]:
        return np.tensordot(self.weights, self.shapes, 1)


def shapes_at(
    model: Model,
    likelihood: Likelihood,
    positions: Float[Array, "S d"],
    pose_sigma: Float[Array, "5"],
    region: Bool[Array, "g g g"],
) -> Bool[np.ndarray, "S 32 32 32"]:
    """The solid shape of each position, as `Hypotheses.solid` would have it."""
    sizeless = without_sizes(likelihood)
    opacity = opacity_grids(model, sizeless, positions, pose_sigma, region)
    z = poses(model, sizeless, positions, pose_sigma).z
    return coarsen(solid(np.asarray(opacity), BASE_Z + np.asarray(z)), GRID)


def as_queried(h: Hypotheses, seconds: float) -> Answer:
    """What a query answers of the hypotheses: out of the model, half the weight on "all that is unseen is occupied"."""
    shapes, weights = coarsen(h.solid, GRID), h.weights
    if h.out_of_model:
        fine = h.grid // GRID
        seen = np.asarray(h.seen.reshape(GRID, fine, GRID, fine, GRID, fine).all(axis=(1, 3, 5)))
        shapes, weights = np.concatenate([shapes, ~seen[np.newaxis]]), np.append((1 - CAUTION) * weights, CAUTION)
    return Answer(shapes, weights, seconds, h.result)


def random_boxes(
    scored: Bool[np.ndarray, "G G G"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, "count 2 3"]:
    """Boxes [low, high) in voxels: a random scored voxel in the middle, sides of 2 to 10 voxels."""
    middles = rng.choice(np.argwhere(scored), count)
    sides = rng.integers(2, 11, (count, 3))
    low = np.maximum(middles - sides // 2, 0)
    return np.stack([low, np.minimum(low + sides, len(scored))], axis=1)


@dataclass(frozen=True, eq=False)
class Score:
    """What one answer is worth on one view."""

    probability: Float[np.ndarray, "32 32 32"]  # smoothed
    values: dict[str, float]  # by metric
    ranks: Float[np.ndarray, "boxes"]  # of the true occupied volume in each box
    p_free: Float[np.ndarray, "boxes"]
    occupied: Bool[np.ndarray, "boxes"]  # truly


def score(
    view: VesselView,
    answer: Answer,
    rate: Float[np.ndarray, "32 32 32"],
    boxes: Int[np.ndarray, "boxes 2 3"],
    rng: np.random.Generator,
) -> Score:
    """Unseen voxels whose base rate lies in (0.02, 0.98), and volumes in boxes, of which what was seen does not count;
    `rng` draws the ranks' random part.
    """
    scored = scored_voxels(view.seen, rate)
    hidden = [~view.seen[x:a, y:b, z:c] for (x, y, z), (a, b, c) in boxes]

    def volumes(shape: Bool[np.ndarray, "... 32 32 32"]) -> Int[np.ndarray, "boxes ..."]:
        regions = [shape[..., x:a, y:b, z:c] for (x, y, z), (a, b, c) in boxes]
        return np.stack([(r & h).sum(axis=(-3, -2, -1)) for r, h in zip(regions, hidden, strict=True)])

    p, truth, guessed = answer.p_occupied, volumes(view.solid), volumes(answer.shapes)
    q = smooth_probability(p, rate)
    return Score(
        probability=q,
        values={
            "hidden_nll": hidden_nll(p, rate, view.solid, scored),
            "hidden_nll_handle": hidden_nll(p, rate, view.solid, scored & view.near_handle),
            "hidden_brier": hidden_brier(q, view.solid, scored),
            "hidden_ece": hidden_ece(q, view.solid, scored),
        },
        ranks=np.array(
            [randomised_rank(v, answer.weights, float(y), rng) for v, y in zip(guessed, truth, strict=True)]
        ),
        p_free=(guessed == 0) @ answer.weights,
        occupied=truth > 0,
    )


@dataclass(frozen=True)
class PictureConfig:
    """Pictures of the object alone on white, from the view's own place and two others."""

    size: int = 48  # px a side; the cube fills it
    azimuths: tuple[float, ...] = (180.0, 90.0)  # degrees from the camera: from behind and from one side
    elevation: float = 30.0  # degrees
    distance: float = 5.0  # cube units
    hypotheses: int = 8  # drawn systematically by weight

    @property
    def lattice(self) -> foam.Lattice:
        """Inference's."""
        return foam.Lattice(32, 1.1, 80, 0.15)


@partial(jax.jit, static_argnames="lattice")
def _rendered(
    model: ProbNeRF, likelihood: Likelihood, positions: Array, pose_sigma: Array, rays: Rays, lattice: foam.Lattice
) -> Float[Array, "s n 3"]:
    def one(position: Array) -> Array:
        weights, pose = split_position(model, likelihood, position, pose_sigma)
        picture = foam.render_picture(model.field, weights, rays, lattice, pose)
        return picture.colour + (1.0 - picture.opacity)[:, None]

    return jax.lax.map(one, positions)


def picture_psnr(
    view: VesselView,
    model: ProbNeRF,
    likelihood: Likelihood,
    positions: Float[Array, "s d"],
    weights: Float[np.ndarray, "s"],
    pose_sigma: Float[Array, "5"],
    config: PictureConfig | None = None,
) -> dict[str, float]:
    """dB over whole pictures: psnr of held-out and of given views, each a mean over hypotheses and of their mean image.

    `likelihood` without one view's sizes.
    """
    config = config or PictureConfig()
    e = np.deg2rad(config.elevation)
    places = [view.cube.to_cube(np.zeros(3))]
    for a in np.deg2rad(config.azimuths):
        places.append(config.distance * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]))
    seen = [
        pinhole_rays(
            look_at(at, np.zeros(3)), 0.5 * config.size * float(np.linalg.norm(at)) / ENCODER_RADIUS, config.size
        )
        for at in places
    ]
    origin, direction = (np.concatenate(a) for a in zip(*seen, strict=True))
    A = view.T_canonical_view
    assert view.shape is not None  # pictures are of the family's objects
    turned = direction @ A[:3, :3].T
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    truth = np.asarray(trace(view.shape, (origin @ A[:3, :3].T + A[:3, 3]).astype(np.float32), turned)[2])
    levels = (np.arange(config.hypotheses) + 0.5) / config.hypotheses
    at = np.quantile(np.arange(len(weights)), levels, weights=weights, method="inverted_cdf")
    chosen = positions[jnp.asarray(at)]
    rays = Rays(jnp.asarray(origin), jnp.asarray(direction))
    made = np.asarray(_rendered(model, likelihood, chosen, pose_sigma, rays, config.lattice), np.float64)
    each = config.size**2
    parts = {"given": slice(0, each), "heldout": slice(each, None)}
    values = {}
    for name, part in parts.items():
        values[f"psnr_{name}"] = float(np.mean([psnr(m[part], truth[part]) for m in made]))
        values[f"psnr_{name}_of_mean"] = psnr(made.mean(axis=0)[part], truth[part])
    return values
