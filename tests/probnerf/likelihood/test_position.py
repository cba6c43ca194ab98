"""Where place and size get their tails: a change of variables that is smooth, invertible and of a known determinant."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.likelihood.position import STRAIGHT, log_stretch, pose_of, stretched, unstretched
from probnerf.prior.posterior_flow import PictureDensity
from probnerf.settings import NO_TAILS, InferConfig
from tests.probnerf.prior.small_networks import SIGMA, picture, shaken

TAILS = InferConfig().pose_tails
LATENTS = jnp.tile(jnp.linspace(-8.0, 8.0, 4001)[:, None], 3)


def test_stretched_normals_come_back() -> None:
    for tails in (TAILS, NO_TAILS):
        there = stretched(LATENTS, tails)
        assert np.all(np.diff(np.asarray(there), axis=0) > 0.0)
        np.testing.assert_allclose(unstretched(there, tails), LATENTS, atol=1e-4)
    np.testing.assert_allclose(stretched(LATENTS, NO_TAILS), LATENTS, rtol=1e-4)
    assert np.all(np.isfinite(stretched(jnp.full(3, 1e4), TAILS)))


def test_small_errors_are_a_width_and_large_ones_many() -> None:
    """The third is log-scale, where an object is far more often larger than it seems than smaller."""
    np.testing.assert_allclose(stretched(jnp.full(3, 0.3), TAILS), 0.3, rtol=0.03)
    above, below = stretched(jnp.full(3, STRAIGHT), TAILS), -stretched(jnp.full(3, -STRAIGHT), TAILS)
    assert above[2] > 2.5 * STRAIGHT > 2.0 * below[2]


def test_the_determinant_is_the_slope() -> None:
    slope = jax.vmap(jax.jacobian(lambda u: stretched(u, TAILS)))(LATENTS[::97])
    _, expected = np.linalg.slogdet(np.asarray(slope, np.float64))
    np.testing.assert_allclose(log_stretch(LATENTS[::97], TAILS), expected, atol=2e-5)


def test_stretched_normals_have_the_density_that_the_determinant_tells() -> None:
    """Of log-scales beyond three widths: the share that is drawn is the integral of the density."""
    drawn = stretched(jax.random.normal(jax.random.key(0), (200_000, 3)), TAILS)[:, 2]
    widths = jnp.linspace(3.0, 40.0, 20_001)
    latent = unstretched(jnp.zeros((widths.size, 3)).at[:, 2].set(widths), TAILS)
    density = jnp.exp(-0.5 * latent[:, 2] ** 2 - log_stretch(latent, TAILS)) / np.sqrt(2 * np.pi)
    share = np.trapezoid(np.asarray(density), np.asarray(widths))
    assert float(jnp.mean(drawn > 3.0)) == pytest.approx(share, abs=0.002) and share > 0.03


def test_a_pose_has_tails_in_place_and_size_alone() -> None:
    latent, sigma = jnp.array([0.3, 1.0, 2.0, -2.0, 2.0, 0.5, 2.0]), jnp.array([0.1, 0.2, 0.3, 0.0, 0.4])
    plain, tailed = pose_of(latent, sigma), pose_of(latent, sigma, TAILS)
    assert (plain.yaw, plain.z) == (tailed.yaw, tailed.z)
    wide = stretched(latent[2:5], TAILS)
    np.testing.assert_allclose([tailed.x, tailed.y, tailed.log_scale], wide * sigma[:3], rtol=1e-6)
    assert tailed.x > plain.x and tailed.y < plain.y and tailed.log_scale > plain.log_scale


@pytest.mark.parametrize("known", [False, True], ids=["pose unknown", "pose known"])
def test_a_picture_s_density_over_positions_is_the_network_s_over_widths(known: bool) -> None:
    """It integrates to one (E_p[q / p] = 1 for draws of a wide Gaussian p), and draws bring their densities."""
    network = shaken()
    density = PictureDensity(network, network.features(picture(), jnp.asarray(SIGMA), known), TAILS)
    wide = 1.4 * jax.random.normal(jax.random.key(3), (20_000, network.sizes.latent + 7 * (not known)))
    log_p = np.sum(-0.5 * (np.asarray(wide) / 1.4) ** 2 - np.log(1.4) - 0.5 * np.log(2 * np.pi), axis=-1)
    ratio = np.exp(np.asarray(density.log_density(wide), np.float64) - log_p)
    error = ratio.std() / np.sqrt(len(ratio))
    assert error < 0.1 and abs(ratio.mean() - 1.0) < 4 * error
    drawn, told = density.draw_with_density(jax.random.key(4), 500)
    np.testing.assert_allclose(density.log_density(drawn), told, atol=5e-3)
    np.testing.assert_array_equal(density.draw(jax.random.key(4), 500), drawn)
