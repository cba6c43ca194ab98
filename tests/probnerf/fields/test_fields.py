"""Fields: sizes, the position encoding against float64, and the two fields' own promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderField
from probnerf.fields.mlp import MLPField, encode, encoded_size, sincospi
from probnerf.prior.networks import PRESETS
from probnerf.types import BASE_Z


def _encode64(x: np.ndarray, octaves: int) -> np.ndarray:
    """The definition, in float64: [x, sin(2^j pi x), cos(2^j pi x)] for j < octaves."""
    x = x.astype(np.float64)
    angles = [2.0**j * np.pi * x for j in range(octaves)]
    return np.concatenate([x, *(f(a) for a in angles for f in (np.sin, np.cos))])


def test_the_paper_preset_has_20868_weights():
    field = PRESETS["paper"].field
    density = sum(int(np.prod(shape)) for shape in field.shapes[:6])
    assert (density, field.size - density, field.size) == (8_321, 12_547, 20_868)
    assert field.shapes[0] == (63, 64) and field.shapes[6] == (63 + 63 + 1, 64)


@pytest.mark.parametrize("name", PRESETS)
def test_the_flat_vector_is_unpacked_in_order_and_wholly(name):
    field = PRESETS[name].field
    parts = field.unpack(jnp.arange(field.size))
    assert [part.shape for part in parts] == field.shapes
    np.testing.assert_array_equal(np.concatenate([part.reshape(-1) for part in parts]), np.arange(field.size))


def test_sine_and_cosine_are_right_far_from_zero():
    u = np.random.default_rng(0).uniform(-600.0, 600.0, 20_000).astype(np.float32)
    sine, cosine = sincospi(jnp.asarray(u))
    np.testing.assert_allclose(sine, np.sin(np.pi * u.astype(np.float64)), atol=5e-7)
    np.testing.assert_allclose(cosine, np.cos(np.pi * u.astype(np.float64)), atol=5e-7)


@pytest.mark.parametrize("channels", [3, 4])
def test_encoding_is_right_to_1e_5_at_ten_octaves(channels):
    x = np.random.default_rng(1).uniform(-1.3, 1.3, (channels, 4096)).astype(np.float32)
    x[:, :4] = [0.0, 1.0, -1.0, 0.5]
    features = jax.jit(encode, static_argnums=1)(jnp.asarray(x), 10)
    assert features.shape == (encoded_size(10, channels), 4096)
    np.testing.assert_allclose(features, _encode64(x, 10), atol=1e-5)


@pytest.mark.parametrize("channels", [3, 4])
def test_the_encoding_s_gradient_is_that_of_its_definition(channels):
    rng = np.random.default_rng(2)
    x = rng.uniform(-1.2, 1.2, (channels, 64)).astype(np.float32)
    cotangent = rng.standard_normal((encoded_size(10, channels), 64)).astype(np.float32)
    (gradient,) = jax.vjp(lambda p: encode(p, 10), jnp.asarray(x))[1](jnp.asarray(cotangent))
    step = 1e-7
    difference = (_encode64(x + np.float64(step), 10) - _encode64(x - np.float64(step), 10)) / (2 * step)
    difference = difference.reshape(-1, channels, 64)  # features of one kind stand together, x, y, z within
    expected = np.sum(cotangent.reshape(-1, channels, 64) * difference, axis=0)
    np.testing.assert_allclose(gradient, expected, atol=2e-5 * np.abs(expected).max())


def test_density_is_never_negative_and_colour_lies_in_the_unit_interval():
    field = PRESETS["tiny"].field
    rng = np.random.default_rng(3)
    weights = jnp.asarray(rng.standard_normal(field.size).astype(np.float32))
    points = jnp.asarray(rng.uniform(-1, 1, (7, 5, 3)).astype(np.float32))
    directions = points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    sigma = jax.jit(field.density)(weights, points)
    colour = jax.jit(field.colour)(weights, points, directions, sigma)
    assert sigma.shape == (7, 5) and colour.shape == (7, 5, 3)
    assert np.all(sigma >= 0) and np.all((colour >= 0) & (colour <= 1))
    # Each point is its own: leading axes are only a layout.
    one = jax.jit(field.colour)(weights, points[4, 2], directions[4, 2], sigma[4, 2])
    np.testing.assert_allclose(one, colour[4, 2], atol=1e-6)


def test_colour_depends_on_direction_and_hardly_on_how_dense_a_dense_wall_is():
    field = MLPField(width=8, octaves=2, direction_octaves=1, radial=True)
    weights = jnp.asarray(np.random.default_rng(4).standard_normal(field.size).astype(np.float32))
    point, along = jnp.array([0.2, -0.1, 0.3]), jnp.array([1.0, 0.0, 0.0])
    colour = jax.jit(field.colour)
    there, back = colour(weights, point, along, jnp.array(3.0)), colour(weights, point, -along, jnp.array(3.0))
    assert np.abs(there - back).max() > 1e-3
    steep = jax.jit(jax.grad(lambda s: jnp.sum(field.colour(weights, point, along, s))))(jnp.array(1e6))
    assert np.isfinite(steep) and abs(steep) < 1e-5


def test_the_cylinder_is_solid_inside_empty_outside_and_half_way_at_its_walls():
    field = CylinderField()
    mid = BASE_Z + 0.5 * field.height
    weights = jnp.array([0.4, 0.5])  # handle from x = 0.5 to 0.9

    density = jax.jit(field.density)

    def opacity(*point: float) -> float:
        return float(density(weights, jnp.array(point, jnp.float32))) / field.density_scale

    inside = [(0, 0, mid), (0.3, 0.3, mid), (0.7, 0.0, mid), (0, 0, BASE_Z + 0.15)]
    outside = [
        (-0.7, 0, mid),
        (0.7, 0.3, mid),
        (0.7, 0, mid + 0.45),
        (1.1, 0, mid),
        (0, 0, BASE_Z + field.height + 0.2),
    ]
    assert min(opacity(*point) for point in inside) > 0.9
    assert max(opacity(*point) for point in outside) < 0.1
    for wall in [(-0.5, 0, mid), (0, 0.5, mid), (0.9, 0, mid), (0.7, 0.12, mid), (0, 0, BASE_Z + field.height)]:
        assert opacity(*wall) == pytest.approx(0.5, abs=1e-4)


def test_the_cylinder_s_gradient_is_finite_on_its_axis():
    field = CylinderField()

    def total(weights, point):
        sigma = field.density(weights, point)
        return sigma + jnp.sum(field.colour(weights, point, point, sigma))

    gradient = jax.jit(jax.grad(total, argnums=(0, 1)))
    for point in ([0.0, 0.0, 0.0], [0.0, 0.0, BASE_Z], [0.5, 0.0, 0.0], [0.5, 0.12, -0.2], [1e3, 0.0, 0.0]):
        gradients = gradient(jnp.array([0.4, 0.5]), jnp.array(point))
        assert all(np.isfinite(g).all() for g in gradients)
