"""Answers to one view: the posterior, and what it must beat: prior alone, encoder alone, one MAP shape."""

import time
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.scene import GRID, VesselView
from benchmarks.score import Answer
from perception.controller import ControllerConfig, crop, estimate
from perception.observe import observe
from perception.seen import answered_voxels
from perception.segment import Segment
from perception.source import Frame
from probnerf.baselines.map import MAPConfig, map_estimate
from probnerf.infer import likelihood_of, opacity_grids
from probnerf.model import POSE_SIZE, Likelihood, faces_of_view, log_likelihood
from probnerf.occupancy import coarsen, solid
from probnerf.prior import ProbNeRF
from probnerf.proposal import Picture, potential_at
from probnerf.store import Prior
from probnerf.types import Observation, Pose

POSTERIOR, PRIOR, ENCODER, MAP = METHODS = ("tempered_smc", "prior alone", "encoder alone", "map")


@dataclass(frozen=True)
class RivalConfig:
    """Sizes of the rivals; the posterior's are the controller's own."""

    yaws: int = 24  # of the encoder's and the MAP's grid
    draws: int = 4  # of the encoder at each yaw
    fit: MAPConfig = field(default_factory=lambda: MAPConfig(steps=200))


def answers(
    vessel: VesselView,
    prior: Prior,
    config: ControllerConfig,
    rivals: RivalConfig,
    seed: int,
    budget_s: float | None,
    stages: int | None,
) -> dict[str, Answer]:
    """All four methods' answers to the same observation."""
    found = estimate(vessel.frame, vessel.segment, prior, config, seed=seed, budget_s=budget_s, stages=stages)
    h = found.hypotheses
    result = {POSTERIOR: Answer(coarsen(h.solid, GRID), h.weights, found.seconds, h.result)}
    observation, cube = observe(vessel.frame, vessel.segment, config.observe, seed)
    picture = crop(vessel.frame, vessel.segment, cube, prior.model.preset.image_size)
    likelihood = likelihood_of(config.infer, observation)
    model, key = prior.model, jax.random.key(seed)
    dim = likelihood.dim(model)
    asked = jnp.asarray(answered_voxels(vessel.frame, vessel.segment, cube, config.grid))

    def answer(positions: Array, weights: np.ndarray, begun: float) -> Answer:
        opacity = opacity_grids(model, likelihood, positions, observation.pose_sigma, asked)
        shapes = coarsen(solid(np.asarray(opacity)), GRID)
        return Answer(shapes, weights, time.monotonic() - begun)

    begun = time.monotonic()
    count = len(h.weights)
    result[PRIOR] = answer(jax.random.normal(key, (count, dim)), np.full(count, 1.0 / count), begun)
    begun = time.monotonic()
    drawn, weights = encoder_alone(key, model, likelihood, observation, picture, rivals)
    result[ENCODER] = answer(drawn, weights, begun)
    begun = time.monotonic()
    starts = encoder_positions(key, model, picture, rivals.yaws, 1, 0.0)
    best, _ = map_estimate(model, likelihood, observation, starts, rivals.fit)
    result[MAP] = answer(best[None], np.ones(1), begun)
    return result


def warm_up(
    frame: Frame, segment: Segment, prior: Prior, config: ControllerConfig, sizes: set[tuple[int, ...]]
) -> None:
    """Compile what this view needs, once for each of the `sizes` it comes in, so that no budget pays for it."""
    observation, _ = observe(frame, segment, config.observe)
    likelihood = likelihood_of(config.infer, observation)
    size = (likelihood.lattice.crossings, *likelihood.packed)
    if size not in sizes:
        for level in config.levels:
            estimate(frame, segment, prior, replace(config, levels=(level,)), stages=1)
        sizes.add(size)


def encoder_alone(
    key: Array, model: ProbNeRF, likelihood: Likelihood, observation: Observation, picture: Picture, config: RivalConfig
) -> tuple[Float[Array, "s d"], Float[np.ndarray, "s"]]:
    """Draws z_kj ~ q(z | picture, yaw_k) over a grid of yaws, weighted by how well each yaw explains the view.

    The weight of yaw k is its mean likelihood, W_k = sum_j p(observation | z_kj, yaw_k) / J, shared evenly by its J
    draws: within a yaw the encoder is taken at its word. x, y and scale are perception's guess.
    """
    positions = encoder_positions(key, model, picture, config.yaws, config.draws, 1.0)
    args = (model, likelihood, observation, faces_of_view(observation, likelihood))
    values = np.asarray(jax.jit(log_likelihood)(args, positions), np.float64).reshape(config.yaws, config.draws)
    values = np.where(np.isfinite(values), values, -np.inf)
    each = np.exp(values - values.max()).mean(axis=1)
    return positions, np.repeat(each / each.sum() / config.draws, config.draws)


def encoder_positions(
    key: Array, model: ProbNeRF, picture: Picture, yaws: int, draws: int, spread: float
) -> Float[Array, "yaws_draws d"]:
    """Positions with z = mean + spread N(0, 1 / precision) of the encoder at evenly spaced yaws, `draws` at each."""
    noise = jax.random.normal(key, (yaws, draws, model.latent))
    return _encoder_positions(model, picture, noise, spread)


@jax.jit
def _encoder_positions(
    model: ProbNeRF, picture: Picture, noise: Float[Array, "y j k"], spread: float
) -> Float[Array, "y_j d"]:
    yaws = jnp.arange(noise.shape[0]) * (2.0 * jnp.pi / noise.shape[0]) - jnp.pi
    zero = jnp.zeros(())

    def at(yaw: Array, noise: Array) -> Array:
        mean, precision = potential_at(model, picture, Pose(yaw, zero, zero, zero, zero), 1.0)
        z = mean + spread * noise / jnp.sqrt(precision)
        z_tilde = jax.vmap(lambda one: model.flow.inverse(one)[0])(z)
        pose = jnp.zeros((len(noise), POSE_SIZE)).at[:, 0].set(jnp.cos(yaw)).at[:, 1].set(jnp.sin(yaw))
        return jnp.concatenate([z_tilde, pose], axis=-1)

    return jax.vmap(at)(yaws, noise).reshape(-1, noise.shape[-1] + POSE_SIZE)
