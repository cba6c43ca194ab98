"""Find a posterior's modes, and build a density around them from which the sampler starts.

A narrow mode has almost no mass under the prior or under a tempered posterior. On the path from the prior (beta = 0)
the particles move to wider, poorer modes, and no population finds the narrow one again. Gradient ascent finds it in
a second. So many starts ascend, and each mode found gets a Gaussian (a widened Laplace approximation). Tempering then
goes from their mixture to the posterior: q(x)^(1 - beta) posterior(x)^beta. The mixture includes the prior, so in the
limit of many particles the result does not depend on the other components. With few particles, it does.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.compile_cache import program
from probnerf.fields.base import Model
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.settings import Likelihood
from probnerf.sampling.ascent import ascend
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.settings import ModesConfig
from probnerf.types import Observation

# arguments of `likelihood.dispatch.log_likelihood`
Args = tuple[Model, Likelihood, Observation, Float[Array, "n m"]]

# The yaw's latents are (a, b) = r (cos, sin) with any r. r^2 / 2 is exponential: r has mean 1.25, std 0.66.
_RADIUS, _RADIUS_SIGMA = 1.25, 0.66


def log_posterior(args: tuple, _: None, positions: Float[Array, "p d"]) -> Float[Array, "p"]:
    """Log-likelihood plus log prior, up to a constant, with a uniform prior on the yaw.

    `args` are those of `log_likelihood`. The prior leaves out the yaw's latents (a, b), because only their angle has a
    meaning. The density N(0, I) would pull them to the origin, where the yaw is undefined.
    """
    model, likelihood = args[:2]
    weigh = jnp.ones(positions.shape[-1])
    if likelihood.sample_pose:
        weigh = weigh.at[model.latent : model.latent + 2].set(0.0)
    return log_likelihood(args, positions) - 0.5 * jnp.sum(weigh * positions**2, axis=-1)


@program("config")
def mixture_of_modes(args: Args, starts: Float[Array, "k d"], config: ModesConfig) -> GaussianMixture:
    """A mixture of the prior and one Gaussian for each mode that an ascent reaches.

    Of each pair of neighbouring starts, only the better one completes the ascent. A Gaussian's precision is that of the
    prior plus the likelihood's over `widen`. The likelihood's precision is its negative Hessian, by differences of the
    gradient, without directions of positive curvature. If several ascents reach one mode, each adds its own Gaussian.
    """
    model, likelihood = args[:2]
    top, _ = ascend(log_posterior, args, starts, config.screen)
    # compare only neighbours in yaw: distant modes must not compete before their ascents are complete
    value = log_posterior(args, None, top).reshape(-1, 2)
    top = top.reshape(len(value), 2, -1)[jnp.arange(len(value)), jnp.argmax(value, axis=1)]
    top, _ = ascend(log_posterior, args, top, config.climb)
    dim = top.shape[1]
    toward = jnp.zeros_like(top)
    if likelihood.sample_pose:  # only the angle of (a, b) was optimised: set the length to its prior mean
        at = slice(model.latent, model.latent + 2)
        toward = toward.at[:, at].set(
            top[:, at] / jnp.maximum(jnp.linalg.norm(top[:, at], axis=1, keepdims=True), 1e-6)
        )
        top = top.at[:, at].set(_RADIUS * toward[:, at])
    stiffness = _stiffness(args, top, config.difference)
    value = log_posterior(args, None, top) - 0.5 * jnp.sum(jnp.log1p(stiffness[0]), axis=-1)
    share = jax.nn.log_softmax(jnp.where(jnp.isfinite(value), config.power * value, -1e30))
    along, axes = stiffness
    precision = jnp.einsum("kdi,ki,kei->kde", axes, along / config.widen, axes, precision="highest") + jnp.eye(dim)
    precision += (_RADIUS_SIGMA**-2 - 1.0) * toward[:, :, None] * toward[:, None, :]
    root = jnp.linalg.cholesky(precision)
    return GaussianMixture(
        jnp.append(share + jnp.log1p(-config.prior_share), jnp.log(config.prior_share)),
        jnp.concatenate([top, jnp.zeros((1, dim))]),
        jnp.concatenate([root, jnp.eye(dim)[None]]),
    )


def _stiffness(args: Args, q: Float[Array, "k d"], step: float) -> tuple[Float[Array, "k d"], Float[Array, "k d d"]]:
    """Eigenvalues (0 or more) and eigenvectors (columns) of the log-likelihood's negative Hessian at each position."""
    slope = jax.grad(lambda x: jnp.sum(log_likelihood(args, x)))
    # one offset at a time, to need no more memory than the ascent
    here, there = slope(q), jax.lax.map(lambda offset: slope(q + offset), step * jnp.eye(q.shape[1]))  # [d, k, d]
    hessian = jnp.nan_to_num(here - there, posinf=0.0, neginf=0.0).swapaxes(0, 1) / step
    along, axes = jnp.linalg.eigh(0.5 * (hessian + hessian.swapaxes(1, 2)))
    return jnp.clip(along, 0.0, 1e6), axes
