"""Observation in, Posterior out: the model, the pixel likelihood and a sampler put together (unit cube only)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from probnerf import foam, fused
from probnerf.hmc import AnnealedHMCConfig, StageInfo, annealed_hmc
from probnerf.model import (
    POSE_SIZE,
    Likelihood,
    Model,
    density_at,
    faces_of_view,
    log_likelihood,
    pose_of,
    range_offset_of,
    split_position,
)
from probnerf.populations import start_from
from probnerf.prior import ProbNeRF
from probnerf.proposal import Picture, propose
from probnerf.smc import TemperedSMCConfig, tempered_smc
from probnerf.types import BASE_Z, OBJECT, UNKNOWN, Observation, Pose, Posterior

Method = Literal["tempered_smc", "annealed_hmc"]
_NOWHERE = 50.0  # cube units, outside every window: the kernel passes such points over
WALL_ERROR = 0.02  # cube units; how well the prior's shapes place a wall


def quick_smc() -> TemperedSMCConfig:
    """A population that two CPU cores move in seconds; `TemperedSMCConfig()` is the one that the laws are tested on."""
    # many particles and one short move: few particles all descend from one or two starts, and lose the other modes
    return TemperedSMCConfig(
        populations=4,
        particles=48,
        start_particles=384,
        moves=1,
        leapfrog_steps=3,
        ess_target=0.4,
        target_acceptance=0.65,
        final_stages=1,
        keep=1,
        evidence_power=0.5,
        least_moved=1.0,
    )


@dataclass(frozen=True)
class InferConfig:
    """Which sampler, how much of it, and the pixel likelihood's numbers."""

    method: Method = "tempered_smc"
    smc: TemperedSMCConfig = field(default_factory=quick_smc)
    hmc: AnnealedHMCConfig = field(default_factory=AnnealedHMCConfig)
    lattice: int = 32  # G: cubes per 2 units
    extent: float = 1.1  # the lattice covers [-extent, extent]^3: an object may be larger than its guessed cube
    below: float = 0.15  # and so much under the plane, for its height is uncertain
    colour_sigma: float = 0.3  # s: what the prior cannot draw of a print or a band, too
    wall_sigma: float = 0.05  # cube units: the model's own error in a wall's place; wide, for small misfits are shared
    outlier: float = 0.01  # share of ranges from nowhere; small, for a lid over a visible cavity is no outlier
    reach: float = 0.3  # cube units behind a measured range beyond which nothing is asked
    power: float = 1.0  # kappa: what one pixel counts for
    encoder_starts: bool = True  # propose starts by the encoder, in a defensive mixture with the prior
    sample_delta: bool = False  # also infer the weights' perturbation delta

    def __post_init__(self) -> None:
        if self.lattice < 1 or not min(self.extent, self.colour_sigma, self.wall_sigma, self.power) > 0:
            raise ValueError(
                f"lattice {self.lattice} must be 1 or more, and extent {self.extent:g}, colour_sigma"
                f" {self.colour_sigma:g}, wall_sigma {self.wall_sigma:g} and power {self.power:g} more than 0"
            )


def likelihood_settings(config: InferConfig, sample_pose: bool = True) -> Likelihood:
    """The likelihood's settings, for any view."""
    return Likelihood(
        lattice=foam.Lattice(config.lattice, config.extent, below=config.below),
        colour_sigma=config.colour_sigma,
        wall_sigma=config.wall_sigma,
        outlier=config.outlier,
        reach=config.reach,
        power=config.power,
        sample_pose=sample_pose,
        sample_delta=config.sample_delta,
    )


def likelihood_of(config: InferConfig, observation: Observation, sample_pose: bool = True) -> Likelihood:
    """The likelihood's settings for one view, with its sizes where there is no kernel (`with_sizes`)."""
    likelihood = likelihood_settings(config, sample_pose)
    return likelihood if fused.available() else with_sizes(likelihood, observation)


def with_sizes(likelihood: Likelihood, observation: Observation) -> Likelihood:
    """The settings with one view's number of crossings, which plain JAX packs: padded, so that most views share one
    compiled program.
    """
    lattice = likelihood.lattice
    each = np.sum(np.asarray(faces_of_view(observation, likelihood)) < foam.FAR, axis=1)

    def padded(count: int, step: int) -> int:
        return step * max(1, math.ceil(count / step))

    most = min(padded(each.max(), 64), 3 * lattice.planes)
    packed = (padded(each[: observation.colour_count].sum(), 512), padded(each.sum(), 1024))
    return replace(likelihood, lattice=replace(lattice, max_crossings=most), packed=packed)


def crossings_of(likelihood: Likelihood, observation: Observation) -> int:
    """Crossings of a view at which the field is evaluated for each particle."""
    return int(np.sum(np.asarray(faces_of_view(observation, likelihood)) < foam.FAR))


def without_sizes(likelihood: Likelihood) -> Likelihood:
    """The settings less the padded sizes of one view, so that what is asked of shapes compiles once for all views."""
    lattice = likelihood.lattice
    return replace(likelihood, lattice=replace(lattice, max_crossings=3 * lattice.planes), packed=(0, 0))


def infer(
    key: Array,
    model: Model,
    observation: Observation,
    config: InferConfig | None = None,
    *,
    picture: Picture | None = None,
    before: Posterior | None = None,
    sample_pose: bool = True,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    deadline: float | None = None,
    stages: int | None = None,
) -> tuple[Posterior, Likelihood]:
    """Sample p(z~, pose, delta | observation).

    `picture` lets the encoder propose starts (ProbNeRF models only). `before` is a posterior of the same latents (the
    same cube and pose widths) given another observation, usually a part of this one: its samples are reweighted, then
    moved (`start_from`). `deadline` is on time.monotonic()'s clock;
    `stages` caps the sampler's stages (iterations of annealed HMC, whose schedule is shortened to fit).
    """
    config = config or InferConfig()
    likelihood = likelihood_of(config, observation, sample_pose)
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    dim = likelihood.dim(model)
    if config.method == "annealed_hmc":
        hmc = (
            config.hmc if stages is None else replace(config.hmc, iterations=stages, keep=min(config.hmc.keep, stages))
        )
        return annealed_hmc(key, log_likelihood, args, dim, hmc, on_stage=on_stage, deadline=deadline), likelihood
    initial = None
    if before is not None:
        initial = start_from(before, config.smc.populations)
    elif picture is not None and config.encoder_starts and isinstance(model, ProbNeRF) and not config.sample_delta:
        key, start = jax.random.split(key)
        initial = propose(
            start,
            model,
            likelihood,
            picture,
            observation.pose_sigma,
            config.smc.populations,
            config.smc.start_particles,
        )
    posterior = tempered_smc(
        key, log_likelihood, args, dim, config.smc, initial=initial, on_stage=on_stage, deadline=deadline, stages=stages
    )
    return posterior, likelihood


@jax.jit
def opacity_grids(
    model: Model,
    likelihood: Likelihood,
    positions: Float[Array, "s d"],
    pose_sigma: Float[Array, "5"],
    asked: Bool[Array, "g g g"],
) -> UInt8[Array, "s g g g"]:
    """round(255 x opacity across a voxel) of each position's shape on [-1, 1]^3 of the view frame, 0 if not `asked`.

    A voxel's opacity is the largest at its eight corners: like the truth's, it is a wall where it meets the solid.
    """
    grid = asked.shape[0]
    axis = jnp.linspace(-1.0, 1.0, grid + 1)
    points = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    corners = jax.lax.reduce_window(jnp.pad(asked, 1), False, jnp.logical_or, (2, 2, 2), (1, 1, 1), "valid")
    points = jnp.where(corners[..., None], points, _NOWHERE).reshape(-1, 3)
    decoded = jax.vmap(model.decode)(positions[:, : model.latent])  # together, as in `plain_log_likelihood`

    def one(item: tuple[Float[Array, "d"], Float[Array, "w"]]) -> UInt8[Array, "g g g"]:
        position, decoded = item
        weights, pose = split_position(model, likelihood, position, pose_sigma, decoded)
        sigma = density_at(model.field, weights, pose, points)
        scale = jnp.ones(()) if pose is None else jnp.exp(pose.log_scale)
        corner = jnp.round(-255.0 * jnp.expm1(-sigma * scale / grid)).astype(jnp.uint8)
        corner = corner.reshape(grid + 1, grid + 1, grid + 1)
        largest = jax.lax.reduce_window(corner, jnp.uint8(0), jax.lax.max, (2, 2, 2), (1, 1, 1), "valid")
        return jnp.where(asked, largest, 0)

    return jax.lax.map(one, (positions, decoded))


def poses(model: Model, likelihood: Likelihood, positions: Float[Array, "s d"], pose_sigma: Float[Array, "5"]) -> Pose:
    """Pose of each position (identity where the pose was known)."""
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

    Scaled about the camera a shape keeps its picture: what ray it is met on, in which order. Only ranges tell. The
    positions' poses must be sampled.
    """
    at = model.latent + 2  # of x, y, log-scale, range offset, z
    pose = pose_of(positions[:, model.latent : model.latent + POSE_SIZE], pose_sigma)
    foot = jnp.stack([pose.x, pose.y, BASE_Z + pose.z], axis=-1)
    shift = jnp.expm1(log_factor)[:, None] * (foot - origin)
    moved = jnp.stack([shift[:, 0], shift[:, 1], log_factor, jnp.zeros_like(log_factor), shift[:, 2]], axis=-1)
    return positions.at[:, at : at + 5].add(moved / jnp.maximum(pose_sigma, 1e-9))


@jax.jit
def explained(
    model: Model, likelihood: Likelihood, observation: Observation, positions: Float[Array, "s d"]
) -> Float[Array, "s"]:
    """Share of telling pixels that each position explains: object pixels hit at the measured range, free ones missed.

    A range is explained within 3 standard deviations of the sensor's error and of a well-placed wall's (`WALL_ERROR`):
    what the likelihood forgives (`wall_sigma`) is more than what a shape of the prior needs.
    """
    t = faces_of_view(observation, likelihood)
    status = observation.status
    tells = (status != UNKNOWN) | (observation.limit > 0)
    # padding is put where the window is 0, which costs nothing
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
