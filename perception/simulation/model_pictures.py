"""Plain pictures of a prior's own shapes, to train its posterior network on: every one of another shape, known exactly.

Objects of the world are costly to make, and a network soon knows those of its training set by heart. A draw of the
model costs one picture. The ray's end is drawn from the foam's distribution of ends, as the likelihood has it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Array, Float

from perception.simulation.plain_pictures import PlainDraws, TrainingPicture, draw_plain
from perception.simulation.ray_caster import Hits
from probnerf.fields.mlp import MLPField
from probnerf.ray_ends import colours_at, draw_ends

HALF_EXTENT_M = (0.03, 0.2)  # log-uniform
LEAST_PIXELS = 12  # of the shape, without which a picture says nothing


@dataclass(frozen=True, eq=False)
class ModelShape:
    """A shape that a field's weights tell, as something to take pictures of (`plain_pictures.Pictured`)."""

    field: MLPField
    weights: Float[Array, "w"]
    half_extent: float  # m per cube unit
    rng: np.random.Generator  # of the rays' ends

    def cast(self, origins: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Draws of where these rays end. As a normal each has its direction, which colours are asked with."""
        distance, face = draw_ends(self.rng, self.field, self.weights, origins, directions)
        mesh = np.where(face >= 0, 0, -1)
        return Hits(distance=distance, mesh=mesh, face=face, normal=np.asarray(directions))

    def colours(
        self, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """The field's colours there."""
        return colours_at(self.field, self.weights, points, directions)


def draw_shape(
    rng: np.random.Generator, field: MLPField, weights: Float[Array, "w"], views: int, size: int, draws: PlainDraws
) -> list[TrainingPicture]:
    """So many plain pictures of the shape with these weights, less those that hardly show it."""
    low, high = np.log(HALF_EXTENT_M)
    shape = ModelShape(field, weights, float(np.exp(rng.uniform(low, high))), rng)
    pictures = draw_plain(rng, shape, views, size, draws, shape)
    return [picture for picture in pictures if (picture.distance > 0).sum() >= LEAST_PIXELS]
