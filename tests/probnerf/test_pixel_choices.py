"""Several choices of a view's pixels: each group of positions is given one; together they are the mean posterior."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from probnerf.inference import infer, likelihood_of, likelihood_settings
from probnerf.likelihood.dispatch import log_likelihood, plain_log_likelihood
from probnerf.likelihood.pixel_terms import faces_of_view
from probnerf.objects.cylinder_scenes import integrate, scene, total_variation, yaw_histogram
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.sampling.hmc import StageInfo, split_r_hat
from probnerf.sampling.tempered_smc import tempered_smc
from probnerf.settings import AnnealedHMCConfig, InferConfig, TemperedSMCConfig, quick_smc
from probnerf.types import Observation, joined, stacked
from tests.probnerf.likelihood.test_kernel_call import view

MODEL = ProbNeRF(PRESETS["tiny"], jax.random.key(0))
CONFIG = InferConfig(lattice=8, smc_from_prior=quick_smc(4, 4), hmc=AnnealedHMCConfig(chains=4, iterations=3, keep=1))


def args_of(observation: Observation, config: InferConfig = CONFIG) -> tuple:
    likelihood = likelihood_of(config, observation)
    return MODEL, likelihood, observation, faces_of_view(observation, likelihood)


def test_one_of_a_stack_is_as_it_was_and_all_joined_are_one_observation() -> None:
    each = [view(9, 5, seed) for seed in range(3)]
    stack = stacked(each)
    assert stack.choices == 3 and each[0].choices == 1
    for k, own in enumerate(each):
        jax.tree.map(np.testing.assert_array_equal, stack.chosen(k), own)
    several = stack.chosen(np.array([2, 0]))
    assert several.choices == 2 and several.colour_count == 5
    np.testing.assert_array_equal(several.status, [each[2].status, each[0].status])
    assert len(joined(each).status) == 27 and joined(each).colour_count == 15
    with pytest.raises(ValueError, match="colour_count 5 exceeds the 4 rays"):
        replace(stack, status=stack.status[:, :4])


@pytest.mark.parametrize("function", [log_likelihood, plain_log_likelihood])
def test_each_block_of_positions_is_given_its_own_choice(function) -> None:
    each = [view(9, 5, seed) for seed in range(3)]
    args = args_of(stacked(each))
    positions = 0.5 * jax.random.normal(jax.random.key(1), (6, args[1].dim(MODEL)))

    def both(args, q):
        value, pullback = jax.vjp(lambda q: function(args, q), q)
        return np.asarray(value), np.asarray(pullback(np.ones(len(q), np.float32))[0])

    value, gradient = both(args, positions)
    for k, own in enumerate(each):
        block = slice(2 * k, 2 * k + 2)
        alone = both((MODEL, args[1], own, faces_of_view(own, args[1])), positions[block])
        np.testing.assert_allclose(value[block], alone[0], rtol=1e-6)
        np.testing.assert_allclose(gradient[block], alone[1], rtol=1e-5, atol=1e-5 * np.abs(alone[1]).max())


def test_positions_that_choices_do_not_divide_are_refused() -> None:
    args = args_of(stacked([view(9, 5, seed) for seed in range(3)]))
    with pytest.raises(ValueError, match="3 choices of pixels do not divide 4 positions"):
        plain_log_likelihood(args, np.zeros((4, args[1].dim(MODEL)), np.float32))


def test_what_a_view_costs_is_the_same_for_each_choice() -> None:
    each = [view(9, 5, seed) for seed in range(3)]
    likelihood = likelihood_settings(CONFIG)
    faces = np.asarray(faces_of_view(stacked(each), likelihood))
    for own, found in zip(each, faces, strict=True):
        np.testing.assert_array_equal(found, faces_of_view(own, likelihood))


@pytest.mark.parametrize("method", ["tempered_smc", "annealed_hmc"])
def test_choices_that_are_alike_change_nothing(method) -> None:
    """Four groups: of six choices four are dealt out, of three one twice."""
    config, own = replace(CONFIG, method=method), view(9, 5)
    expected, _ = infer(jax.random.key(2), MODEL, own, config, stages=3)
    for count in (3, 6):
        found, _ = infer(jax.random.key(2), MODEL, stacked([own] * count), config, stages=3)
        np.testing.assert_array_equal(found.positions, expected.positions)
        np.testing.assert_array_equal(found.log_weights, expected.log_weights)
        np.testing.assert_allclose(found.log_likelihoods, expected.log_likelihoods, rtol=1e-5)


def test_populations_differ_only_in_their_pixels_and_are_compared_at_all() -> None:
    each = [view(9, 5, seed) for seed in range(4)]
    heard = list[StageInfo]()
    found, likelihood = infer(jax.random.key(2), MODEL, stacked(each), CONFIG, stages=3, on_stage=heard.append)
    infer(jax.random.key(2), MODEL, each[1], CONFIG, stages=3, on_stage=heard.append)
    start, alone = (info.log_evidence for info in heard if info.stage == 0)  # later ones use each other's metric
    assert start[1] == pytest.approx(alone[1], rel=1e-5) and not np.isclose(start, alone)[[0, 2, 3]].any()
    of = np.asarray(found.population)
    values = np.mean(
        [log_likelihood((MODEL, likelihood, o, faces_of_view(o, likelihood)), found.positions) for o in each], axis=0
    )
    np.testing.assert_allclose(found.log_likelihoods, values, rtol=1e-5)
    r_hat = split_r_hat(np.stack([values[of == k] for k in range(4)]))
    np.testing.assert_allclose(found.diagnostics.r_hat, r_hat, rtol=1e-4)


@pytest.mark.slow
def test_together_they_are_the_mean_of_each_choice_s_posterior_by_brute_force() -> None:
    """A bagged posterior (Huggins and Miller 2023), here of pixels that contradict each other."""
    scenes = [scene(condition, True) for condition in ("hidden", "half")]
    each = [integrate(log_likelihood, args).histogram() for args in scenes]
    assert total_variation(*each) > 0.5
    model, likelihood, *_ = scenes[0]
    both = stacked([observation for _, _, observation, _ in scenes]).chosen(np.arange(4) % 2)
    args = (model, likelihood, both, faces_of_view(both, likelihood))
    config = TemperedSMCConfig(populations=4, evidence_power=0.0)
    found = [tempered_smc(jax.random.key(seed), log_likelihood, args, 9, config) for seed in (0, 1)]
    q = np.concatenate([np.asarray(p.positions, np.float64) for p in found])
    w = np.concatenate([np.exp(np.asarray(p.log_weights)) for p in found]) / 2
    histogram = yaw_histogram(np.arctan2(q[:, 3], q[:, 2]), w)
    assert total_variation(histogram, np.mean(each, axis=0)) <= 0.1
