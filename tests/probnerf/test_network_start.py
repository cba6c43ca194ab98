"""Inference that begins at a posterior network: its guess, when it is used, and that the answer is the posterior's."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from probnerf.inference import sampler_of
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.network_start import defensive, network_guess, network_used, picture_density
from probnerf.objects.cylinder_scenes import integrate, scene, total_variation, yaw_histogram
from probnerf.prior.checkpoint import Prior
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import InferConfig, NetworkConfig, TemperedSMCConfig, quick_smc
from tests.probnerf.prior.small_networks import SIZES, picture, shaken

CYLINDER = replace(SIZES, latent=2)
NETWORK = shaken(CYLINDER)


@pytest.mark.parametrize("sample_pose", [True, False])
def test_a_guess_is_equal_draws_whose_density_is_known_and_nothing_else(sample_pose: bool) -> None:
    density = picture_density(NETWORK, picture(), scene("seen", True)[2], sample_pose)
    guess = network_guess(jax.random.key(0), density, 128)
    assert guess.positions.shape == (128, CYLINDER.latent + 7 * sample_pose)
    np.testing.assert_allclose(np.exp(np.asarray(guess.log_weights)), 1 / 128, rtol=1e-5)
    np.testing.assert_allclose(guess.log_density, density.log_density(guess.positions), atol=2e-4)
    assert np.isnan(guess.log_likelihoods).all() and np.isnan(guess.log_evidence)
    assert np.all(np.asarray(guess.diagnostics.beta) == 0.0) and guess.result == "underway"
    np.testing.assert_array_equal(np.bincount(guess.population), 16)  # their spread is the Monte Carlo error


def test_the_network_is_used_by_tempering_unless_it_is_told_otherwise() -> None:
    config, model = InferConfig(smc_from_network=quick_smc(3, 4)), None
    without, prior = Prior(model, {}, "x"), Prior(model, {}, "x", NETWORK)
    assert network_used(config, prior) is NETWORK and network_used(config, without) is None
    for other in ({"network_starts": False}, {"sample_delta": True}, {"method": "annealed_hmc"}):
        assert network_used(replace(config, **other), prior) is None
    density = picture_density(NETWORK, picture(), scene("seen", True)[2], True)
    assert sampler_of(config, defensive(density, config.network)) is config.smc_from_network


@pytest.mark.slow
@pytest.mark.parametrize(("condition", "depth"), [("hidden", True), ("half", False)])
def test_tempering_from_a_network_that_knows_nothing_is_the_posterior_by_brute_force(condition, depth) -> None:
    args = scene(condition, depth)
    grid = integrate(log_likelihood, args)
    reference = defensive(picture_density(NETWORK, picture(), args[2], True), NetworkConfig())
    histograms = []
    for seed in (0, 1):
        posterior = tempered_smc(
            jax.random.key(seed), log_likelihood, args, 9, TemperedSMCConfig(populations=4), reference=reference
        )
        assert posterior.result == "converged"
        assert abs(float(posterior.log_evidence) - grid.log_evidence) <= max(0.5, 3 * float(posterior.log_evidence_se))
        q, w = np.asarray(posterior.positions, np.float64), np.exp(np.asarray(posterior.log_weights))
        histograms.append(yaw_histogram(np.arctan2(q[:, 3], q[:, 2]), w))
    assert np.mean([total_variation(h, grid.histogram()) for h in histograms]) <= 0.1
