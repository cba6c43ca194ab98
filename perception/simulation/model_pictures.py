"""Plain pictures of a prior's own shapes, to train its posterior network on: every one of another shape, known exactly.

Objects of the world are costly to make, and a network soon knows those of its training set by heart. A draw of the
model costs one picture. The ray's end is drawn from the foam's distribution of ends, as the likelihood has it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from perception.simulation.plain_pictures import PlainDraws, TrainingPicture, draw_plain
from perception.simulation.ray_caster import Hits
from probnerf.fields.base import Field
from probnerf.fields.mlp import MLPField
from probnerf.likelihood.dispatch import density_at
from probnerf.rendering import foam
from probnerf.types import Rays

HALF_EXTENT_M = (0.03, 0.2)  # log-uniform
LEAST_PIXELS = 12  # of the shape, without which a picture says nothing
_LATTICE = foam.Lattice(32, 1.1)


@dataclass(frozen=True, eq=False)
class ModelShape:
    """A shape that a field's weights tell, as something to take pictures of (`plain_pictures.Pictured`)."""

    field: MLPField
    weights: Float[Array, "w"]
    half_extent: float  # m per cube unit
    rng: np.random.Generator  # of the rays' ends

    def cast(self, origins: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Draws of where these rays end. As a normal each has its direction, which colours are asked with."""
        start = np.broadcast_to(origins, directions.shape)
        rays = Rays(jnp.asarray(start, jnp.float32), jnp.asarray(directions, jnp.float32))
        t, opacity, gap = (np.asarray(a) for a in _ends(self.field, self.weights, rays))
        before = opacity > self.rng.random((len(directions), 1))
        first, each = before.argmax(axis=1), np.arange(len(directions))
        place = t[each, first] - self.rng.random(len(each)) * gap[each, first]
        hit = before[:, -1]
        return Hits(
            distance=np.where(hit, place, np.inf),
            mesh=np.where(hit, 0, -1),
            face=np.where(hit, first, -1),
            normal=np.asarray(directions),
        )

    def colours(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """The field's colours there."""
        count = 1 << max(len(points) - 1, 1).bit_length()  # few compiled sizes
        rows = np.resize(np.arange(len(points)), count)
        seen = (jnp.asarray(a[rows], jnp.float32) for a in (points, directions))
        return np.asarray(_colours(self.field, self.weights, *seen))[: len(points)]


def draw_shape(
    rng: np.random.Generator, field: MLPField, weights: Float[Array, "w"], views: int, size: int, draws: PlainDraws
) -> list[TrainingPicture]:
    """So many plain pictures of the shape with these weights, less those that hardly show it."""
    low, high = np.log(HALF_EXTENT_M)
    shape = ModelShape(field, weights, float(np.exp(rng.uniform(low, high))), rng)
    pictures = draw_plain(rng, shape, views, size, draws, shape)
    return [picture for picture in pictures if (picture.distance > 0).sum() >= LEAST_PIXELS]


@jax.jit
def _ends(field: Field, weights: Array, rays: Rays) -> tuple[Array, Array, Array]:
    """Per face: distance, opacity up to it, gap before it."""
    t = foam.crossings(rays, _LATTICE)
    sigma = density_at(field, weights, None, foam.points_on_rays(rays, t))
    faces = foam.composite(sigma, t, jnp.asarray(1.0 / _LATTICE.cubes))
    return t, -jnp.expm1(faces.log_transmittance), foam.gap_before(t)


@jax.jit
def _colours(field: Field, weights: Array, points: Array, directions: Array) -> Array:
    return field.colour(weights, points, directions, field.density(weights, points))
