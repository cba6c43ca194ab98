"""Where inference begins if the prior has a posterior network: at the network's draws, with a share of the prior.

It replaces the encoder's guesses, the climbs from them, and the start from the prior, for every view: however much of
the object is hidden, with and without depth, and if the pose is known.
"""

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.compile_cache import program
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import Prior
from probnerf.prior.posterior_flow import PictureDensity, PictureFeatures, PosteriorNetwork
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.sampling.defensive_mixture import DefensiveMixture
from probnerf.sampling.importance import WeighedDraws, weigh
from probnerf.sampling.populations import from_draws
from probnerf.settings import InferConfig, NetworkConfig
from probnerf.types import Observation, Posterior, on_device

_GROUPS = 8  # of draws, as populations of the first answer


def network_used(config: InferConfig, prior: Prior) -> PosteriorNetwork | None:
    """The prior's posterior network, if it has one and inference begins at its draws.

    The network knows nothing of delta, and annealed HMC has no reference to begin from.
    """
    usable = config.network_starts and config.method == "tempered_smc" and not config.sample_delta
    return prior.network if usable else None


def picture_density(
    network: PosteriorNetwork, picture: EncoderPicture, observation: Observation, sample_pose: bool
) -> PictureDensity:
    """The network's density for a view. `picture` has the network's size."""
    return PictureDensity(network, _features(network, picture, observation.pose_sigma, known=not sample_pose))


def defensive(density: PictureDensity, config: NetworkConfig) -> DefensiveMixture:
    """The reference of weighed draws and of tempering."""
    return DefensiveMixture(density, on_device(config.prior_share))


def network_guess(key: PRNGKeyArray, density: PictureDensity, count: int) -> Posterior:
    """The network's answer without any likelihood: `count` independent draws with equal weights, at beta = 0."""
    positions, log_density = _drawn(key, density, count=count)
    even = np.full(count, -np.log(count))
    return from_draws(positions, even, log_density=np.asarray(log_density), groups=min(_GROUPS, count))


def weigh_draws(
    key: PRNGKeyArray,
    prior: Prior,
    likelihood: Likelihood,
    observation: Observation,
    mixture: DefensiveMixture,
    config: NetworkConfig,
    deadline: float | None = None,
) -> WeighedDraws:
    """Draws of the mixture with importance weights for a view's posterior (`importance.weigh`)."""
    args = (prior.model, likelihood, observation, faces_of_view(observation, likelihood))
    return weigh(key, log_likelihood, args, mixture, config, deadline)


@program("known")
def _features(
    network: PosteriorNetwork, picture: EncoderPicture, pose_sigma: Float[Array, "5"], *, known: bool
) -> PictureFeatures:
    return network.features(picture, pose_sigma, known)


@program("count")
def _drawn(key: PRNGKeyArray, density: PictureDensity, *, count: int) -> tuple[Array, Array]:
    return density.network.draw_with_density(key, density.features, count)
