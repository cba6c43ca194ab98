"""Where rays end in a field of given weights, drawn from the foam's law, and the field's colours there."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from probnerf.fields.base import Field
from probnerf.fields.mlp import MLPField
from probnerf.likelihood.dispatch import density_at
from probnerf.rendering import foam
from probnerf.types import Rays

_LATTICE = foam.Lattice(32, 1.1)


def draw_ends(
    rng: np.random.Generator,
    field: MLPField,
    weights: Float[Array, "w"],
    origin: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Distance (cube units, inf: the ray passes) and face of a draw of each ray's end.

    A ray that ends on a face ends anywhere in the gap before it (`foam.gap_before`).
    """
    start = np.broadcast_to(origin, directions.shape)
    rays = Rays(jnp.asarray(start, jnp.float32), jnp.asarray(directions, jnp.float32))
    t, opacity, gap = (np.asarray(a) for a in _faces(field, weights, rays))
    passed = opacity > rng.random((len(directions), 1))
    first, each = passed.argmax(axis=1), np.arange(len(directions))
    place = t[each, first] - rng.random(len(each)) * gap[each, first]
    return np.where(passed[:, -1], place, np.inf), np.where(passed[:, -1], first, -1)


def colours_at(
    field: MLPField, weights: Float[Array, "w"], points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """The field's colours of points (cube units) seen along these directions."""
    count = 1 << max(len(points) - 1, 1).bit_length()  # few compiled sizes
    rows = np.resize(np.arange(len(points)), count)
    seen = (jnp.asarray(a[rows], jnp.float32) for a in (points, directions))
    return np.asarray(_colours(field, weights, *seen))[: len(points)]


@jax.jit
def _faces(field: Field, weights: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Per face: distance, opacity up to it, gap before it."""
    t = foam.crossings(rays, _LATTICE)
    sigma = density_at(field, weights, None, foam.points_on_rays(rays, t))
    faces = foam.composite(sigma, t, jnp.asarray(1.0 / _LATTICE.cubes))
    return t, -jnp.expm1(faces.log_transmittance), foam.gap_before(t)


@jax.jit
def _colours(field: Field, weights: Array, points: Array, directions: Array) -> Array:
    return field.colour(weights, points, directions, field.density(weights, points))
