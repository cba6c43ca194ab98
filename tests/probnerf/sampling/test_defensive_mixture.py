"""A density inside the prior: bounded weights, exact draws, finite slopes, and tempering that begins there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.prior.posterior_flow import PictureDensity
from probnerf.sampling.defensive_mixture import DefensiveMixture
from probnerf.sampling.populations import log_prior
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import TemperedSMCConfig
from tests.probnerf.prior.small_networks import SIGMA, SIZES, picture, shaken

DIM = SIZES.latent + 7
SHARE = 0.2

_over = eqx.filter_jit(lambda m, x: m.over_prior(x))
_slope = eqx.filter_jit(lambda m, x: jax.grad(lambda x: jnp.sum(m.over_prior(x)))(x))


@pytest.fixture(scope="module")
def mixture() -> DefensiveMixture:
    @eqx.filter_jit
    def build(network):
        features = network.features(picture(), jnp.asarray(SIGMA))
        return DefensiveMixture(PictureDensity(network, features), jnp.asarray(SHARE))

    return build(shaken())


def test_no_weight_exceeds_one_over_the_prior_s_share(mixture: DefensiveMixture):
    x = 5.0 * jax.random.normal(jax.random.key(0), (2_000, DIM))
    over = np.asarray(_over(mixture, x))
    assert np.isfinite(over).all() and over.min() >= np.log(SHARE) - 1e-6 and over.min() < np.log(SHARE) + 1e-3


def test_its_draws_follow_its_density(mixture: DefensiveMixture):
    x = eqx.filter_jit(lambda m: m.draw(jax.random.key(1), 20_000))(mixture)
    weight = np.exp(-np.asarray(_over(mixture, x), np.float64))  # of the prior: bounded, so its mean is reliable
    assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(len(weight))
    second = (weight[:, None] * np.asarray(x) ** 2).mean(axis=0)
    np.testing.assert_allclose(second, 1.0, atol=0.15)


@pytest.mark.slow
def test_slopes_are_finite_everywhere_and_are_the_differences(mixture: DefensiveMixture):
    x = np.array(jax.random.normal(jax.random.key(2), (6, DIM)))
    difference = np.zeros_like(x)
    for i in range(DIM):
        step = 1e-2 * np.eye(DIM)[i]
        difference[:, i] = (np.asarray(_over(mixture, x + step)) - np.asarray(_over(mixture, x - step))) / 2e-2
    np.testing.assert_allclose(_slope(mixture, x), difference, atol=0.05)
    x[0, SIZES.latent : SIZES.latent + 2] = 0.0  # no yaw
    x[1, SIZES.latent : SIZES.latent + 2] = 1e-5, -1e-5
    x[2] *= 100.0
    assert np.isfinite(_slope(mixture, x)).all()
    np.testing.assert_allclose(mixture.log_density(x[3:]), _over(mixture, x[3:]) + log_prior(x[3:]), rtol=1e-5)


def _gaussian(centre: jax.Array, q: jax.Array) -> jax.Array:
    return -0.5 * jnp.sum((q - centre) ** 2, axis=-1) / 0.25


@pytest.mark.slow
def test_tempering_begins_there(mixture: DefensiveMixture):
    """The evidence and the mean of a Gaussian likelihood, from a reference that knows nothing of it."""
    centre = jnp.linspace(-1.0, 1.0, DIM)
    config = TemperedSMCConfig(populations=4, particles=64, start_particles=256, evidence_power=0.0)
    posterior = tempered_smc(jax.random.key(3), _gaussian, centre, DIM, config, reference=mixture)
    exact = DIM * 0.5 * np.log(0.25 / 1.25) - 0.5 * float(jnp.sum(centre**2)) / 1.25
    assert posterior.result == "converged"
    assert abs(float(posterior.log_evidence) - exact) < 0.3
    mean = np.exp(np.asarray(posterior.log_weights)) @ np.asarray(posterior.positions)
    np.testing.assert_allclose(mean, np.asarray(centre) / 1.25, atol=0.1)
