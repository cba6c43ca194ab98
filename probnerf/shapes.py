"""Properties of sampled positions: shapes as voxels, poses, and the share of explained pixels."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from probnerf.compile_cache import program
from probnerf.fields.base import Model
from probnerf.likelihood.dispatch import density_at
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.position import pose_of, range_offset_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import OBJECT, UNKNOWN
from probnerf.rendering import foam
from probnerf.types import BASE_Z, POSE_SIZE, Observation, Pose

_NOWHERE = 50.0  # cube units; outside every window, so the kernel skips such points
WALL_ERROR = 0.02  # cube units; error of a wall's position in the prior's shapes


@program("coarse")
def opacity_grids(
    model: Model,
    likelihood: Likelihood,
    positions: Float[Array, "s d"],
    pose_sigma: Float[Array, "5"],
    wanted: Bool[Array, "g g g"],
    *,
    coarse: int = 1,
) -> UInt8[Array, "s g g g"]:
    """round(255 x opacity across a voxel) of each position's shape on [-1, 1]^3 of the view frame; 0 if not `wanted`.

    A voxel's opacity is the maximum over its eight corners. So it is a wall if it intersects the solid, as in the
    ground truth. Opacity is evaluated at every `coarse`-th corner along each axis, and interpolated between them.
    """
    grid = wanted.shape[0]
    cells = -(-grid // coarse)
    axis = jnp.linspace(-1.0, 2.0 * cells * coarse / grid - 1.0, cells + 1)
    points = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    needed = jnp.pad(wanted, (0, cells * coarse - grid))
    needed = needed.reshape(cells, coarse, cells, coarse, cells, coarse).any((1, 3, 5))
    corners = _of_neighbours(jnp.pad(needed, 1))
    points = jnp.where(corners[..., None], points, _NOWHERE).reshape(-1, 3)
    between = jnp.maximum(1.0 - jnp.abs(jnp.arange(grid + 1)[:, None] / coarse - jnp.arange(cells + 1)), 0.0)
    decoded = jax.vmap(model.decode)(positions[:, : model.latent])  # as one batch, as in `plain_log_likelihood`

    def one(item: tuple[Float[Array, "d"], Float[Array, "w"]]) -> UInt8[Array, "g g g"]:
        position, decoded = item
        weights, pose = split_position(model, likelihood, position, pose_sigma, decoded)
        sigma = density_at(model.field, weights, pose, points)
        scale = jnp.ones(()) if pose is None else jnp.exp(pose.log_scale)
        corner = (-255.0 * jnp.expm1(-sigma * scale / grid)).reshape(cells + 1, cells + 1, cells + 1)
        if coarse > 1:
            for _ in range(3):  # each contraction moves the next axis to the front's place
                corner = jnp.tensordot(corner, between, ((0,), (1,)))
        corner = jnp.round(corner).astype(jnp.uint8)
        return jnp.where(wanted, _of_neighbours(corner), 0)

    return jax.lax.map(one, (positions, decoded))


def _of_neighbours(values: Array) -> Array:
    """The largest of each eight neighbours, a pair along each axis: on a CPU much faster than `reduce_window`."""
    for axis in range(3):
        count = values.shape[axis] - 1
        values = jnp.maximum(*(jax.lax.slice_in_dim(values, k, k + count, axis=axis) for k in (0, 1)))
    return values


@program()
def poses(model: Model, likelihood: Likelihood, positions: Float[Array, "s d"], pose_sigma: Float[Array, "5"]) -> Pose:
    """Pose of each position (the identity if the pose was known)."""
    if not likelihood.sample_pose:
        zeros = jnp.zeros(positions.shape[0])
        return Pose(*[zeros] * 5)
    k = model.latent
    return pose_of(positions[:, k : k + POSE_SIZE], pose_sigma)


def scaled_about(
    model: Model,
    positions: Float[Array, "s d"],
    pose_sigma: Float[Array, "5"],
    origin: Float[Array, "3"],
    log_factor: Float[Array, "s"],
) -> Float[Array, "s d"]:
    """Positions whose shapes are scaled about a point: p -> origin + exp(log_factor) (p - origin), view frame.

    If `origin` is the camera, the picture of the shape does not change: only its ranges do. The positions must include
    sampled poses.
    """
    at = model.latent + 2  # of x, y, log-scale, range offset, z
    pose = pose_of(positions[:, model.latent : model.latent + POSE_SIZE], pose_sigma)
    foot = jnp.stack([pose.x, pose.y, BASE_Z + pose.z], axis=-1)
    shift = jnp.expm1(log_factor)[:, None] * (foot - origin)
    moved = jnp.stack([shift[:, 0], shift[:, 1], log_factor, jnp.zeros_like(log_factor), shift[:, 2]], axis=-1)
    return positions.at[:, at : at + 5].add(moved / jnp.maximum(pose_sigma, 1e-9))


@program()
def explained(
    model: Model, likelihood: Likelihood, observation: Observation, positions: Float[Array, "s d"]
) -> Float[Array, "s"]:
    """Share of informative pixels that each position explains.

    An object pixel is explained if its ray hits at the measured range, a free pixel if its ray misses. The tolerance of
    a range is 3 standard deviations of the sensor's error combined with `WALL_ERROR`. The likelihood's `wall_sigma` is
    not used: it is larger than the shapes of the prior need.
    """
    t = faces_of_view(observation, likelihood)
    status = observation.status
    tells = (status != UNKNOWN) | (observation.limit > 0)
    # padding is outside the window, where it costs nothing
    points = jnp.where((t < foam.FAR)[..., None], foam.points_on_rays(observation.rays, t), foam.FAR)
    decoded = jax.vmap(model.decode)(positions[:, : model.latent])

    def one(item: tuple[Float[Array, "d"], Float[Array, "w"]]) -> Float[Array, ""]:
        """One position's share, given its decoded weights."""
        position, decoded = item
        weights, pose = split_position(model, likelihood, position, observation.pose_sigma, decoded)
        sigma = density_at(model.field, weights, pose, points)
        scale = jnp.ones(()) if pose is None else jnp.exp(pose.log_scale)
        faces = foam.composite(sigma, t, scale / likelihood.lattice.cubes)
        w = jnp.exp(faces.log_weight)
        hit = -jnp.expm1(faces.log_transmittance[:, -1])
        tolerance = 3.0 * jnp.sqrt(observation.range_sigma**2 + WALL_ERROR**2)
        offset = range_offset_of(model, likelihood, position, observation.pose_sigma)
        close = jnp.abs(t - (observation.range - offset)[:, None]) <= tolerance[:, None]
        at_range = jnp.sum(jnp.where(close, w, 0.0), axis=-1)
        before = jnp.sum(jnp.where(t <= observation.limit[:, None], w, 0.0), axis=-1)
        good = jnp.where(
            status == OBJECT, jnp.where(observation.range_valid, at_range, hit), 1.0 - jnp.where(tells, before, 0.0)
        )
        return jnp.sum(jnp.where(tells, good > 0.5, False)) / jnp.maximum(jnp.sum(tells), 1)

    return jax.lax.map(one, (positions, decoded))
