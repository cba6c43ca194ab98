"""Scores of one answer: the truth scores best, boxes lie where they should, shapes are those that are published."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.measures.scores import Answer, random_boxes, shapes_at
from benchmarks.rivals.methods import Question, weighted_posterior
from benchmarks.rivals.quick import METHODS, POSTERIOR
from benchmarks.scenes.vessels import GRID
from benchmarks.studies.hidden import judge
from perception.inference.publish import ConditionedView, published
from perception.inference.settings import ControllerConfig
from perception.observation.visibility import answered_voxels
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import coarsen
from tests.benchmarks import vessels


@pytest.fixture(scope="module")
def vessel():
    return vessels.view()


@pytest.fixture(scope="module")
def rate():
    return vessels.rate()


def test_the_truth_scores_best_and_is_never_falsely_free(vessel, rate):
    rng = np.random.default_rng(0)
    even = np.full(4, 0.25)
    guesses = rng.random((4, 32, 32, 32)) < rate
    given = {m: Answer(guesses, even, 1.0) for m in METHODS}
    given[POSTERIOR] = Answer(vessel.solid[None], np.ones(1), 1.0, "converged")
    found = judge(vessel, given, rate, 0, warm=True)
    best = found.values[POSTERIOR]
    for method in METHODS[1:]:
        assert best["hidden_nll"] < found.values[method]["hidden_nll"]
        assert best["hidden_nll_handle"] < found.values[method]["hidden_nll_handle"]
    assert best["hidden_nll"] < 0.02 and best["hidden_ece"] < 0.03
    assert not (found.occupied & (found.p_free[POSTERIOR] > 0.95)).any()
    assert not (found.scored & vessel.seen).any()


def test_boxes_lie_about_scored_voxels():
    scored = np.zeros((32, 32, 32), bool)
    scored[3, 30, 16] = True
    boxes = random_boxes(scored, 50, np.random.default_rng(1))
    assert (boxes[:, 0] >= 0).all() and (boxes[:, 1] <= 32).all()
    assert ((boxes[:, 0] <= [3, 30, 16]) & (boxes[:, 1] > [3, 30, 16])).all()


def test_shapes_are_those_that_are_published(vessel):
    question = Question(vessel, load_prior(), ControllerConfig(hypotheses=8), 0)
    (observation, cube), likelihood, model = question.observed, question.likelihood, question.prior.model
    positions = 0.5 * jax.random.normal(jax.random.key(0), (8, likelihood.dim(model)))
    posterior = weighted_posterior(positions, np.ones(8), 0.0)
    config = question.config
    seen = np.zeros((config.grid,) * 3, bool)  # else measured surface is in all that appear
    view = ConditionedView(vessel.frame, vessel.segment, (observation,), cube, seen)
    h = published(view, posterior, likelihood, question.prior, config, 0)
    assert len(h.weights) == 8  # all of them, in their order
    asked = jnp.asarray(answered_voxels(vessel.frame, vessel.segment, cube, config.grid))
    shapes = shapes_at(model, likelihood, positions, observation.pose_sigma, asked)
    assert shapes.any()
    np.testing.assert_array_equal(shapes, coarsen(h.solid, GRID))
