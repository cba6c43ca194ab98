"""Walls of things that vary more than a prior learnt err by more than those of a family that it knows."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import jax
import numpy as np
import pytest

from probnerf.inference import further_wall_error, with_wall_error
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.objects.cylinder_scenes import scene
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.settings import InferConfig
from probnerf.types import KINDS, Observation

HOUSEHOLD = jax.eval_shape(lambda key: ProbNeRF(PRESETS["household"], key), jax.random.key(0))
LEAST = PRESETS["household"].wall_sigma
DEFAULT = InferConfig()


def whole(kinds: dict[str, float], config: InferConfig = DEFAULT) -> float:
    """The wall error in all."""
    return float(np.hypot(config.wall_sigma, further_wall_error(config, HOUSEHOLD, kinds)))


def test_what_is_no_vessel_is_trusted_no_more_than_the_preset_says() -> None:
    assert DEFAULT.wall_sigma < LEAST
    for kinds in ({}, {"vessel": 0.0, "box": 0.5, "other": 0.5}):
        assert whole(kinds) == pytest.approx(LEAST)
        assert whole(kinds, InferConfig(wall_sigma=0.3)) == pytest.approx(0.3)


def test_the_variance_is_the_mean_over_kinds() -> None:
    assert KINDS[0] == "vessel"
    assert whole({"vessel": 1.0}) == pytest.approx(DEFAULT.wall_sigma)
    both = 0.25 * DEFAULT.wall_sigma**2 + 0.75 * LEAST**2
    assert whole({"vessel": 0.25, "box": 0.75}) == pytest.approx(np.sqrt(both))


def test_other_models_have_no_further_error() -> None:
    tiny = jax.eval_shape(lambda key: ProbNeRF(PRESETS["tiny"], key), jax.random.key(0))
    for model in (tiny, cast(Any, SimpleNamespace())):
        assert further_wall_error(InferConfig(), model, {}) == 0.0


def test_it_is_the_same_as_a_wider_wall_error_of_the_likelihood() -> None:
    model, likelihood, observation, t = scene("seen", depth=True)
    positions = jax.random.normal(jax.random.key(1), (16, likelihood.dim(model)))

    def values(wall_sigma: float, observation: Observation) -> np.ndarray:
        with_walls = replace(likelihood, wall_sigma=wall_sigma)
        return np.asarray(log_likelihood((model, with_walls, observation, t), positions))

    assert np.abs(values(0.03, observation) - values(0.05, observation)).max() > 1.0
    np.testing.assert_allclose(values(0.03, with_wall_error(observation, 0.04)), values(0.05, observation), rtol=1e-4)
