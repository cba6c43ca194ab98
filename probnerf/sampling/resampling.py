"""Weights of particles: effective sample size, the next temperature, systematic resampling."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

# Fractions of the distance left to beta = 1, 40 per decade. A grid, because the ESS may not be monotonic in beta.
_FRACTIONS = np.geomspace(1e-9, 1.0, 361).astype(np.float32)


def ess(log_w: Float[Array, "n"]) -> Float[Array, ""]:
    """(sum w)^2 / sum w^2; 0 if all weights are 0. Clipped to n, so a variance computed from it is never negative."""
    top = jnp.max(log_w)
    w = jnp.exp(log_w - jnp.where(jnp.isfinite(top), top, 0.0))
    return jnp.minimum(jnp.sum(w) ** 2 / jnp.maximum(jnp.sum(w * w), 1e-30), float(log_w.size))


def next_beta(
    beta: Float[Array, ""], log_w: Float[Array, "n"], log_likelihood: Float[Array, "n"], enough: float
) -> tuple[Float[Array, ""], Float[Array, "n"], Float[Array, ""]]:
    """The largest beta at which the weights exp(log_w) L^step have ESS `enough`; their logarithms; their ESS.

    If no beta reaches `enough` (zero likelihoods, poor proposals), the beta with the largest ESS. If all likelihoods
    are zero, beta is 1.
    """

    def weights(step):
        return jnp.where(jnp.isfinite(log_likelihood), log_w + step * log_likelihood, -jnp.inf)

    steps = (1.0 - beta) * _FRACTIONS
    sizes = jax.vmap(lambda step: ess(weights(step)))(steps)
    last = sizes.size - 1
    index = jnp.where(jnp.any(sizes >= enough), last - jnp.argmax((sizes >= enough)[::-1]), jnp.argmax(sizes))
    index = jnp.where(jnp.any(jnp.isfinite(log_likelihood)), index, last)
    new = jnp.where(index == last, 1.0, beta + steps[index])  # in float32, beta + (1 - beta) can differ from 1
    return new, weights(new - beta), sizes[index]


def resample(key: PRNGKeyArray, log_w: Float[Array, "n"], count: int) -> Int[Array, "c"]:
    """Systematic resampling: indices of `count` particles, each drawn count * w_i times, rounded up or down."""
    top = jnp.max(log_w)
    total = jnp.cumsum(jnp.where(jnp.isfinite(top), jnp.exp(log_w - top), 1.0))
    u = (jnp.arange(count) + jax.random.uniform(key)) / count
    u = jnp.minimum(u, 1.0 - 2.0**-24)  # u = 1 would index past the last particle with positive weight
    return jnp.searchsorted(total / total[-1], u, side="right")


def choose(key: PRNGKeyArray, log_w: Float[Array, "m n"], pool: PyTree, count: int) -> PyTree:
    """`count` particles of each population's weighted pool, resampled."""
    keys = jax.random.split(key, log_w.shape[0])
    index = jax.vmap(lambda k, w: resample(k, w, count))(keys, log_w)
    return jax.vmap(lambda tree, i: jax.tree.map(lambda a: a[i], tree))(pool, index)
