"""Few samples stand for many, each by its weight; poses are a group."""

from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from probnerf.sampling.populations import thin
from probnerf.sampling.resampling import resample
from probnerf.types import BASE_Z, Diagnostics, Pose, Posterior
from tests.probnerf.laws import SIGMAS
from tests.properties.drawn import law, seeds, slower_law

DRAWS, SAMPLES, COPIES = 1024, 24, 16


def posterior_of(log_weights: np.ndarray, population: np.ndarray) -> Posterior:
    """Samples of which only weight and population are told."""
    each, one = np.zeros(len(log_weights)), np.zeros(())
    diagnostics = Diagnostics(*[each if f.name in ("beta", "log_evidences") else one for f in fields(Diagnostics)])
    return Posterior(each[:, None], log_weights, each, each, population, one, one, diagnostics, "converged")


@st.composite
def weighted(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Log-weights, some of them of no weight at all, and populations."""
    rng = np.random.default_rng(draw(seeds))
    count = draw(st.integers(1, 60))
    population = rng.integers(0, draw(st.integers(1, 4)), count).astype(np.int32)
    log_w = draw(st.floats(0.0, 5.0)) * rng.normal(size=count)
    log_w[rng.random(count) < draw(st.floats(0.0, 0.8))] = -np.inf
    log_w[rng.integers(count)] = 0.0
    return log_w - np.logaddexp.reduce(log_w), population


@law
@given(weighted(), st.integers(1, 80))
def test_no_as_many_equal_samples_are_nearer_to_a_population(drawn: tuple[np.ndarray, np.ndarray], count: int) -> None:
    """Their distribution is within half a sample of the population's everywhere, which none of n steps can beat."""
    log_w, population = drawn
    indices, weights, names = thin(posterior_of(log_w, population), count)
    np.testing.assert_array_equal(population[indices], names)
    assert abs(weights.sum() - 1.0) < 1e-12
    for name in np.unique(population[log_w > -np.inf]):
        members = np.flatnonzero(population == name)
        kept = indices[names == name]
        w = np.exp(log_w[members])
        np.testing.assert_allclose(weights[names == name], w.sum() / len(kept))
        copies = np.bincount(np.searchsorted(members, kept), minlength=len(members))
        away = np.cumsum(copies) / len(kept) - np.cumsum(w) / w.sum()
        assert np.abs(away).max() <= 0.5 / len(kept) + 1e-9
        assert (copies[w == 0] == 0).all()


@jax.jit
def copies_of(log_w: jax.Array) -> jax.Array:
    """How often each sample is drawn, over many keys: [DRAWS, SAMPLES]."""
    keys = jax.random.split(jax.random.key(0), DRAWS)
    return jax.vmap(lambda key: jnp.bincount(resample(key, log_w, COPIES), length=SAMPLES))(keys)


@slower_law
@given(seeds, st.floats(0.0, 3.0))
def test_resampling_is_unbiased_and_leaves_no_more_than_rounding_to_chance(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    log_w = np.where(rng.random(SAMPLES) < 0.2, -np.inf, spread * rng.normal(size=SAMPLES)).astype(np.float32)
    log_w[0] = 0.0
    expected = COPIES * np.exp(log_w) / np.exp(log_w).sum()
    copies = np.asarray(copies_of(jnp.asarray(log_w)))
    assert (copies.sum(axis=1) == COPIES).all() and (np.abs(copies - expected) < 1.0 + 1e-4).all()
    left = expected - np.floor(expected)  # to chance
    error = SIGMAS * np.sqrt(left * (1.0 - left) / DRAWS) + 1.0 / DRAWS
    assert (np.abs(copies.mean(axis=0) - expected) <= error).all()


@st.composite
def placed(draw: st.DrawFn) -> Pose:
    """A pose that is no number out of the ordinary."""
    turn, place, size = st.floats(-3.0, 3.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)
    return Pose(*(jnp.float32(draw(s)) for s in (turn, place, place, size, place)))


def to_view(pose: Pose, points: np.ndarray) -> np.ndarray:
    """p_view = R_z(yaw) scale (p_object - base) + base + (x, y, z)."""
    c, s = np.cos(float(pose.yaw)), np.sin(float(pose.yaw))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    base = np.array([0.0, 0.0, BASE_Z])
    place = np.array([float(pose.x), float(pose.y), float(pose.z)])
    return np.exp(float(pose.log_scale)) * (points - base) @ R.T + base + place


@law
@given(placed(), placed(), seeds)
def test_poses_are_undone_and_compose(first: Pose, second: Pose, seed: int) -> None:
    p, d = np.random.default_rng(seed).normal(size=(2, 4, 3)).astype(np.float32)
    np.testing.assert_allclose(first.to_object(jnp.asarray(to_view(first, p))), p, atol=2e-5)
    # One after the other they are one pose, whose place is the first one's moved by the second.
    x, y, z = to_view(second, to_view(first, np.array([0.0, 0.0, BASE_Z]))) - [0.0, 0.0, BASE_Z]
    at = jnp.array([x, y, z], jnp.float32)
    both = Pose(first.yaw + second.yaw, at[0], at[1], first.log_scale + second.log_scale, at[2])
    one_by_one = first.to_object(second.to_object(jnp.asarray(p)))
    np.testing.assert_allclose(both.to_object(jnp.asarray(p)), one_by_one, atol=1e-4)
    # A direction is the difference of two points, but for its length.
    between = (first.to_object(jnp.asarray(p + d)) - first.to_object(jnp.asarray(p))) * jnp.exp(first.log_scale)
    np.testing.assert_allclose(first.to_object_direction(jnp.asarray(d)), between, atol=1e-4)
