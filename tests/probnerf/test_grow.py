"""A prior that is grown makes the fields that it made before, and its new parts can learn."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.grow import grow
from probnerf.prior import PRESETS, ProbNeRF
from probnerf.store import load_prior, save_prior

SMALL = replace(PRESETS["tiny"], radial=True, fitted=True)
WAVED = replace(SMALL, waves=3)


def test_a_grown_prior_makes_the_same_fields() -> None:
    model = ProbNeRF(SMALL, jax.random.key(0))
    grown = grow(model, WAVED, jax.random.key(1))
    z = jax.random.normal(jax.random.key(2), (SMALL.latent,))
    points = jax.random.uniform(jax.random.key(3), (50, 3), minval=-1.0, maxval=1.0)
    before, after = model.decode(z), grown.decode(z)
    assert after.size == grown.field.size == before.size + 2 * 3 * SMALL.width + 3 * 3
    sigma = model.field.density(before, points)
    np.testing.assert_allclose(grown.field.density(after, points), sigma, rtol=1e-4)
    directions = jnp.broadcast_to(jnp.array([0.0, 0.6, -0.8]), points.shape)
    colour = model.field.colour(before, points, directions, sigma)
    np.testing.assert_allclose(grown.field.colour(after, points, directions, sigma), colour, atol=1e-5)

    def brightness(hyper):
        return jnp.sum(grown.field.colour(hyper(grown.flow.forward(z)[0]), points, directions, sigma))

    gradient = jax.grad(brightness)(grown.hyper)
    rows = np.flatnonzero(np.abs(np.asarray(grown.hyper.weight)).sum(axis=1) == 0)  # the waves' part of the first layer
    assert len(rows) == 2 * 3 * SMALL.width
    assert (np.abs(np.asarray(gradient.weight)[rows]).sum(axis=1) > 0).mean() > 0.3


def test_colour_depends_on_the_waves_and_density_does_not() -> None:
    field = WAVED.field
    weights = 0.3 * jax.random.normal(jax.random.key(0), (field.size,))
    other = weights.at[-9:].add(0.5)
    points = jax.random.uniform(jax.random.key(1), (20, 3), minval=-1.0, maxval=1.0)
    directions = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), points.shape)
    sigma = field.density(weights, points)
    np.testing.assert_array_equal(field.density(other, points), sigma)
    colours = [field.colour(w, points, directions, sigma) for w in (weights, other)]
    assert float(jnp.abs(colours[0] - colours[1]).max()) > 1e-3


def test_only_waves_may_be_added() -> None:
    model = ProbNeRF(SMALL, jax.random.key(0))
    assert grow(model, SMALL, jax.random.key(1)) is model
    with pytest.raises(ValueError, match="only waves may be added"):
        grow(model, replace(SMALL, width=16), jax.random.key(1))
    with pytest.raises(ValueError, match="only waves may be added"):
        grow(ProbNeRF(WAVED, jax.random.key(0)), SMALL, jax.random.key(1))


def test_a_file_carries_its_own_sizes_and_an_older_one_has_no_waves(tmp_path) -> None:
    path = tmp_path / "p.safetensors"
    save_prior(path, ProbNeRF(WAVED, jax.random.key(0)), {})
    assert load_prior(path).model.preset == WAVED
    shipped = load_prior()
    if "sizes" not in shipped.metadata:
        assert shipped.model.preset.waves == 0
