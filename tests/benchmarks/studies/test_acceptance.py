"""Renderers that HMC is tried with: quadrature is the integral that it stands for, and steps cost acceptance."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.measures.renderer_acceptance import (
    RENDERERS,
    SAMPLES,
    acceptance,
    importance_colours,
    integrated,
    quadrature_colours,
    weights_at,
)
from benchmarks.studies.acceptance import FAR, NEAR, SPAN, STEPS, view_rays
from probnerf.prior.checkpoint import load_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.priors import TABLETOP


@pytest.fixture(scope="module")
def seen():
    model = ProbNeRF(PRESETS["tiny"], jax.random.key(0))
    return model, model.decode(jnp.zeros(model.latent)), view_rays(0, 4)


def test_rays_look_at_the_cube() -> None:
    rays = view_rays(3, 200)
    np.testing.assert_allclose(np.linalg.norm(rays.origin, axis=1), 4.0, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=1), 1.0, rtol=1e-5)
    nearest = -np.sum(np.asarray(rays.origin) * np.asarray(rays.direction), axis=1)
    assert NEAR < nearest.min() and nearest.max() < FAR


def test_quadrature_conserves_light_and_nears_its_limit(seen) -> None:
    model, weights, rays = seen

    def at(samples: int):
        t = jnp.broadcast_to(NEAR + (jnp.arange(samples) + 0.5) * (FAR - NEAR) / samples, (4, samples))
        w, colour = jax.jit(partial(integrated, span=SPAN))(model, weights, rays, t)
        return np.asarray(jnp.einsum("nm,nmc->nc", w, colour) + 1.0 - w.sum(axis=-1, keepdims=True)), np.asarray(w)

    fine, weight = at(2048)
    assert weight.min() >= 0.0 and weight.sum(axis=-1).max() <= 1.0 + 1e-5
    rough = np.asarray(jax.jit(partial(quadrature_colours, span=SPAN))(model, weights, rays))
    np.testing.assert_allclose(rough, at(SAMPLES)[0], atol=1e-5)
    assert np.abs(at(384)[0] - fine).max() < np.abs(rough - fine).max() + 1e-6
    np.testing.assert_allclose(rough, fine, atol=0.1)
    np.testing.assert_allclose(jax.jit(partial(importance_colours, span=SPAN))(model, weights, rays), fine, atol=0.1)


def test_a_position_may_have_delta(seen) -> None:
    model, weights, _ = seen
    size = weights.size
    plain = weights_at(model, jnp.zeros(model.latent))
    np.testing.assert_array_equal(plain, weights_at(model, jnp.zeros(model.latent + size)))
    moved = weights_at(model, jnp.concatenate([jnp.zeros(model.latent), jnp.ones(size)]))
    np.testing.assert_allclose(moved - plain, 0.025, atol=1e-6)


@pytest.mark.nightly
def test_acceptance_falls_with_the_step_for_every_renderer() -> None:
    model = load_prior(TABLETOP).model
    z_tilde, rays = jax.random.normal(jax.random.key(5), (model.latent,)), view_rays(5, 48)
    for name in RENDERERS:
        small, middle, large = (
            float(np.mean(acceptance(jax.random.key(0), model, rays, z_tilde, jnp.float32(step), name, 4, SPAN)))
            for step in (STEPS[0], STEPS[3], STEPS[-1])
        )
        assert small > 0.9 and small > middle > large and large < 0.1
