"""A density mixed with the prior, as the reference of tempering or of importance sampling (Hesterberg, 1995)."""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.sampling.populations import log_prior


class Density(Protocol):
    """A density over positions. It is a PyTree."""

    def log_density(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log-density, nats; differentiable."""
        ...

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        ...


class DefensiveMixture(eqx.Module):
    """(1 - prior_share) q + prior_share N(0, I): a `hmc.Reference`.

    The prior is at most 1 / prior_share times this density. So an importance weight, prior x likelihood / density, is
    at most the likelihood over prior_share, however wrong q is.
    """

    density: Density
    prior_share: Float[Array, ""]  # in (0, 1)

    def over_prior(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log of the ratio of this density to that of N(0, I), nats; at least log prior_share."""
        apart = self.density.log_density(position) - log_prior(position)
        return jnp.logaddexp(jnp.log1p(-self.prior_share) + apart, jnp.log(self.prior_share))

    def log_density(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log-density, nats."""
        return self.over_prior(position) + log_prior(position)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        which, first, second = jax.random.split(key, 3)
        drawn = self.density.draw(first, count)
        prior = jax.random.normal(second, drawn.shape)
        return jnp.where(jax.random.uniform(which, (count, 1)) < self.prior_share, prior, drawn)
