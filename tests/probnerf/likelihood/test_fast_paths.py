"""What is computed cheaply says what the plain computation says: packed crossings, mapped and shared-out particles."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.likelihood.dispatch import log_likelihood, map_with_gradient
from probnerf.likelihood.pixel_terms import faces_of_view, log_likelihood_one
from probnerf.objects.cylinder_scenes import scene
from probnerf.pixel_status import FREE
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering.foam import FAR


@pytest.mark.parametrize("condition", ["half", pytest.param("seen", marks=pytest.mark.slow)])
def test_only_the_crossings_that_tell_are_evaluated_and_the_value_is_the_plain_one(condition):
    """Limits drop crossings that the terms never read, and packing drops padding: values and gradients stay."""
    _, plain, observation, every = scene(condition, depth=True)
    ends = jnp.where(observation.status == FREE, jnp.linspace(2.5, 3.7, observation.status.size), observation.limit)
    observation = replace(observation, limit=ends)
    told = faces_of_view(observation, plain)
    count, colour = (int(np.sum(np.asarray(t) < FAR)) for t in (told, told[: observation.colour_count]))
    assert count < 0.9 * np.sum(np.asarray(every) < FAR)
    model = eqx.filter_jit(lambda: ProbNeRF(PRESETS["tiny"], jax.random.key(0)))()
    q = jax.random.normal(jax.random.key(1), (model.latent + 7,))

    def both(likelihood, t):
        return eqx.filter_jit(jax.value_and_grad(lambda v: log_likelihood_one(model, likelihood, observation, t, v)))(q)

    value, gradient = both(plain, every)
    for packed in ((0, 0), (colour, count), (colour + 37, count + 100)):
        found, slope = both(replace(plain, packed=packed), told)
        assert float(found) == pytest.approx(float(value), rel=1e-5)
        np.testing.assert_allclose(slope, gradient, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("batch_size", [None, 3])
def test_mapping_with_the_gradient_is_mapping_and_its_gradient(batch_size):
    args = scene("half", depth=True)
    positions = jax.random.normal(jax.random.key(0), (8, 9))
    shift = jnp.linspace(-0.2, 0.2, 8)
    cotangent = jnp.linspace(-1.0, 2.0, 8)

    def one(shared, each, q):
        model, likelihood, observation, t = shared
        return log_likelihood_one(model, likelihood, observation, t, q + each)

    def plain(q, shift):
        return jax.vmap(lambda e, v: one(args, e, v))(shift, q)

    value, pullback = jax.vjp(jax.jit(lambda q: map_with_gradient(one, batch_size, args, shift, q)), positions)
    expected, expected_pullback = jax.vjp(jax.jit(lambda q: plain(q, shift)), positions)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    (gradient,), (expected_gradient,) = pullback(cotangent), expected_pullback(cotangent)
    np.testing.assert_allclose(gradient, expected_gradient, rtol=1e-3, atol=1e-3 * np.abs(expected_gradient).max())
    alone = jax.jit(log_likelihood)(args, positions)
    np.testing.assert_allclose(alone, jax.jit(plain)(positions, jnp.zeros(8)), rtol=1e-5)


@pytest.mark.slow
def test_particles_shared_out_over_devices_have_the_same_likelihood():
    """Four particles on two CPU devices (of a process of its own) against one device."""
    code = """
import jax, numpy as np
from probnerf.objects.cylinder_scenes import scene
from probnerf.likelihood.dispatch import log_likelihood
q = jax.random.normal(jax.random.key(0), (4, 9))
args = scene("seen", depth=True)
both = jax.jit(lambda a, q: jax.value_and_grad(lambda q: log_likelihood(a, q).sum())(q))
print(len(jax.devices()), *np.concatenate([np.ravel(x) for x in both(args, q)]))
"""
    found = []
    for devices in ("1", "2"):
        environment = {**os.environ, "JAX_NUM_CPU_DEVICES": devices}
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        count, *numbers = run.stdout.split()
        assert count == devices
        found.append(np.array(numbers, float))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4, atol=1e-3)


def test_the_compiler_reduces_products_rightly():
    """Not so in jaxlib 0.10.2 on CPUs (jax-ml/jax#39103): silently wrong from some size on, hence excluded."""
    jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True})
    rng = np.random.default_rng(0)
    scale, x = rng.random((3, 12, 55)), rng.normal(size=(1536, 12, 55))
    found = jit(lambda p, x: jax.vmap(lambda x: jnp.max(-jnp.sum(p * x**2, -1)))(x))(
        scale.astype(np.float32), x.astype(np.float32)
    )
    expected = np.max(-np.einsum("pmd,nmd->npm", scale, x**2), axis=(1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    matrix = rng.normal(size=(12, 55, 55))
    image = np.einsum("mij,nmj->nmi", matrix, x)
    found = jit(jax.vmap(lambda x: jnp.max(-jnp.sum(jnp.einsum("mij,mj->mi", matrix.astype(np.float32), x) ** 2, -1))))(
        x.astype(np.float32)
    )
    np.testing.assert_allclose(found, np.max(-np.sum(image**2, -1), axis=1), rtol=1e-4)
