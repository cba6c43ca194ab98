"""Geweke's joint test on a tiny foam: pixels and positions drawn from each other in turn keep their joint law.

A position from the prior, pixels from the position; then an iteration of the sampler given the pixels and pixels given
the position, again and again. Whatever the number of turns, the position is still a draw from the prior (Geweke 2004),
if the density that the sampler reads is the one that the pixels were drawn from, and its moves leave that posterior
alone. Chains begin in the joint law, so that nothing has to be waited for.
"""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from probnerf.fields.cylinder import CylinderModel
from probnerf.likelihood import pixel_terms as real
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.cylinder_scenes import draw_pixels, grid_of_rays
from probnerf.rendering.foam import Lattice
from probnerf.sampling.hmc import Target, hmc_step
from tests.probnerf.laws import assert_zero, mutant

CHAINS, TURNS, STEP = 1536, 10, 0.12
POSE_SIGMA = jnp.array([0.1, 0.1, 0.1, 0.05, 0.05])


def turned(module: ModuleType) -> tuple[np.ndarray, float, float]:
    """Positions [chains, 9] after all turns, the mean acceptance, and how far they came."""
    cylinder, likelihood = CylinderModel(), Likelihood(Lattice(8, max_crossings=20), wall_sigma=0.05)
    rays, known = grid_of_rays(5, 3), jnp.arange(15) % 7 > 0

    def pixels(key, q):
        return draw_pixels(key, cylinder, likelihood, q, rays, known, jnp.asarray(True), pose_sigma=POSE_SIGMA)

    def value(observation, q):
        t = faces_of_view(observation, likelihood)
        return jax.vmap(lambda p: module.log_likelihood_one(cylinder, likelihood, observation, t, p))(q)

    def chain(key):
        key, start = jax.random.split(key)
        first = jax.random.normal(start, (9,))

        def turn(q, key):
            a, b = jax.random.split(key)
            target = Target(value, pixels(a, q), jnp.ones(()))
            state, info = hmc_step(b, target.evaluate(q[None]), target, jnp.asarray(STEP), 3)
            return state.position[0], info.acceptance[0]

        last, acceptance = jax.lax.scan(turn, first, jax.random.split(key, TURNS))
        return last, acceptance.mean(), jnp.sum((last - first) ** 2)

    run = jax.jit(lambda keys: jax.lax.map(chain, keys, batch_size=128))
    q, acceptance, moved = run(jax.random.split(jax.random.key(0), CHAINS))
    return np.asarray(q, np.float64), float(acceptance.mean()), float(moved.mean())


def the_joint_stays(module: ModuleType) -> None:
    q, acceptance, moved = turned(module)
    if not (0.3 < acceptance < 0.9 and moved > 1.0):
        raise RuntimeError(f"the law asks nothing: acceptance {acceptance:.2f}, moved {moved:.2f}")
    assert_zero(q)
    assert_zero(q**2 - 1.0)
    yaw = np.arctan2(q[:, 3], q[:, 2])
    assert_zero(np.stack([np.cos(yaw), np.sin(yaw), np.cos(2 * yaw), np.sin(2 * yaw)], axis=1))
    assert_zero(q[:, :-1] * q[:, 1:])


@pytest.mark.slow
def test_positions_and_pixels_keep_their_joint_law() -> None:
    the_joint_stays(real)


MUTATIONS = {
    "a surface at the face instead of in the gap before it": (
        "surface = jnp.where(t_hit < foam.FAR, t_hit - 0.5 * gap, 0.0)",
        "surface = jnp.where(t_hit < foam.FAR, t_hit, 0.0)",
    ),
    "the range's offset with the other sign": ("0.0) - range_offset", "0.0) + range_offset"),
    "a free ray that counts its depth twice": ("+ log_clear)", "+ 2.0 * log_clear)"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTATIONS)
def test_a_density_that_is_not_the_pixels_breaks_it(name: str) -> None:
    module = mutant("probnerf.likelihood.pixel_terms", MUTATIONS[name])
    with pytest.raises(AssertionError):
        the_joint_stays(module)
