"""Scenes of the analytic field, and their posterior on a grid: a reference without training or sampling.

Pixels are drawn from the density that `pixel_terms` evaluates, so the model is correct. x, y and log-scale are known
and ranges are unbiased (pose_sigma = 0). The grid covers the unknowns: yaw, handle length and radius.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from probnerf.fields.base import Model
from probnerf.fields.cylinder import CylinderModel
from probnerf.likelihood.pixel_terms import faces_of_view, mean_colour
from probnerf.likelihood.position import range_offset_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.rendering import foam
from probnerf.types import Observation, Rays

Args = tuple[CylinderModel, Likelihood, Observation, Float[Array, "n m"]]  # arguments of `dispatch.log_likelihood`


def grid_of_rays(columns: int, rows: int, elevation: float = 20.0, distance: float = 4.0, azimuth: float = 0.0) -> Rays:
    """Pixels of a camera `azimuth` degrees from +x and `elevation` above the table that looks at the cylinder.

    The left column comes first. They cover 2.3 by 1.7 cube units around the object. At azimuth 0, image left is -y.
    """
    e, a = np.deg2rad(elevation), np.deg2rad(azimuth)
    target = np.array([0.0, 0.0, -0.2])
    forward, right, up = (
        np.array([-np.cos(e) * np.cos(a), -np.cos(e) * np.sin(a), -np.sin(e)]),
        np.array([-np.sin(a), np.cos(a), 0.0]),
        np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]),
    )
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) / columns * 2 - 1, (np.arange(rows) + 0.5) / rows * 2 - 1, indexing="ij"
    )
    ends = target + 1.15 * u.reshape(-1, 1) * right - 0.85 * v.reshape(-1, 1) * up
    origin = np.broadcast_to(target - distance * forward, ends.shape)
    direction = ends - origin
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return Rays(jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32))


@eqx.filter_jit
def draw_pixels(
    key: PRNGKeyArray,
    model: Model,
    likelihood: Likelihood,
    position: Float[Array, "d"],
    rays: Rays,
    known: Bool[Array, "n"],
    depth: Bool[Array, ""],
    range_sigma: float = 0.02,
    pose_sigma: Float[Array, "5"] | None = None,
) -> Observation:
    """Simulate an observation of the object at `position`: the end of each ray, mask, depth and colour.

    Pixels that are not `known` are UNKNOWN and carry no information. Without `depth`, OBJECT pixels have only colour.
    Pixels are drawn from the density of `pixel_terms` with infinite `reach` and a power of 1. Without `pose_sigma`,
    only the yaw of the pose is unknown.
    """
    n = rays.origin.shape[0]
    keys = jax.random.split(key, 6)
    pose_sigma = jnp.zeros(5) if pose_sigma is None else pose_sigma
    weights, pose = split_position(model, likelihood, position, pose_sigma)
    picture = foam.render(model.field, weights, rays, likelihood.lattice, pose)
    end = jax.random.categorical(
        keys[0], jnp.log(jnp.concatenate([picture.weights, 1.0 - picture.opacity[:, None]], axis=1) + 1e-30)
    )
    hit = end < picture.t.shape[1]
    face = jnp.minimum(end, picture.t.shape[1] - 1)[:, None]
    is_object = known & (hit ^ jax.random.bernoulli(keys[1], likelihood.mask_error, (n,)))

    gap = foam.gap_before(picture.t)
    deviation = jnp.sqrt(range_sigma**2 + likelihood.wall_sigma**2 + gap**2 / 12.0)
    surface = picture.t - 0.5 * gap + range_offset_of(model, likelihood, position, pose_sigma)
    wall = jnp.take_along_axis(surface + deviation * jax.random.normal(keys[2], surface.shape), face, axis=1)[:, 0]
    middle = jnp.linalg.norm(rays.origin, axis=1)
    nowhere = middle + likelihood.outlier_span * jax.random.uniform(keys[3], (n,), minval=-0.5, maxval=0.5)
    astray = ~hit | jax.random.bernoulli(keys[4], likelihood.outlier, (n,))
    colour = mean_colour(picture.colour, picture.opacity[:, None])
    return Observation(
        rays=rays,
        status=jnp.where(is_object, OBJECT, jnp.where(known, FREE, UNKNOWN)),
        rgb=colour + likelihood.colour_sigma * jax.random.normal(keys[5], (n, 3)),
        rgb_valid=is_object,
        range=jnp.where(astray, nowhere, wall),
        range_sigma=jnp.full((n,), range_sigma),
        range_valid=is_object & depth,
        limit=jnp.where(known & ~is_object, 0.5 * foam.FAR, 0.0),
        pose_sigma=pose_sigma,
        colour_count=n,
    )


def object_first(observation: Observation, colour_count: int) -> Observation:
    """The same pixels, OBJECT ones first, so that colour is computed only for `colour_count` rays."""
    order = jnp.argsort(observation.status != OBJECT, stable=True)
    found = int(jnp.sum(observation.status == OBJECT))
    if found > colour_count:
        raise ValueError(f"{found} object pixels exceed colour_count {colour_count}: give a larger one")
    sorted_rays = jax.tree.map(lambda a: a[order], replace(observation, pose_sigma=observation.status))
    return replace(sorted_rays, pose_sigma=observation.pose_sigma, colour_count=colour_count)


CHUNK = 512  # positions per likelihood evaluation
YAW_OF = {"seen": 60.0, "hidden": 180.0, "half": -70.0}  # degrees; "half": the left half, with the handle, is unknown


def scene(
    condition: str,
    depth: bool,
    seed: int = 0,
    columns: int = 12,
    rows: int = 8,
    cubes: int = 16,
    azimuth: float = 0.0,
) -> Args:
    """One view of a cylinder whose handle is "seen", "hidden" behind it, or in the picture's unknown half ("half").

    This holds for a camera at azimuth 0 (degrees). Returns the arguments of `log_likelihood`. All scenes of one size
    have the same array shapes.
    """
    rays = grid_of_rays(columns, rows, azimuth=azimuth)
    bare = foam.Lattice(cubes)
    likelihood = Likelihood(foam.Lattice(cubes, max_crossings=foam.count_crossings(rays, bare)))
    yaw = np.deg2rad(YAW_OF[condition])
    position = jnp.array([0.3, 0.1, np.cos(yaw), np.sin(yaw), 0.0, 0.0, 0.0, 0.0, 0.0], jnp.float32)
    known = jnp.arange(columns * rows) >= (columns // 2 * rows if condition == "half" else 0)
    model = CylinderModel()
    key = jax.random.key(seed)
    observation = draw_pixels(key, model, likelihood, position, rays, known, jnp.asarray(depth))
    observation = object_first(observation, 2 * columns * rows // 3)
    return model, likelihood, observation, faces_of_view(observation, likelihood)


@dataclass(frozen=True)
class GridPosterior:
    """The posterior over yaw, z_0 (handle length) and z_1 (radius) on a grid that is refined where the mass is."""

    cells: np.ndarray  # f64[c, 3] (yaw in [0, 2 pi), z_0, z_1) of the centres
    widths: np.ndarray  # f64[3] of every cell
    probability: np.ndarray  # f64[c], sums to 1
    log_likelihood: np.ndarray  # f64[c] of the pixels
    log_evidence: float
    evaluations: int

    def histogram(self, bins: int = 12) -> np.ndarray:
        """Probability of each of `bins` equal arcs of yaw, from 0."""
        return yaw_histogram(self.cells[:, 0], self.probability, bins)

    def draw(
        self,
        rng: np.random.Generator,
        count: int,
        log_likelihood: Callable[[Any, Float[Array, "p d"]], Float[Array, "p"]],
        args: Any,
    ) -> tuple[np.ndarray, np.ndarray]:
        """`count` points (yaw, z_0, z_1) and their weights. They represent the posterior, also within cells.

        Points are uniform within cells and weighted by the density. This is needed because `integrate` keeps cells wide
        along axes that affect neither yaw nor evidence, such as the length of a hidden handle.
        """
        chosen = rng.choice(len(self.cells), count, p=self.probability)
        points = self.cells[chosen] + (rng.random((count, 3)) - 0.5) * self.widths
        log_density = _evaluate(log_likelihood, args, CHUNK, points) - 0.5 * np.sum(points[:, 1:] ** 2, axis=1)
        weight = np.exp(log_density - log_density.max()) / self.probability[chosen]
        return points, weight / weight.sum()


def yaw_histogram(yaw: np.ndarray, probability: np.ndarray, bins: int = 12) -> np.ndarray:
    """Probability of each of `bins` equal arcs of yaw (radians), from 0."""
    arc = np.floor(np.mod(yaw, 2 * np.pi) / (2 * np.pi) * bins).astype(int) % bins
    return np.bincount(arc, np.asarray(probability, np.float64), bins)


def total_variation(p: np.ndarray, q: np.ndarray) -> float:
    """Total variation distance: half the sum of absolute differences."""
    return 0.5 * float(np.abs(p - q).sum())


def integrate(
    log_likelihood: Callable[[Any, Float[Array, "p d"]], Float[Array, "p"]],
    args: Any,
    tolerance: float = 0.01,
    bins: int = 12,
    reach: float = 4.0,
    chunk: int = CHUNK,
) -> GridPosterior:
    """Midpoint rule on cells. They are halved along one axis after another until the result stops changing.

    The result is the log-evidence (nats) and the yaw histogram. A change of at most `tolerance` does not count. The
    likelihood depends on (a, b) only through the yaw, so their radius integrates out. Cells with a density below e^-16
    of the best are dropped. At first the limit is e^-60, because a narrow peak can lie between centres.
    """

    def mass_of(cells: np.ndarray, widths: np.ndarray) -> GridPosterior:
        value = _evaluate(log_likelihood, args, chunk, cells)
        log_density = value - 0.5 * np.sum(cells[:, 1:] ** 2, axis=1)
        top = log_density.max()
        mass = np.exp(log_density - top)
        log_evidence = float(top + np.log(mass.sum() * widths.prod()) - 2 * np.log(2 * np.pi))
        return GridPosterior(cells, widths, mass / mass.sum(), value, log_evidence, len(cells))

    counts = np.array([36, 6, 24])
    widths = np.array([2 * np.pi, 2 * reach, 2 * reach]) / counts
    axes = [
        width * (np.arange(n) + 0.5) - start for width, n, start in zip(widths, counts, (0, reach, reach), strict=True)
    ]
    best = mass_of(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), widths)
    drop, unchanged, axis, evaluations = 60.0, 0, 2, best.evaluations
    while unchanged < 3:
        half = widths * np.where(np.arange(3) == axis, 0.5, 1.0)
        kept = best.cells[best.probability > best.probability.max() * np.exp(-drop)]
        step = 0.5 * half * (np.arange(3) == axis)
        finer = mass_of(np.concatenate([kept - step, kept + step]), half)
        evaluations += finer.evaluations
        moved = total_variation(finer.histogram(bins), best.histogram(bins))
        if max(moved, abs(finer.log_evidence - best.log_evidence)) > tolerance:
            widths, best, unchanged = half, finer, 0
        else:
            unchanged += 1
        drop, axis = max(16.0, drop - 10.0), (axis + 1) % 3
    return replace(best, evaluations=evaluations)


def _evaluate(log_likelihood: Callable, args: Any, chunk: int, cells: np.ndarray) -> np.ndarray:
    """Log-likelihood of each cell's centre, `chunk` at a time."""
    yaw, z = cells[:, :1], cells[:, 1:]
    positions = np.concatenate([z, np.cos(yaw), np.sin(yaw), np.zeros((len(cells), 5))], axis=1).astype(np.float32)
    padded = np.pad(positions, ((0, -len(cells) % chunk), (0, 0)), mode="edge").reshape(-1, chunk, positions.shape[1])
    parts = [np.asarray(_compiled(log_likelihood, args, part)) for part in padded]
    return np.concatenate(parts)[: len(cells)].astype(np.float64)


@partial(jax.jit, static_argnums=0)
def _compiled(log_likelihood: Callable, args: Any, positions: Float[Array, "p d"]) -> Float[Array, "p"]:
    return log_likelihood(args, positions)
