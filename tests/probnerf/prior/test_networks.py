"""The learned prior: an invertible flow, a hypernetwork of the right size, an encoder whose precisions add."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.prior.networks import CAMERA_FEATURES, IMAGE_CHANNELS, PRESETS, Encoder, HyperNetwork, ProbNeRF, RealNVP


def _shaken(make: Callable, size: float = 0.2):
    """What `make(key)` makes with every array moved: couplings start at the identity, which would prove nothing."""

    def build(key):
        leaves, tree = jax.tree.flatten(make(key))
        keys = jax.random.split(key, len(leaves))
        moved = [a + size * jax.random.normal(k, a.shape, a.dtype) for a, k in zip(leaves, keys, strict=True)]
        return jax.tree.unflatten(tree, moved)

    return eqx.filter_jit(build)(jax.random.key(1))  # compiled whole: quicker than array by array


_forward = eqx.filter_jit(lambda flow, x: jax.vmap(flow.forward)(x))
_inverse = eqx.filter_jit(lambda flow, x: jax.vmap(flow.inverse)(x))


@pytest.fixture(scope="module", params=[4, 7])
def flow(request) -> RealNVP:
    return _shaken(lambda key: RealNVP(request.param, 16, key))


def _inputs(flow: RealNVP, count: int) -> jax.Array:
    return jax.random.normal(jax.random.key(2), (count, len(flow.pairs[0].permutation)))


def test_a_fresh_flow_only_permutes():
    flow = _shaken(lambda key: RealNVP(6, 16, key), size=0.0)
    x = jnp.arange(6.0)
    z, log_det = _forward(flow, x[None])
    np.testing.assert_array_equal(np.sort(z[0]), x)
    assert log_det == 0.0 and len(flow.pairs) == 2


def test_the_flow_s_inverse_is_the_identity_and_the_log_determinants_cancel(flow):
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda a: a.astype(jnp.float64), flow)
        x = 2.0 * _inputs(flow, 50).astype(jnp.float64)
        z, forward = _forward(exact, x)
        back, inverse = _inverse(exact, z)
        assert np.abs(z - x).max() > 0.5 and np.std(forward) > 0.1
        np.testing.assert_allclose(back, x, atol=1e-9)
        np.testing.assert_allclose(forward + inverse, 0.0, atol=1e-9)
        np.testing.assert_allclose(_forward(exact, _inverse(exact, x)[0])[0], x, atol=1e-9)


def test_single_precision_keeps_the_flow_s_inverse(flow):
    x = _inputs(flow, 50)
    z, forward = _forward(flow, x)
    back, inverse = _inverse(flow, z)
    np.testing.assert_allclose(back, x, atol=1e-3)
    np.testing.assert_allclose(forward + inverse, 0.0, atol=1e-3)


def test_the_log_determinant_is_that_of_the_jacobian(flow):
    x = _inputs(flow, 10)
    jacobians = jax.jit(jax.vmap(jax.jacobian(lambda v: flow.forward(v)[0])))(x)
    sign, expected = np.linalg.slogdet(np.asarray(jacobians, np.float64))
    assert np.all(np.abs(sign) == 1)
    np.testing.assert_allclose(_forward(flow, x)[1], expected, atol=1e-4)


def test_a_coupling_cannot_overflow():
    flow = _shaken(lambda key: RealNVP(4, 16, key), size=50.0)
    z, log_det = _forward(flow, jnp.full((1, 4), 10.0))
    assert np.isfinite(z).all() and abs(log_det) <= 2 * 2 * 2 * 2.0 + 1e-4  # 2 pairs, 2 couplings, 2 entries, each <= 2


@pytest.mark.parametrize("name", ["small", "tiny"])
def test_the_hypernetwork_makes_every_weight_of_the_field(name):
    preset = PRESETS[name]
    hyper = _shaken(
        lambda key: HyperNetwork(preset.latent, preset.hyper_hidden, preset.field, preset.smooth, key), size=0.0
    )
    z = jax.random.normal(jax.random.key(1), (8, preset.latent))
    weights = jax.jit(jax.vmap(hyper))(z)
    assert weights.shape == (8, preset.field.size)
    assert np.std(weights, axis=0).min() > 0.0  # every weight follows z
    kernels = [part for part in preset.field.unpack(weights[0]) if part.ndim == 2]
    for kernel in kernels[:-1]:  # outputs start at the size of a fresh network's weights, 1 / sqrt(fan in)
        assert 0.5 < np.std(kernel) / np.sqrt(2.0 / kernel.shape[0]) < 2.0


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return _shaken(lambda key: Encoder(PRESETS["tiny"], key))


def _views(count: int) -> tuple[jax.Array, jax.Array]:
    size = PRESETS["tiny"].image_size
    images = jax.random.uniform(jax.random.key(2), (count, IMAGE_CHANNELS, size, size))
    return images, jax.random.normal(jax.random.key(3), (count, CAMERA_FEATURES))


def test_the_encoder_s_precisions_add_over_views(encoder):
    images, cameras = _views(3)
    potentials = eqx.filter_jit(lambda encoder, i, c: jax.vmap(encoder.potential)(i, c))
    means, precisions = potentials(encoder, images, cameras)
    mean, precision = eqx.filter_jit(encoder)(images, cameras, jnp.ones(3))
    prior = jnp.exp(encoder.prior_log_precision)
    np.testing.assert_allclose(precision, prior + precisions.sum(0), rtol=1e-5)
    expected = (prior * encoder.prior_mean + (precisions * means).sum(0)) / precision
    np.testing.assert_allclose(mean, expected, rtol=1e-4, atol=1e-5)
    assert np.all(precisions > 0)


def test_the_encoder_ignores_unused_views_and_their_order(encoder):
    images, cameras = _views(3)
    call = eqx.filter_jit(encoder)
    two = call(images, cameras, jnp.array([1.0, 0.0, 1.0]))
    other = call(images.at[1].set(7.0), cameras.at[1].set(-3.0), jnp.array([1.0, 0.0, 1.0]))
    for a, b in zip(two, other, strict=True):
        np.testing.assert_array_equal(a, b)
    turned = call(images[::-1], cameras[::-1], jnp.array([1.0, 0.0, 1.0]))
    for a, b in zip(two, turned, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
    mean, precision = call(images, cameras, jnp.zeros(3))
    np.testing.assert_allclose(mean, encoder.prior_mean, rtol=1e-6)
    np.testing.assert_allclose(precision, jnp.exp(encoder.prior_log_precision), rtol=1e-6)


def test_the_whole_model_decodes_latents_into_weights():
    preset = PRESETS["tiny"]
    model = _shaken(lambda key: ProbNeRF(preset, key), size=0.05)
    z = jax.random.normal(jax.random.key(2), (model.latent,))
    weights = eqx.filter_jit(model.decode)(z)
    assert model.latent == preset.latent and weights.shape == (model.field.size,)
    by_parts = eqx.filter_jit(model.hyper)(_forward(model.flow, z[None])[0][0])
    np.testing.assert_allclose(weights, by_parts, rtol=1e-5, atol=1e-6)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(model.decode(v) ** 2)))(z)
    assert np.isfinite(gradient).all() and np.all(gradient != 0)
