"""The pixel likelihood's settings."""

import math

import equinox as eqx

from probnerf.fields.base import Model
from probnerf.rendering import foam
from probnerf.types import POSE_SIZE


class Likelihood(eqx.Module):
    """The pixel model's settings. They are stored with every posterior."""

    lattice: foam.Lattice
    colour_sigma: float = eqx.field(static=True, default=0.1)  # s
    mask_error: float = eqx.field(static=True, default=0.01)  # epsilon, in each direction
    outlier: float = eqx.field(static=True, default=0.05)  # pi: rate of depth outliers, uniform over `outlier_span`
    outlier_span: float = eqx.field(static=True, default=2.5)  # cube units
    wall_sigma: float = eqx.field(static=True, default=0.02)  # floor of the model's own wall error, cube units
    reach: float = eqx.field(static=True, default=math.inf)  # OBJECT: surfaces farther behind the range are ignored
    packed: tuple[int, int] = eqx.field(static=True, default=(0, 0))  # most crossings: colour rays, all; 0: no packing
    power: float = eqx.field(static=True, default=1.0)  # kappa; any other value makes a power likelihood
    sample_pose: bool = eqx.field(static=True, default=True)
    sample_delta: bool = eqx.field(static=True, default=False)
    delta_scale: float = eqx.field(static=True, default=0.025)  # sqrt(alpha)

    def dim(self, model: Model) -> int:
        """Length of a position vector."""
        weights = model.field.size if self.sample_delta else 0  # type: ignore[attr-defined]
        return model.latent + POSE_SIZE * self.sample_pose + weights
