"""What a field is told of a solid: samples of its inside and of its surface's colours."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.rendering import foam
from probnerf.training.shape_set import ShapeBatch

BEHIND = 0.04  # cube units; a lattice of 32 can have a face this far behind a surface, so it needs colours there


def colour_samples(solids: ShapeBatch, key: PRNGKeyArray) -> tuple[Float[Array, "b m 3"], Float[Array, "b m 3"]]:
    """Points slightly behind the surface, and directions from which a camera may see them."""
    k0, k1 = jax.random.split(key)
    normal = jnp.asarray(solids.normal)
    points = jnp.asarray(solids.surface) - BEHIND * jax.random.uniform(k0, (*normal.shape[:2], 1)) * normal
    view = jax.random.normal(k1, normal.shape)
    view /= jnp.maximum(jnp.linalg.norm(view, axis=-1, keepdims=True), 1e-6)
    return points, jnp.where(jnp.sum(view * normal, axis=-1, keepdims=True) > 0.0, -view, view)


def solid_terms(shared: tuple, item: tuple, weights: Array) -> Float[Array, ""]:
    """Mean log-likelihoods of solid samples and of surface colours, each times its effective count.

    Points of others count, all together, as much as the object's own.
    """
    field, likelihood, config = shared
    points, inside, place, view, rgb, valid, others = item
    tau = field.density(weights, points) * foam.window(points) / likelihood.lattice.cubes
    # a grazing ray crosses more faces outside, a finer lattice has thinner ones inside: both make walls sharper
    probability = jnp.where(inside, -jnp.expm1(-tau / config.finer), jnp.exp(-config.grazing * tau))
    eps = likelihood.mask_error
    solid = jnp.mean(jnp.log(eps + (1.0 - 2.0 * eps) * probability))
    if others is not None:
        solid = solid + at_points_of_others(shared, others, weights)
    sigma = jax.lax.stop_gradient(field.density(weights, place))
    squared = jnp.sum((field.colour(weights, place, view, sigma) - rgb) ** 2, axis=-1)
    counted = jnp.sum(jnp.where(valid, squared, 0.0)) / jnp.maximum(jnp.sum(valid), 1)
    colour = -0.5 * counted / likelihood.colour_sigma**2
    return config.effective_points * solid + config.effective_colours * colour


def at_points_of_others(shared: tuple, item: tuple, weights: Array) -> Float[Array, ""]:
    """Mean log-likelihood where it is sure whether the object is there (`points_of_others`).

    No sample errs there, so that none is forgiven: with `mask_error`, what is opaque in free space would have next to
    no gradient, and would stay. Beyond one mean free path the loss grows with the logarithm, or few points would count.
    """
    field, likelihood, config = shared
    points, inside, sure = item
    tau = field.density(weights, points) * foam.window(points) / likelihood.lattice.cubes
    thick = config.grazing * tau
    empty = -jnp.where(thick < 1.0, thick, 1.0 + jnp.log(jnp.maximum(thick, 1.0)))
    solid = jnp.log(1e-3 - jnp.expm1(-tau / config.finer))
    return jnp.sum(jnp.where(sure, jnp.where(inside, solid, empty), 0.0)) / jnp.maximum(jnp.sum(sure), 1)
