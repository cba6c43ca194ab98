"""The diffusion model's samples are distributed as what it learnt from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.rivals.diffusion import Diffusion
from benchmarks.rivals.recipe import descend, optimiser, rate


@pytest.mark.nightly
def test_samples_have_the_learnt_moments():
    """Of two modes of three correlated coordinates, which are standardised."""

    def draw(key):
        k0, k1 = jax.random.split(key)
        side = jax.random.rademacher(k0, (256, 1)) * 0.8
        noise = jax.random.normal(k1, (256, 2)) * 0.6
        return jnp.concatenate([side + noise[:, :1], -side + noise[:, :1], noise[:, 1:] / 0.6], axis=1)

    def step(i, carry):
        model, state = carry
        k0, k1 = jax.random.split(jax.random.key(i))
        gradient = jax.grad(Diffusion.loss)(model, draw(k0), k1)
        return descend(model, gradient, state, rate(i / 1500, 3e-3))

    model = Diffusion(3, 32, 2, jax.random.key(0))
    model, _ = jax.jit(lambda *carry: jax.lax.fori_loop(0, 1500, step, carry))(model, optimiser().init(model))
    found = np.asarray(jax.jit(Diffusion.sample, static_argnums=2)(model, jax.random.key(1), 2000))
    expected = np.concatenate([np.asarray(draw(jax.random.key(-i))) for i in range(1, 9)])
    np.testing.assert_allclose(np.cov(found.T), np.cov(expected.T), atol=0.12)
    np.testing.assert_allclose(np.mean(found, axis=0), 0.0, atol=0.1)
    np.testing.assert_allclose(np.mean(np.abs(found[:, 0] - found[:, 1])), 1.6, atol=0.12)
