"""Each pixel's log density in plain JAX: object mask, range and colour."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from probnerf.compile_cache import program
from probnerf.fields.base import Field, Model
from probnerf.likelihood.position import range_offset_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import FREE, OBJECT
from probnerf.rendering import foam
from probnerf.types import Observation, Pose


@program(rehearse=False)
def faces_of_view(observation: Observation, likelihood: Likelihood) -> Float[Array, "... n m"]:
    """Crossings of every ray that can affect its pixel. They are constants of the observation, computed once per view.

    For FREE and UNKNOWN rays, crossings beyond the limit are dropped. This is exact. For OBJECT rays, crossings more
    than `reach` behind the measured range are dropped. This is an approximation: a surface there could explain the
    range only as a depth outlier, and now counts as a mask error instead. Apart from colour, both have the same
    likelihood if the outlier and mask error rates are equal.
    """
    rays = jax.tree.map(lambda a: a.reshape(-1, 3), observation.rays)
    t = foam.crossings(rays, likelihood.lattice).reshape(*observation.status.shape, -1)
    behind = jnp.where(observation.range_valid, observation.range + likelihood.reach, jnp.inf)
    end = jnp.where(observation.status == OBJECT, behind, observation.limit)
    return jnp.where(t <= end[..., None], t, foam.FAR)


def _where_crossed(
    t: Float[Array, "n m"], most: int, function: Callable[..., Array], *each: Shaped[Array, "n m ..."]
) -> Shaped[Array, "n m ..."]:
    """function(*each) at the crossings that are not padding, at most `most` of them; 0 elsewhere (most 0: every slot).

    Rays differ in their number of crossings, so most slots are padding. Evaluating the field is the main cost.
    """
    if not most:
        return function(*each)
    (index,) = jnp.nonzero(t.ravel() < foam.FAR, size=most, fill_value=t.size)
    found = function(*(a.reshape(t.size, *a.shape[2:]).at[index].get(mode="clip") for a in each))
    slots = jnp.zeros((t.size, *found.shape[1:]), found.dtype).at[index].set(found, mode="drop")
    return slots.reshape(*t.shape, *found.shape[1:])


def log_likelihood_one(
    model: Model,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "n m"],
    position: Float[Array, "d"],
    decoded: Float[Array, "w"] | None = None,
) -> Float[Array, ""]:
    """log p(observation | one position), summed over pixels."""
    weights, pose = split_position(model, likelihood, position, observation.pose_sigma, decoded)
    offset = range_offset_of(model, likelihood, position, observation.pose_sigma)
    return likelihood.power * jnp.sum(pixel_terms(model.field, weights, pose, likelihood, observation, t, offset))


def pixel_terms(
    field: Field,
    weights: Float[Array, "w"],
    pose: Pose | None,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "n m"],
    range_offset: Float[Array, ""] | float = 0.0,
) -> Float[Array, "n"]:
    """Each pixel's log density: object mask, range and colour."""
    n_colour = observation.colour_count
    points = foam.points_on_rays(observation.rays, t)
    scale = jnp.ones(())
    if pose is not None:
        points, scale = pose.to_object(points), jnp.exp(pose.log_scale)
    sigma = _where_crossed(t, likelihood.packed[1], lambda p: field.density(weights, p) * foam.window(p), points)
    faces = foam.composite(sigma, t, scale / likelihood.lattice.cubes)
    log_miss = faces.log_transmittance[:, -1]
    eps = likelihood.mask_error

    # OBJECT: sum_i w_i p(m|hit) p(d|t_i) + T p(m|miss) p(d|miss)
    t_hit, log_w = t[:n_colour], faces.log_weight[:n_colour]
    # the surface lies in the gap before the face: centred on t_i, it would make shapes half a gap too large
    gap = foam.gap_before(t_hit)
    deviation = jnp.sqrt(observation.range_sigma[:n_colour, None] ** 2 + likelihood.wall_sigma**2 + gap**2 / 12.0)
    surface = jnp.where(t_hit < foam.FAR, t_hit - 0.5 * gap, 0.0)
    valid = observation.range_valid[:n_colour]
    measured = jnp.where(valid, observation.range[:n_colour], 0.0) - range_offset  # no NaN may reach the gradient
    residual = (measured[:, None] - surface) / deviation
    log_uniform = -jnp.log(likelihood.outlier_span)
    log_depth = jnp.logaddexp(
        jnp.log1p(-likelihood.outlier) - 0.5 * residual**2 - jnp.log(deviation) - 0.5 * jnp.log(2 * jnp.pi),
        jnp.log(likelihood.outlier) + log_uniform,
    )
    log_hit = jax.nn.logsumexp(log_w + jnp.where(valid[:, None], log_depth, 0.0), axis=-1) + jnp.log1p(-eps)
    log_not = log_miss[:n_colour] + jnp.log(eps) + jnp.where(valid, log_uniform, 0.0)
    as_object = jnp.logaddexp(log_hit, log_not)

    # colour, given a hit: N(c; sum w_i c_i / O, s^2)
    directions = jnp.broadcast_to(observation.rays.direction[:n_colour, None, :], points[:n_colour].shape)
    if pose is not None:
        directions = pose.to_object_direction(directions)
    colour = _where_crossed(
        t_hit, likelihood.packed[0], partial(field.colour, weights), points[:n_colour], directions, sigma[:n_colour]
    )
    w = jnp.exp(log_w)
    mean = mean_colour(jnp.einsum("nm,nmc->nc", w, colour), jnp.sum(w, axis=-1, keepdims=True))
    s = likelihood.colour_sigma
    seen = observation.rgb_valid[:n_colour]
    difference = jnp.where(seen[:, None], observation.rgb[:n_colour] - mean, 0.0)  # no NaN may reach the gradient
    colour_term = jnp.sum(-0.5 * (difference / s) ** 2 - jnp.log(s) - 0.5 * jnp.log(2 * jnp.pi), axis=-1)
    as_object = as_object + jnp.where(seen, colour_term, 0.0)

    # FREE and UNKNOWN: the object is not in front of the measured end (transmittance up to `limit`)
    before = t <= observation.limit[:, None]
    tau = -jnp.diff(faces.log_transmittance, axis=-1, prepend=0.0)
    log_clear = -jnp.sum(jnp.where(before, tau, 0.0), axis=-1)
    says = observation.limit > 0.0
    as_empty = jnp.where(says, jnp.logaddexp(jnp.log(eps), jnp.log1p(-2 * eps) + log_clear), 0.0)

    status = observation.status
    is_object = jnp.zeros_like(status, dtype=bool).at[:n_colour].set(status[:n_colour] == OBJECT)
    as_object = jnp.zeros_like(as_empty).at[:n_colour].set(as_object)
    return jnp.where(is_object, as_object, jnp.where((status == FREE) | says, as_empty, 0.0))


def mean_colour(premultiplied: Float[Array, "n 3"], opacity: Float[Array, "n 1"]) -> Float[Array, "n 3"]:
    """Sum w_i c_i / O: a pixel's expected colour, given a hit. Grey if nothing is hit."""
    return (premultiplied + 0.5e-3) / (opacity + 1e-3)
