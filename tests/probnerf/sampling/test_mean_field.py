"""Mean-field VI: the known answer on a Gaussian, no noise at the optimum, and a better ELBO on a picture."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.likelihood.dispatch import log_likelihood
from probnerf.objects.cylinder_scenes import scene
from probnerf.sampling.mean_field import Gaussian, VIConfig, elbo_terms, mean_field

KEY = jax.random.key(0)
K = jnp.array([[9.0, 7.0, 0.0], [7.0, 9.0, 0.0], [0.0, 0.0, 3.0]])  # the likelihood's precision,
PEAK = jnp.array([1.0, -0.5, 2.0])  # and its top


def _gaussian(args, q):
    precision, peak = args
    return -0.5 * jnp.einsum("pi,ij,pj->p", q - peak, precision, q - peak)


def _optimum(precision) -> Gaussian:
    """Of N(0, I) exp(l): the true mean, and variances 1 / precision_ii."""
    posterior = jnp.eye(3) + precision
    return Gaussian(jnp.linalg.solve(posterior, precision @ PEAK), -0.5 * jnp.log(jnp.diag(posterior)))


def test_a_correlated_gaussian_gets_its_mean_and_too_small_variances():
    q, elbo = mean_field(KEY, _gaussian, (K, PEAK), jnp.zeros(3), VIConfig(steps=1200))
    best = _optimum(K)
    np.testing.assert_allclose(q.mean, best.mean, atol=0.01)
    np.testing.assert_allclose(q.log_std, best.log_std, atol=0.02)
    true_variance = np.diag(np.linalg.inv(np.eye(3) + K))
    assert (np.exp(2 * q.log_std[:2]) < 0.6 * true_variance[:2]).all()
    assert elbo.shape == (1200,) and np.mean(elbo[-100:]) > np.mean(elbo[:100])


def test_the_gradient_has_no_noise_at_the_optimum():
    """Where q is the posterior every draw gives the same ELBO, the log evidence, and gradient 0."""
    precision = jnp.diag(jnp.array([9.0, 4.0, 0.5]))
    noise = jax.random.normal(KEY, (64, 3))

    def gradients(q):
        return jax.vmap(lambda e: jax.grad(lambda q: elbo_terms(q, _gaussian, (precision, PEAK), e[None])[0])(q))(noise)

    best = _optimum(precision)
    for leaf in jax.tree.leaves(gradients(best)):
        np.testing.assert_allclose(leaf, 0.0, atol=1e-4)
    elsewhere = gradients(Gaussian(best.mean, best.log_std - 0.5))
    assert float(jnp.std(elsewhere.mean)) > 0.1
    values = elbo_terms(best, _gaussian, (precision, PEAK), noise)
    a = jnp.diag(precision)
    log_evidence = float(jnp.sum(-0.5 * jnp.log1p(a) - 0.5 * a / (1 + a) * PEAK**2))
    np.testing.assert_allclose(values, log_evidence, atol=1e-4)


@pytest.mark.slow
def test_the_elbo_of_a_picture_rises():
    args = scene("seen", True, columns=6, rows=4, cubes=8)
    start = jnp.array([0.0, 0.0, 0.5, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0])
    q, elbo = mean_field(KEY, log_likelihood, args, start, VIConfig(steps=150, learning_rate=0.05))
    assert np.isfinite(elbo).all()
    assert np.mean(elbo[-20:]) > np.mean(elbo[:20]) + 1.0
    # nothing says of x, y and log-scale: their prior widths are 0 there
    np.testing.assert_allclose(q.mean[4:], 0.0, atol=0.2)
    assert (np.asarray(q.log_std[4:]) > np.log(0.1) + 1.0).all()
