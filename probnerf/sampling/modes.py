"""Where a posterior's modes are, and a density about them for the sampler to begin at.

A mode that is narrow holds next to nothing of the prior, and of any flattened posterior: on the way from the prior
(beta = 0) it is lost to wider and poorer ones, and no population finds it again. Climbing finds it in a second. So many
starts climb, a Gaussian is laid about the top of each (Laplace's approximation, widened), and tempering leads from
their mixture to the posterior: q(x)^(1 - beta) posterior(x)^beta. A share of it is the prior, so that in the
limit of many particles the answer does not depend on the mixture; what a finite number finds does.
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

# what `model.log_likelihood` takes
Args = tuple[Model, Likelihood, Observation, Float[Array, "n m"]]

# The yaw's latents (a, b) = r (cos, sin) with any r: r^2 / 2 is exponential, so that r has mean 1.25, deviation 0.66.
_RADIUS, _RADIUS_SIGMA = 1.25, 0.66


def log_posterior(args: tuple, _: None, positions: Float[Array, "p d"]) -> Float[Array, "p"]:
    """Log-likelihood plus log prior, up to a constant, in which the yaw is uniform.

    `args` are those of `model.log_likelihood`. The yaw's latents (a, b) are left out of the prior: only their angle
    means anything, and the density of N(0, I) over them would pull the best yaw into the origin, where it has none.
    """
    model, likelihood = args[:2]
    weigh = jnp.ones(positions.shape[-1])
    if likelihood.sample_pose:
        weigh = weigh.at[model.latent : model.latent + 2].set(0.0)
    return log_likelihood(args, positions) - 0.5 * jnp.sum(weigh * positions**2, axis=-1)


@program("config")
def mixture_of_modes(args: Args, starts: Float[Array, "k d"], config: ModesConfig) -> GaussianMixture:
    """Gaussians about the modes that the starts climb to, and the prior.

    Of each two neighbouring starts only the better one climbs all the way. About a mode the precision is that of the
    prior plus the likelihood's (its Hessian by differences of the gradient, rising directions left out) over `widen`.
    Climbs that end in one mode are as many Gaussians there.
    """
    model, likelihood = args[:2]
    top, _ = ascend(log_posterior, args, starts, config.screen)
    # neighbours in yaw, not the best of all: modes that are far apart must not compete before they are climbed
    value = log_posterior(args, None, top).reshape(-1, 2)
    top = top.reshape(len(value), 2, -1)[jnp.arange(len(value)), jnp.argmax(value, axis=1)]
    top, _ = ascend(log_posterior, args, top, config.climb)
    dim = top.shape[1]
    toward = jnp.zeros_like(top)
    if likelihood.sample_pose:  # only the angle of (a, b) climbs: put their length where the posterior has it
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
    # an offset at a time, so that it takes no more memory than the climb
    here, there = slope(q), jax.lax.map(lambda offset: slope(q + offset), step * jnp.eye(q.shape[1]))  # [d, k, d]
    hessian = jnp.nan_to_num(here - there, posinf=0.0, neginf=0.0).swapaxes(0, 1) / step
    along, axes = jnp.linalg.eigh(0.5 * (hessian + hessian.swapaxes(1, 2)))
    return jnp.clip(along, 0.0, 1e6), axes
