"""Runs of the sampler on one view: what each assumes."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from perception.inference.limits import NO_LIMITS
from perception.inference.view_sampler import ViewSampler
from probnerf.likelihood.dispatch import log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.objects.cylinder_scenes import scene
from probnerf.settings import InferConfig


def test_a_run_with_wider_walls_has_the_likelihood_of_that_wall_error() -> None:
    model, likelihood, observation, _ = scene("seen", True, columns=8, rows=6, cubes=16)
    likelihood = replace(likelihood, wall_sigma=0.03)
    view: Any = SimpleNamespace(observation=observation)
    prior: Any = None
    sampler = ViewSampler(view, prior, InferConfig(wall_sigma=0.03), 0, NO_LIMITS, walls=(1.0, 2.0, 4.0))
    positions = jax.random.normal(jax.random.key(0), (16, likelihood.dim(model)))
    faces = faces_of_view(observation, likelihood)
    values = []
    for number, factor in enumerate((1.0, 2.0, 4.0, 1.0)):
        wide = replace(likelihood, wall_sigma=0.03 * factor)
        values.append(np.asarray(log_likelihood((model, wide, observation, faces), positions)))
        seen = sampler._observation(number)
        found = np.asarray(log_likelihood((model, likelihood, seen, faces), positions))
        np.testing.assert_allclose(found, values[-1], rtol=1e-4, atol=1e-3)
        assert (seen is observation) == (factor == 1.0)
    assert np.abs(values[1] - values[0]).max() > 1.0 and np.abs(values[2] - values[1]).max() > 1.0


@pytest.mark.parametrize(("walls", "models"), [((1.0,), [0, 0, 0, 0]), ((1.0, 2.0, 4.0), [0, 1, 2, 0])])
def test_runs_take_wall_errors_in_turn(walls: tuple[float, ...], models: list[int]) -> None:
    nothing: Any = None
    sampler = ViewSampler(nothing, nothing, InferConfig(), 0, NO_LIMITS, walls=walls)
    assert [sampler.model_of(number) for number in range(4)] == models
