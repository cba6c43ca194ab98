"""From an Observation to a Posterior: the model, the pixel likelihood and a sampler (unit cube only)."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Array

from probnerf.compile_cache import program
from probnerf.fields.base import Model
from probnerf.kernel import library
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.networks import ProbNeRF
from probnerf.prior.posterior_network import EncoderPicture, encoder_positions, even_yaws, guesses
from probnerf.rendering import foam
from probnerf.sampling.annealed_hmc import annealed_hmc
from probnerf.sampling.defensive_mixture import DefensiveMixture
from probnerf.sampling.gaussian_mixture import GaussianMixture
from probnerf.sampling.hmc import Reference, StageInfo
from probnerf.sampling.modes import mixture_of_modes
from probnerf.sampling.populations import from_draws, start_from, with_log_likelihoods
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import InferConfig, TemperedSMCConfig
from probnerf.types import Observation, Posterior

_log_likelihood = program()(log_likelihood)


def suited(config: InferConfig, model: Model) -> InferConfig:
    """The settings with at least the wall error that the model's preset has."""
    least = model.preset.wall_sigma if isinstance(model, ProbNeRF) else 0.0
    return replace(config, wall_sigma=max(config.wall_sigma, least))


def likelihood_settings(config: InferConfig, sample_pose: bool = True) -> Likelihood:
    """The likelihood's settings for any view."""
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
    """The likelihood's settings for one view, with its sizes if there is no kernel (`with_sizes`)."""
    likelihood = likelihood_settings(config, sample_pose)
    return likelihood if library.available() else with_sizes(likelihood, observation)


def with_sizes(likelihood: Likelihood, observation: Observation) -> Likelihood:
    """The settings with one view's number of crossings, for packing in plain JAX.

    The numbers are padded, so that most views share one compiled program.
    """
    lattice = likelihood.lattice
    each = np.sum(np.asarray(faces_of_view(observation, likelihood)) < foam.FAR, axis=-1)

    def padded(count: int, step: int) -> int:
        return step * max(1, math.ceil(count / step))

    most = min(padded(each.max(), 64), 3 * lattice.planes)
    colour = each[..., : observation.colour_count]
    packed = (padded(colour.sum(axis=-1).max(), 512), padded(each.sum(axis=-1).max(), 1024))
    return replace(likelihood, lattice=replace(lattice, max_crossings=most), packed=packed)


def crossings_of(likelihood: Likelihood, observation: Observation) -> float:
    """Number of crossings of a view, at which the field is evaluated for each particle, on average."""
    return float(np.sum(np.asarray(faces_of_view(observation, likelihood)) < foam.FAR)) / observation.choices


def without_sizes(likelihood: Likelihood) -> Likelihood:
    """The settings without the padded sizes of one view. So evaluations of shapes compile once for all views."""
    lattice = likelihood.lattice
    return replace(likelihood, lattice=replace(lattice, max_crossings=3 * lattice.planes), packed=(0, 0))


def asks_encoder(config: InferConfig, model: Model, picture: EncoderPicture | None) -> bool:
    """Whether to use the encoder: there is one, it sees enough of the object, and its guess is needed."""
    # delta has too many dimensions for second derivatives
    if picture is None or not config.encoder_starts or config.sample_delta or not isinstance(model, ProbNeRF):
        return False
    return float(np.mean(np.asarray(picture.unknown))) <= config.modes.unknown


def modes_of(
    key: Array, model: Model, observation: Observation, config: InferConfig, picture: EncoderPicture | None
) -> GaussianMixture | None:
    """The reference for tempering: modes that ascents from the encoder's guesses reach (`sampling.modes`).

    The pose is unknown. The result is None (the prior) if there is no encoder or if it sees too little. If half of the
    object is hidden, its guesses are poor. The modes found from them then miss shapes that populations from the prior
    find.
    """
    if not asks_encoder(config, model, picture):
        return None
    assert isinstance(model, ProbNeRF) and picture is not None
    likelihood = likelihood_of(config, observation)
    starts = guesses(key, model, picture, config.modes.starts)
    args = _args(model, likelihood, observation)
    return mixture_of_modes(args, starts, config.modes)


def sampler_of(config: InferConfig, reference: Reference | None, before: Posterior | None = None) -> TemperedSMCConfig:
    """The SMC settings for a given reference. A run that continues `before` keeps the settings that produced it."""
    if before is None:
        if isinstance(reference, DefensiveMixture):
            return config.smc_from_network
        return config.smc_from_prior if reference is None else config.smc
    made = len(before.diagnostics.beta)
    every = (config.smc, config.smc_from_prior, config.smc_from_network)
    fit = [smc for smc in every if made % smc.populations == 0]
    each = len(before.positions) / made  # several settings may divide the number of populations
    return min(fit, key=lambda smc: abs(each - smc.moves * smc.particles), default=config.smc_from_prior)


def infer(
    key: Array,
    model: Model,
    observation: Observation,
    config: InferConfig | None = None,
    *,
    reference: Reference | None = None,
    before: Posterior | None = None,
    sample_pose: bool = True,
    on_stage: Callable[[StageInfo], bool | None] | None = None,
    deadline: float | None = None,
    stages: int | None = None,
) -> tuple[Posterior, Likelihood]:
    """Sample p(z~, pose, delta | observation).

    Where the observation has several choices of pixels, every population or chain is given one of them, in turn. All
    together then are draws of the bagged posterior (Huggins and Miller 2023, arXiv 2007.14845): the posterior's mean
    over which pixels are compared. Where the model is wrong, one choice's posterior is certain of what another denies.
    Evidences are each of its own pixels. The log-likelihoods of the samples are means over all choices.

    `reference` is the density at which tempering starts: of `modes_of` or `network_start.defensive` (None: the prior).
    `before` replaces it: an unfinished posterior of the same latents, from which to continue. `deadline` is on
    time.monotonic()'s clock.
    `stages` limits the sampler's stages. For annealed HMC it limits the iterations, and the schedule is shortened to
    fit. The start is always made.
    """
    config = config or InferConfig()
    likelihood = likelihood_of(config, observation, sample_pose)
    dim = likelihood.dim(model)
    if config.method == "annealed_hmc":
        hmc = (
            config.hmc if stages is None else replace(config.hmc, iterations=stages, keep=min(config.hmc.keep, stages))
        )
        args = _args(model, likelihood, _dealt(observation, hmc.chains))
        posterior = annealed_hmc(key, log_likelihood, args, dim, hmc, on_stage=on_stage, deadline=deadline)
    else:
        smc = sampler_of(config, reference, before)
        args = _args(model, likelihood, _dealt(observation, smc.populations))
        initial = None if before is None else start_from(before, smc.populations)
        posterior = tempered_smc(
            key, log_likelihood, args, dim, smc, initial=initial, reference=reference if before is None else None,
            on_stage=on_stage, deadline=deadline, stages=stages,
        )  # fmt: skip
    return _compared(posterior, model, likelihood, observation), likelihood


def _args(model: Model, likelihood: Likelihood, observation: Observation) -> tuple[Any, ...]:
    return model, likelihood, observation, faces_of_view(observation, likelihood)


def _dealt(observation: Observation, groups: int) -> Observation:
    """One of its choices of pixels for each of so many groups of positions, in turn."""
    return observation if observation.choices == 1 else observation.chosen(np.arange(groups) % observation.choices)


def _compared(posterior: Posterior, model: Model, likelihood: Likelihood, observation: Observation) -> Posterior:
    """The posterior with log-likelihoods that are comparable: the mean over all choices of pixels."""
    if observation.choices == 1:
        return posterior
    each = [_args(model, likelihood, observation.chosen(k)) for k in range(observation.choices)]
    every = [np.asarray(_log_likelihood(args, posterior.positions)) for args in each]
    return with_log_likelihoods(posterior, np.mean(every, axis=0))


def encoder_guess(
    key: Array,
    model: ProbNeRF,
    likelihood: Likelihood,
    observation: Observation,
    picture: EncoderPicture,
    yaws: int = 24,
    draws: int = 4,
) -> Posterior:
    """The encoder's estimate without sampling, in about 0.05 s: z_kj ~ q(z | picture, yaw_k) on a grid of yaws.

    The weight of yaw k is its mean likelihood, W_k = sum_j p(observation | z_kj, yaw_k) / J. Its J draws share it
    equally: within a yaw, the encoder's density is used without correction. x, y and scale are perception's guess. If
    the pose is known, all draws are at that one yaw.
    """
    if likelihood.sample_pose:
        positions = encoder_positions(key, model, picture, even_yaws(yaws), draws, 1.0)
    else:
        yaws, draws = 1, yaws * draws
        positions = guesses(key, model, picture, draws, sample_pose=False)
    args = _args(model, likelihood, observation)
    values = np.asarray(_log_likelihood(args, positions), np.float64)
    values = np.where(np.isfinite(values), values, -np.inf)
    top = values.max()
    each = np.exp(values - top).reshape(yaws, draws).mean(axis=1) if np.isfinite(top) else np.ones(yaws)
    with np.errstate(divide="ignore"):
        log_weights = np.log(np.repeat(each / each.sum() / draws, draws))
    return from_draws(positions, log_weights, values)
