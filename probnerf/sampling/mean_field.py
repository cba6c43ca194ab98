"""Mean-field variational inference: an independent Gaussian for each latent, fitted by Adam on the ELBO.

Symbols: q(z) = N(z; mean, diag(std^2)), z = mean + std * eps; ELBO = E_q[log p(z) - log q(z)], where p is the prior
N(0, I) times the likelihood. The gradient is the path derivative only: the parameters inside log q are held fixed
("sticking the landing", Roeder, Wu and Duvenaud 2017). It is unbiased, and has zero variance if q is the posterior.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.sampling.hmc import LogLikelihood


@dataclass(frozen=True)
class VIConfig:
    """Adam with a cosine schedule; rates are in units of the latents' prior standard deviation."""

    steps: int = 1500
    draws: int = 4  # per step
    learning_rate: float = 0.02
    final_learning_rate: float = 0.0005
    start_std: float = 0.1


class Gaussian(eqx.Module):
    """The variational density q, independent in every latent."""

    mean: Float[Array, "d"]
    log_std: Float[Array, "d"]

    def draw(self, noise: Float[Array, "s d"]) -> Float[Array, "s d"]:
        """Positions for standard-normal noise."""
        return self.mean + jnp.exp(self.log_std) * noise


def elbo_terms(q: Gaussian, log_likelihood: LogLikelihood, args: Any, noise: Float[Array, "s d"]) -> Float[Array, "s"]:
    """log p(z) - log q(z) of each draw, nats. Its gradient in q is the path derivative (eq. 8 of the paper)."""
    z, fixed = q.draw(noise), jax.lax.stop_gradient(q)
    log_prior = -0.5 * jnp.sum(z**2, axis=-1)  # log(2 pi) cancels between the densities
    log_q = -jnp.sum(0.5 * ((z - fixed.mean) / jnp.exp(fixed.log_std)) ** 2 + fixed.log_std, axis=-1)
    return log_likelihood(args, z) + log_prior - log_q


@partial(jax.jit, static_argnames=("log_likelihood", "config"))
def mean_field(
    key: PRNGKeyArray, log_likelihood: LogLikelihood, args: Any, start: Float[Array, "d"], config: VIConfig
) -> tuple[Gaussian, Float[Array, "steps"]]:
    """q after all steps, and the ELBO estimate (nats) before each step. q starts as a narrow Gaussian at `start`.

    A gradient entry that is not finite counts as 0.
    """
    schedule = optax.cosine_decay_schedule(
        config.learning_rate, config.steps, config.final_learning_rate / config.learning_rate
    )
    adam = optax.adam(schedule)
    q = Gaussian(start, jnp.full_like(start, jnp.log(config.start_std)))

    def step(carry, key):
        q, moments = carry
        noise = jax.random.normal(key, (config.draws, start.shape[0]))

        def loss(q):
            return -jnp.mean(elbo_terms(q, log_likelihood, args, noise))

        value, gradient = jax.value_and_grad(loss)(q)
        gradient = jax.tree.map(lambda g: jnp.where(jnp.isfinite(g), g, 0.0), gradient)
        update, moments = adam.update(gradient, moments, q)
        return (optax.apply_updates(q, update), moments), -value

    (q, _), elbo = jax.lax.scan(step, (q, adam.init(q)), jax.random.split(key, config.steps))
    return q, elbo
