"""A flow is fitted to objects that its decoder did not learn."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.household.flow import Options, fitted, log_prior
from probnerf.prior.networks import RealNVP

K = 4
OPTIONS = Options(prior=Path("unused"), work=Path("unused"), steps=300, batch=64, learning_rate=1e-2)


def told(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Latents twice as wide as the law of a new flow, whose middle is elsewhere."""
    return 1.0 + 2.0 * np.random.default_rng(0).standard_normal((n, K)), np.full((n, K), 0.1)


def test_log_prior_is_a_density_of_z() -> None:
    flow = RealNVP(2, 8, jax.random.key(0))
    axis = np.linspace(-7.0, 7.0, 141)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2).astype(np.float32)
    assert np.exp(np.asarray(log_prior(flow, grid))).sum() * 0.1**2 == pytest.approx(1.0, abs=0.01)


def test_a_fitted_flow_knows_held_out_latents_as_well_as_their_law_does() -> None:
    """The Gaussian that they are drawn from: no law is better on average."""
    mean, sd = told(4000)
    _, figures = fitted(RealNVP(K, 16, jax.random.key(1)), mean, sd, OPTIONS)
    best = -K * (0.5 + 0.5 * np.log(2 * np.pi) + 0.5 * np.log(2.0**2 + 0.1**2))
    assert figures["before"]["log_prior"] < best - 2.0
    assert figures["after"]["log_prior"] == pytest.approx(best, abs=0.3)


def test_a_flow_that_no_step_improves_stays_as_it_was() -> None:
    mean, sd = told(100)
    flow = RealNVP(K, 16, jax.random.key(1))
    after, figures = fitted(flow, mean, sd, replace(OPTIONS, steps=50, learning_rate=0.0))
    assert figures["after"] == figures["before"]
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(flow), strict=True))
