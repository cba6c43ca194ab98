"""The analytic field and its prior: a cylinder with a handle, for tests with known answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.types import BASE_Z


class CylinderField(eqx.Module):
    """The analytic field: a closed cylinder with a box-shaped handle at +x. Parameters: (handle length, radius).

    Its posterior over yaw, handle length and size is integrated by brute force in the tests: no training stands between
    the samplers and a right answer.
    """

    height: float = eqx.field(static=True, default=1.1)
    handle_half_height: float = eqx.field(static=True, default=0.3)
    handle_half_width: float = eqx.field(static=True, default=0.12)
    softness: float = eqx.field(static=True, default=0.03)  # cube units over which the wall fades
    density_scale: float = eqx.field(static=True, default=150.0)

    def density(self, weights: Float[Array, "2"], points: Float[Array, "... 3"]) -> Float[Array, "..."]:
        """A smooth wall: density_scale * sigmoid(-signed distance bound / softness)."""
        length, radius = weights[0], weights[1]
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        mid = BASE_Z + 0.5 * self.height
        radial = jnp.sqrt(x * x + y * y + 1e-12)
        body = jnp.maximum(radial - radius, jnp.abs(z - mid) - 0.5 * self.height)
        half = 0.5 * length
        handle = jnp.maximum(
            jnp.maximum(jnp.abs(x - radius - half) - half, jnp.abs(y) - self.handle_half_width),
            jnp.abs(z - mid) - self.handle_half_height,
        )
        return self.density_scale * jax.nn.sigmoid(-jnp.minimum(body, handle) / self.softness)

    def colour(
        self,
        weights: Float[Array, "2"],
        points: Float[Array, "... 3"],
        directions: Float[Array, "... 3"],
        sigma: Float[Array, "..."],
    ) -> Float[Array, "... 3"]:
        """A blue body with a red handle: hue tells which is which, not where on the body one looks."""
        radial = jnp.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2 + 1e-12)
        handle = jax.nn.sigmoid((radial - weights[1]) / self.softness)[..., None]
        return handle * jnp.array([0.8, 0.25, 0.2]) + (1.0 - handle) * jnp.array([0.2, 0.35, 0.7])


class CylinderModel(eqx.Module):
    """The analytic prior: handle length = 0.2 + 0.4 Phi(z_0), radius = 0.45 exp(0.15 z_1)."""

    field: CylinderField = eqx.field(static=True, default=CylinderField())

    @property
    def latent(self) -> int:
        """Two: handle length and radius."""
        return 2

    def decode(self, z_tilde: Float[Array, "2"]) -> Float[Array, "2"]:
        """(handle length, radius) in cube units."""
        return jnp.stack([0.2 + 0.4 * jax.scipy.stats.norm.cdf(z_tilde[0]), 0.45 * jnp.exp(0.15 * z_tilde[1])])
