"""What is asked of sampled positions."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.objects.cylinder_scenes import scene
from probnerf.prior.checkpoint import load_prior
from probnerf.shapes import explained, opacity_grids


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


@pytest.mark.parametrize("grid", [64, 65])
def test_a_coarser_evaluation_gives_nearly_the_same_shapes(grid: int) -> None:
    model = load_prior().model
    _, likelihood, observation, _ = scene("seen", True, columns=8, rows=6, cubes=16)
    positions = 0.7 * jax.random.normal(jax.random.key(0), (3, likelihood.dim(model)))
    wanted = np.ones((grid,) * 3, bool)

    def grids(coarse: int) -> np.ndarray:
        return np.asarray(
            opacity_grids(model, likelihood, positions, observation.pose_sigma, jnp.asarray(wanted), coarse=coarse), int
        )

    fine, coarse = grids(1), grids(2)
    solid, same = fine >= 128, (fine >= 128) == (coarse >= 128)
    assert 0.01 < solid.mean() < 0.5 and same.mean() > 0.98
    # walls are neither pushed out nor in by more than a tenth of a voxel's layer
    assert abs(int((coarse >= 128).sum()) / int(solid.sum()) - 1.0) < 0.05
    far = np.abs(fine - coarse) > 60
    assert far.mean() < 0.03
    # what is not wanted is 0, and the rest does not depend on it
    wanted[: grid // 3], wanted[..., ::3] = False, False
    np.testing.assert_array_equal(grids(2), np.where(wanted, coarse, 0))
    np.testing.assert_array_equal(grids(1), np.where(wanted, fine, 0))
