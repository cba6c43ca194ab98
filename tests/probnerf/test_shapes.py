"""What is asked of sampled positions."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from probnerf.objects.cylinder_scenes import scene
from probnerf.shapes import explained


def test_a_bias_of_the_ranges_is_explained_by_as_large_an_offset_and_by_no_other() -> None:
    """Ranges that are all too long by the offset that a position tells are as well explained as true ranges are."""
    model, likelihood, observation, _ = scene("seen", True, columns=8, rows=6, cubes=16)
    sigma, at = 0.1, model.latent + 5  # of x, y, log-scale, range offset, z after a and b
    observation = replace(observation, pose_sigma=jnp.zeros(5).at[3].set(sigma))
    true = jnp.array([[0.3, 0.1, np.cos(np.pi / 3), np.sin(np.pi / 3), 0.0, 0.0, 0.0, 0.0, 0.0]], jnp.float32)
    offsets = jnp.array([-3.0, -1.5, 0.0, 1.5, 3.0])
    positions = jnp.repeat(true, len(offsets), axis=0).at[:, at].set(offsets)
    best = float(explained(model, likelihood, observation, true)[0])
    for k, offset in enumerate(offsets):
        biased = replace(observation, range=observation.range + sigma * offset)
        shares = np.asarray(explained(model, likelihood, biased, positions))
        assert shares[k] == best and (np.delete(shares, k) < best - 0.1).all()
