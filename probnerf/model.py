"""log p(observation | position): what camera pixels say, and the position vector that samplers move.

A position is a flat vector [z~ (K) | a, b, x, y, log-scale, range offset, z (7, if the pose is unknown) | delta (D, if
open)], each entry a priori N(0, 1), so the log prior is the same standard normal for every model and tempering is one
multiply.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, Shaped

from probnerf import foam, fused
from probnerf.field import CylinderField, Field, MLPField
from probnerf.programs import program
from probnerf.types import FREE, OBJECT, Observation, Pose, Rays

POSE_SIZE = 7


class Model(Protocol):
    """A prior over fields: the trained ProbNeRF or an analytic one."""

    @property
    def field(self) -> Field: ...
    @property
    def latent(self) -> int: ...
    def decode(self, z_tilde: Float[Array, "k"]) -> Float[Array, "d"]: ...


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


class Likelihood(eqx.Module):
    """The pixel model's settings; they travel with every posterior."""

    lattice: foam.Lattice
    colour_sigma: float = eqx.field(static=True, default=0.1)  # s
    mask_error: float = eqx.field(static=True, default=0.01)  # epsilon, each way
    outlier: float = eqx.field(static=True, default=0.05)  # pi: depth from nowhere, uniform over `outlier_span`
    outlier_span: float = eqx.field(static=True, default=2.5)  # cube units
    wall_sigma: float = eqx.field(static=True, default=0.02)  # floor of the model's own wall error, cube units
    reach: float = eqx.field(
        static=True, default=math.inf
    )  # OBJECT: a surface so far behind the range is as good as none
    packed: tuple[int, int] = eqx.field(static=True, default=(0, 0))  # most crossings: colour rays', all; 0: no packing
    power: float = eqx.field(static=True, default=1.0)  # kappa; other than 1 is a stated power likelihood
    sample_pose: bool = eqx.field(static=True, default=True)
    sample_delta: bool = eqx.field(static=True, default=False)
    delta_scale: float = eqx.field(static=True, default=0.025)  # sqrt(alpha)

    def dim(self, model: Model) -> int:
        """Length of a position vector."""
        weights = model.field.size if self.sample_delta else 0  # type: ignore[attr-defined]
        return model.latent + POSE_SIZE * self.sample_pose + weights


def pose_of(latent: Float[Array, "7"], pose_sigma: Float[Array, "5"]) -> Pose:
    """yaw = atan2(b, a); x, y, log-scale and z are standard normals times perception's widths."""
    a, b = latent[..., 0], latent[..., 1]
    # atan2 has no gradient at the origin, a point of measure zero that float32 could still meet
    at_origin = (a * a + b * b) < 1e-12
    yaw = jnp.arctan2(b, jnp.where(at_origin, 1.0, a))
    x, y, log_scale = (latent[..., 2 + i] * pose_sigma[i] for i in range(3))
    return Pose(yaw=yaw, x=x, y=y, log_scale=log_scale, z=latent[..., 6] * pose_sigma[4])


def range_offset_of(
    model: Model, likelihood: Likelihood, position: Float[Array, "d"], pose_sigma: Float[Array, "5"]
) -> Float[Array, ""]:
    """What all ranges of a view have in common, cube units: a depth camera's bias, which no number of pixels averages.

    Without it the many pixels would place a hidden back wall confidently where the bias puts it.
    """
    return position[model.latent + 5] * pose_sigma[3] if likelihood.sample_pose else jnp.zeros(())


def split_position(
    model: Model,
    likelihood: Likelihood,
    position: Float[Array, "d"],
    pose_sigma: Float[Array, "5"],
    decoded: Float[Array, "w"] | None = None,
) -> tuple[Float[Array, "w"], Pose | None]:
    """Field weights w~ and pose of one position; `decoded` is its `model.decode`, if that is known."""
    k = model.latent
    weights = model.decode(position[:k]) if decoded is None else decoded
    pose = None
    if likelihood.sample_pose:
        pose = pose_of(position[k : k + POSE_SIZE], pose_sigma)
    if likelihood.sample_delta:
        weights = weights + likelihood.delta_scale * position[-weights.shape[0] :]  # w~ = w + sqrt(alpha) delta
    return weights, pose


@program(rehearse=False)
def faces_of_view(observation: Observation, likelihood: Likelihood) -> Float[Array, "n m"]:
    """Crossings of every ray that its pixel can tell of: constants of the observation, computed once per view.

    None is farther than a FREE or UNKNOWN ray's limit, or than `reach` behind an OBJECT ray's measured range. The first
    changes nothing. The second takes a surface there, which only an outlier in depth explains, for a missed mask: as
    likely where the two shares are equal, but for the colour.
    """
    t = foam.crossings(observation.rays, likelihood.lattice)
    behind = jnp.where(observation.range_valid, observation.range + likelihood.reach, jnp.inf)
    end = jnp.where(observation.status == OBJECT, behind, observation.limit)
    return jnp.where(t <= end[:, None], t, foam.FAR)


def _where_crossed(
    t: Float[Array, "n m"], most: int, function: Callable[..., Array], *each: Shaped[Array, "n m ..."]
) -> Shaped[Array, "n m ..."]:
    """function(*each) at the crossings that are no padding, at `most` so many; 0 elsewhere (most 0: at every slot).

    Rays differ in their number of crossings, so that most slots are padding, and the field is what costs.
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
    """Each pixel's log density: where its ray ends, is it the object, how far, which colour."""
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
    # the surface lies in the gap before the face: centred on t_i instead, shapes grow by half a gap
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

    # colour given a hit: N(c; sum w_i c_i / O, s^2)
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


def density_at(
    field: Field, weights: Float[Array, "w"], pose: Pose | None, points: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """Window x density at points of the view frame; by the kernel, which has no gradient, where it was built."""
    if isinstance(field, MLPField) and fused.available():
        row = _row(pose, jnp.zeros(()))
        return fused.density(field, weights[None], row[None], points.reshape(-1, 3)).reshape(points.shape[:-1])
    moved = points if pose is None else pose.to_object(points)
    return field.density(weights, moved) * foam.window(moved)


def weighted_terms(
    field: Field,
    weights: Float[Array, "w"],
    pose: Pose,
    likelihood: Likelihood,
    observation: Observation,
    t: Float[Array, "n m"],
    pixel_weight: Float[Array, "n"],
) -> Float[Array, ""]:
    """Sum of `pixel_weight` x `pixel_terms`, differentiable in `weights` alone; by the kernel where it was built."""
    if isinstance(field, MLPField) and fused.available():
        row = _row(pose, jnp.zeros(()))
        return fused.view_terms(field, likelihood, observation, t, weights[None], row[None], pixel_weight)[0]
    return jnp.sum(pixel_weight * pixel_terms(field, weights, pose, likelihood, observation, t))


def mean_colour(premultiplied: Float[Array, "n 3"], opacity: Float[Array, "n 1"]) -> Float[Array, "n 3"]:
    """Sum w_i c_i / O: a pixel's expected colour given a hit; grey where nothing is hit."""
    return (premultiplied + 0.5e-3) / (opacity + 1e-3)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def map_with_gradient(
    function: Callable, batch_size: int | None, shared: Any, each: Any, x: PyTree[Array]
) -> Float[Array, "p"]:
    """[function(shared, each_p, x_p) for p], differentiable in `x` alone.

    Value and gradient of an element are computed together, `batch_size` elements at a time (None: one by one), so that
    memory does not grow with the batch and a CPU's caches hold one element's rays.
    """
    return jax.lax.map(lambda item: function(shared, *item), (each, x), batch_size=batch_size)


def _map_forward(function, batch_size, shared, each, x):
    def one(item):
        return jax.value_and_grad(lambda v: function(shared, item[0], v))(item[1])

    values, gradients = jax.lax.map(one, (each, x), batch_size=batch_size)
    return values, gradients


def _map_backward(function, batch_size, gradients, cotangent):
    return None, None, jax.tree.map(lambda g: g * cotangent.reshape(-1, *([1] * (g.ndim - 1))), gradients)


map_with_gradient.defvjp(_map_forward, _map_backward)


def log_likelihood(
    args: tuple[Model, Likelihood, Observation, Float[Array, "n m"]], positions: Float[Array, "p d"]
) -> Float[Array, "p"]:
    """Batched log-likelihood for the samplers; differentiable in `positions` only.

    The kernel evaluates an `MLPField` where it was built, particles shared out over threads. Without it they are shared
    out over JAX's devices where their number allows: one CPU core moves one particle at a time, so a CPU counts as
    several devices (`JAX_NUM_CPU_DEVICES`).
    """
    if isinstance(args[0].field, MLPField) and fused.available():
        return _fused(args, positions)
    return plain_log_likelihood(args, positions)


def _fused(args, positions):
    model, likelihood, observation, t = args

    def drawn(position):
        weights, pose = split_position(model, likelihood, position, observation.pose_sigma)
        return weights, _row(pose, range_offset_of(model, likelihood, position, observation.pose_sigma))

    weights, pose = jax.vmap(drawn)(positions)
    return likelihood.power * fused.view_terms(model.field, likelihood, observation, t, weights, pose)


def _row(pose: Pose | None, offset: Float[Array, ""]) -> Float[Array, "6"]:
    """A pose and the ranges' offset as the kernel takes them."""
    place = jnp.zeros(5) if pose is None else jnp.stack([pose.yaw, pose.x, pose.y, pose.log_scale, pose.z])
    return jnp.append(place, offset)


def plain_log_likelihood(
    args: tuple[Model, Likelihood, Observation, Float[Array, "n m"]], positions: Float[Array, "p d"]
) -> Float[Array, "p"]:
    """`log_likelihood` in JAX alone: the kernel's reference, and what runs where there is no kernel."""

    def mapped(args, positions):
        # together: one by one, each would read the hypernetwork's weights through memory
        decoded = jax.vmap(args[0].decode)(positions[:, : args[0].latent])
        return map_with_gradient(_one_particle, None, args, None, (positions, decoded))

    devices = jax.devices()
    if len(devices) == 1 or positions.shape[0] % len(devices):
        return mapped(args, positions)
    mesh = jax.sharding.Mesh(np.array(devices), ("particles",))
    whole, split = jax.sharding.PartitionSpec(), jax.sharding.PartitionSpec("particles")
    shared = jax.shard_map(mapped, mesh=mesh, in_specs=(whole, split), out_specs=split, check_vma=False)
    return shared(args, positions)


def _one_particle(args, _, particle):
    model, likelihood, observation, t = args
    return log_likelihood_one(model, likelihood, observation, t, *particle)


def empty_observation_rays(count: int) -> Rays:
    """Padding rays: they start outside the lattice and point away from it."""
    return Rays(origin=jnp.full((count, 3), 50.0), direction=jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0]), (count, 3)))
