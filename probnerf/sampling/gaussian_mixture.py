"""A mixture of Gaussians over positions, with draws and a differentiable density."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.sampling.populations import log_prior


class GaussianMixture(eqx.Module):
    """sum_k exp(log_weight_k) N(mean_k, (root_k root_k^T)^-1), with lower triangular roots. Weights sum to 1."""

    log_weight: Float[Array, "k"]
    mean: Float[Array, "k d"]
    root: Float[Array, "k d d"]  # Cholesky factor of the precision

    def log_density(self, q: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log-density, nats."""
        # Full precision, because a stiff direction multiplies a difference by several hundred.
        white = jnp.einsum("pkd,kde->pke", q[:, None] - self.mean, self.root, precision="highest")
        log_det = jnp.sum(jnp.log(jnp.diagonal(self.root, axis1=1, axis2=2)), axis=-1)
        each = -0.5 * jnp.sum(white * white + jnp.log(2.0 * jnp.pi), axis=-1)
        return logsumexp(self.log_weight + log_det + each, axis=-1)

    def over_prior(self, position: Float[Array, "p d"]) -> Float[Array, "p"]:
        """Log of the ratio of this density to that of N(0, I), nats."""
        return self.log_density(position) - log_prior(position)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        which, noise = jax.random.split(key)
        k = jax.random.categorical(which, self.log_weight, shape=(count,))
        white = jax.random.normal(noise, (count, self.mean.shape[1], 1))
        # x = mean + root^-T white has the covariance (root root^T)^-1
        return self.mean[k] + jax.lax.linalg.triangular_solve(
            self.root[k], white, left_side=True, lower=True, transpose_a=True
        ).squeeze(-1)
