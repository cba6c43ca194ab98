"""Pictures of a model's own shapes: rays end where the foam says, and colours are the field's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("embreex")

from perception.simulation.model_pictures import LEAST_PIXELS, ModelShape, draw_shape
from perception.simulation.plain_pictures import PlainDraws
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.types import Rays

MODEL = ProbNeRF(PRESETS["tiny"], jax.random.key(3))
WEIGHTS = MODEL.decode(jnp.ones(4))


def _rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    origin = np.array([3.0, 0.0, 0.5])
    directions = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) - origin
    return origin, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_rays_end_as_often_and_as_far_as_the_foam_says() -> None:
    origin, directions = _rays(6)
    rays = Rays(jnp.broadcast_to(origin, (6, 3)), jnp.asarray(directions))
    truth = foam.render(MODEL.field, WEIGHTS, rays, foam.Lattice(32, 1.1))
    shape = ModelShape(MODEL.field, WEIGHTS, 0.1, np.random.default_rng(1))
    times = 2000
    hits = shape.cast(origin, np.repeat(directions, times, axis=0))
    ended = np.isfinite(hits.distance).reshape(6, times)
    opacity = np.asarray(truth.opacity)
    assert opacity.max() > 0.05
    np.testing.assert_allclose(ended.mean(axis=1), opacity, atol=4 * np.sqrt(0.25 / times))
    distance = np.where(ended, hits.distance.reshape(6, times), np.nan)
    gap = np.asarray(foam.gap_before(truth.t))  # an end is in the gap before its face
    expected = np.sum(truth.weights * (np.where(truth.t < foam.FAR, truth.t, 0.0) - 0.5 * gap), axis=1) / opacity
    np.testing.assert_allclose(np.nanmean(distance, axis=1), expected, atol=0.05)
    assert ((hits.mesh >= 0) == np.isfinite(hits.distance)).all()


def test_colours_are_the_fields() -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5, 3))
    _, directions = _rays(5)
    shape = ModelShape(MODEL.field, WEIGHTS, 0.1, np.random.default_rng(1))
    p, d = jnp.asarray(points, jnp.float32), jnp.asarray(directions, jnp.float32)
    wanted = MODEL.field.colour(WEIGHTS, p, d, MODEL.field.density(WEIGHTS, p))
    np.testing.assert_allclose(shape.colours(points, directions), wanted, atol=1e-5)


def test_pictures_show_the_shape_and_seeds_repeat() -> None:
    def drawn() -> list:
        return draw_shape(np.random.default_rng(4), MODEL.field, 3.0 * WEIGHTS, 6, 16, PlainDraws())

    first, again = drawn(), drawn()
    assert len(first) == len(again)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.distance, b.distance)
        assert (a.distance > 0).sum() >= LEAST_PIXELS and a.rgb.shape == (16, 16, 3)
