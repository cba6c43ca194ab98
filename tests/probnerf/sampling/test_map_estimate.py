"""MAP by Adam: the ascent's laws, and the analytic field's yaw and size found again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderModel
from probnerf.geometry import look_at, pinhole_rays
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.position import pose_of, split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.pixel_status import FREE, OBJECT
from probnerf.rendering import foam
from probnerf.sampling.ascent import ascend
from probnerf.sampling.map_estimate import MAPConfig, map_estimate
from probnerf.sampling.modes import log_posterior
from probnerf.settings import AdamConfig
from probnerf.types import Observation, Rays

MODEL = CylinderModel()
LIKELIHOOD = Likelihood(lattice=foam.Lattice(16, 1.1), wall_sigma=0.05)


def _observed(position: np.ndarray) -> Observation:
    """24 x 24 noiseless RGB-D pixels of the analytic object at a position."""
    T = look_at(np.array([4.0, 0.0, 2.5]), np.zeros(3))
    origin, direction = pinhole_rays(T, 12 * np.linalg.norm(T[:3, 3]) / 1.2, 24)
    rays = Rays(jnp.asarray(origin), jnp.asarray(direction))
    pose_sigma = jnp.array([0.1, 0.1, 0.1, 0.0, 0.0])
    weights, pose = jax.jit(split_position)(MODEL, LIKELIHOOD, jnp.asarray(position), pose_sigma)
    picture = jax.jit(foam.render)(MODEL.field, weights, rays, LIKELIHOOD.lattice, pose)
    hit = picture.opacity > 0.5
    n = hit.shape[0]
    return Observation(
        rays=rays,
        status=jnp.where(hit, OBJECT, FREE),
        rgb=picture.colour / jnp.maximum(picture.opacity, 0.5)[:, None],
        rgb_valid=hit,
        range=jnp.where(hit, picture.distance, 0.0),
        range_sigma=jnp.full(n, 0.01),
        range_valid=hit,
        limit=jnp.where(hit, 0.0, 1e3),
        pose_sigma=pose_sigma,
        colour_count=n,
    )


def _to_target(args, batch, q):
    return -jnp.sum((q - args - (0.0 if batch is None else batch)) ** 2, axis=-1)


def test_ascent_reaches_the_top_of_a_bowl_from_every_start():
    target = jnp.array([0.5, -1.0, 2.0])
    start = jax.random.normal(jax.random.key(0), (5, 3))
    q, values = ascend(_to_target, target, start, AdamConfig(steps=400))
    np.testing.assert_allclose(q, np.broadcast_to(target, (5, 3)), atol=1e-2)
    assert values.shape == (400, 5)
    np.testing.assert_allclose(values[0], -np.sum((start - target) ** 2, axis=-1), rtol=1e-5)


def test_starts_do_not_touch():
    start = jax.random.normal(jax.random.key(1), (4, 3))
    config = AdamConfig(steps=30)
    together, _ = ascend(_to_target, jnp.ones(3), start, config)
    alone, _ = ascend(_to_target, jnp.ones(3), start[2:3], config)
    np.testing.assert_allclose(together[2:3], alone, atol=1e-6)


def test_each_step_sees_its_own_batch():
    """Targets that alternate about a mean are ascended towards that mean."""
    batches = jnp.where(jnp.arange(600) % 2 == 0, 1.0, -1.0)[:, None]
    q, values = ascend(_to_target, jnp.full(1, 0.3), jnp.zeros((1, 1)), AdamConfig(steps=600), batches)
    np.testing.assert_allclose(q, 0.3, atol=0.05)
    np.testing.assert_allclose(values[0, 0], -(1.3**2), rtol=1e-5)


def test_the_yaw_s_prior_is_flat():
    truth = np.array([0.2, -0.3, 0.8, 0.6, 0.1, 0.2, -0.1, 0.0, 0.0], np.float32)
    observation = _observed(truth)
    args = (MODEL, LIKELIHOOD, observation, faces_of_view(observation, LIKELIHOOD))
    stretched = truth.copy()
    stretched[2:4] *= 3.0  # the same yaw
    a, b = jax.jit(log_posterior)(args, None, jnp.asarray(np.stack([truth, stretched])))
    np.testing.assert_allclose(a, b, atol=1e-2)


@pytest.mark.usefixtures("optimised")
def test_a_visible_handle_s_yaw_and_the_body_s_size_are_found_again():
    yaw = 1.0
    truth = np.array([0.5, 0.4, np.cos(yaw), np.sin(yaw), 0.3, -0.4, 0.2, 0.0, 0.0], np.float32)
    observation = _observed(truth)
    angles = np.arange(6) * np.pi / 3 + 0.4
    starts = np.zeros((6, 9), np.float32)
    starts[:, 2], starts[:, 3] = np.cos(angles), np.sin(angles)
    best, values = map_estimate(MODEL, LIKELIHOOD, observation, jnp.asarray(starts), MAPConfig(steps=120))
    assert np.isfinite(values).all() and values.shape == (4,)
    assert values[0] > values[-1] + 10.0  # best first; wrong yaws end lower
    args = (MODEL, LIKELIHOOD, observation, faces_of_view(observation, LIKELIHOOD))
    at_truth = float(jax.jit(log_posterior)(args, None, jnp.asarray(truth)[None])[0])
    assert float(values[0]) > at_truth - 1.0
    pose = pose_of(best[2:], observation.pose_sigma)
    assert abs(np.angle(np.exp(1j * (float(pose.yaw) - yaw)))) < np.deg2rad(6)
    size = MODEL.decode(best[:2])[1] * jnp.exp(pose.log_scale)  # only radius times scale is seen this well
    true_size = MODEL.decode(jnp.asarray(truth[:2]))[1] * np.exp(0.1 * truth[6])
    np.testing.assert_allclose(size, true_size, rtol=0.04)
