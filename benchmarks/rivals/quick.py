"""Answers to one view by the posterior and its quick rivals: the prior alone, the encoder alone, one MAP shape.

Of a prior with a posterior network, *encoder alone* is the network alone, and the MAP climbs from its draws.
"""

import time
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.harness.results import refuse_cut
from benchmarks.measures.scores import Answer, shapes_at
from benchmarks.scenes.vessels import GRID, VesselView
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.observation.encoder_crop import crop
from perception.observation.object_frame import ObjectFrame
from perception.observation.rays import observe
from perception.observation.segmentation import Segment
from perception.observation.visibility import answered_voxels
from perception.sources.frame import Frame
from probnerf.inference import encoder_guess, likelihood_of
from probnerf.likelihood.settings import Likelihood
from probnerf.network_start import network_guess, picture_density
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import ProbNeRF
from probnerf.prior.posterior_network import EncoderPicture, guesses
from probnerf.rendering.occupancy import coarsen
from probnerf.sampling.map_estimate import MAPConfig, map_estimate
from probnerf.types import Observation

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
    methods: Collection[str] = METHODS,
) -> dict[str, Answer]:
    """The methods' answers to the same observation."""
    result: dict[str, Answer] = {}
    if POSTERIOR in methods:
        known = vessel.cube if vessel.pose_known else None
        found = estimate(
            vessel.frame, vessel.segment, prior, config, seed=seed, known=known, budget_s=budget_s, stages=stages
        )
        h = found.hypotheses
        refuse_cut(h.result)
        result[POSTERIOR] = Answer(coarsen(h.solid, GRID), h.weights, found.seconds, h.result)
    observation, cube = observe(vessel.frame, vessel.segment, config.observe, seed, vessel.cube)
    picture = encoder_picture(vessel, cube, prior)
    likelihood = likelihood_of(config.infer, observation, not vessel.pose_known)
    model, key = prior.model, jax.random.key(seed)
    dim = likelihood.dim(model)
    region = jnp.asarray(answered_voxels(vessel.frame, vessel.segment, cube, config.grid))

    def answer(positions: Array, weights: np.ndarray, begun: float) -> Answer:
        shapes = shapes_at(model, likelihood, positions, observation.pose_sigma, region)
        return Answer(shapes, weights, time.monotonic() - begun)

    if PRIOR in methods:
        begun, count = time.monotonic(), config.hypotheses
        result[PRIOR] = answer(jax.random.normal(key, (count, dim)), np.full(count, 1.0 / count), begun)
    if ENCODER in methods:
        begun = time.monotonic()
        if prior.network is not None:
            drawn = network_draws(key, vessel, prior, observation, cube, config.hypotheses)
            weights = np.full(len(drawn), 1.0 / len(drawn))
        else:
            drawn, weights = encoder_alone(key, model, likelihood, observation, picture, rivals)
        result[ENCODER] = answer(drawn, weights, begun)
    if MAP in methods:
        begun = time.monotonic()
        if prior.network is not None:
            starts = network_draws(key, vessel, prior, observation, cube, rivals.yaws)
        else:
            starts = guesses(key, model, picture, rivals.yaws, likelihood.sample_pose)
        best, _ = map_estimate(model, likelihood, observation, starts, rivals.fit)
        result[MAP] = answer(best[None], np.ones(1), begun)
    return result


def network_draws(
    key: Array, vessel: VesselView, prior: Prior, observation: Observation, cube: ObjectFrame, count: int
) -> Float[Array, "count d"]:
    """Draws of the prior's posterior network."""
    assert prior.network is not None
    picture = crop(vessel.frame, vessel.segment, cube, prior.network.sizes.image_size)
    density = picture_density(prior.network, picture, observation, not vessel.pose_known)
    return network_guess(key, density, count).positions


def encoder_picture(vessel: VesselView, cube: ObjectFrame, prior: Prior) -> EncoderPicture:
    """What the encoder sees; without depth the object is at an unknown range."""
    frame = vessel.frame
    if frame.depth is None:
        frame = replace(frame, depth=np.full(frame.rgb.shape[:2], np.nan, np.float32))
    return crop(frame, vessel.segment, cube, prior.model.preset.image_size)


def warm_up(
    frame: Frame, segment: Segment, prior: Prior, config: ControllerConfig, sizes: set[tuple[int, ...]]
) -> None:
    """Compile what this view needs, once for each of the `sizes` it comes in, so that no budget pays for it."""
    observation, _ = observe(frame, segment, config.observe)
    likelihood = likelihood_of(config.infer, observation)
    size = (likelihood.lattice.crossings, *likelihood.packed)
    if size not in sizes:
        estimate(frame, segment, prior, config, stages=1)
        sizes.add(size)


def encoder_alone(
    key: Array,
    model: ProbNeRF,
    likelihood: Likelihood,
    observation: Observation,
    picture: EncoderPicture,
    config: RivalConfig,
) -> tuple[Float[Array, "s d"], Float[np.ndarray, "s"]]:
    """The encoder's guess: positions and weights."""
    guess = encoder_guess(key, model, likelihood, observation, picture, config.yaws, config.draws)
    return guess.positions, np.exp(np.asarray(guess.log_weights, np.float64))
