"""The controller: how many runs are made, what stops them, and that a cut leaves the answer before it standing."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from perception.answers.hypotheses import Hypotheses
from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.inference.warm_up import _alone
from perception.observation.segmentation import Segment, segment
from perception.sources.recording import Log
from perception.sources.settings import SHIPPED_LOG
from probnerf.prior.checkpoint import load_prior
from probnerf.settings import InferConfig, quick_smc
from tests.perception.inference.test_tracker import frame_from
from tests.priors import TABLETOP

CONFIG = ControllerConfig(
    # no climbs, which cost the same however many runs
    infer=InferConfig(smc_from_prior=replace(quick_smc(2, 10), start_particles=40), encoder_starts=False),
    hypotheses=8,
    first_hypotheses=4,
    grid=32,
)


def answers_of(config: ControllerConfig, stages: int | None = None) -> tuple[Estimate, list[Hypotheses]]:
    frame, answers = frame_from(0.0), list[Hypotheses]()
    found = estimate(
        frame, segment(frame)[0], load_prior(TABLETOP), config, seed=3, stages=stages, on_answer=answers.append
    )  # fmt: skip
    return found, answers


@pytest.mark.slow
def test_one_run_is_the_answer() -> None:
    found, answers = answers_of(CONFIG)
    assert len(found.log) == 1 and found.log[0].startswith("2 x 10 particles: expected loss")
    assert found.hypotheses is answers[-1] and found.hypotheses.result == "converged"
    assert all(h.result == "underway" for h in answers[:-1]) and len(answers[0].weights) == CONFIG.first_hypotheses
    assert found.posterior.positions.shape[0] == 20
    assert found.parts.keys() >= {"sampling", "publishing"} and min(found.parts.values()) > 0.0
    assert 0.5 * found.seconds < sum(found.parts.values()) <= found.seconds


@pytest.mark.slow
def test_four_runs_answer_together() -> None:
    small, _ = answers_of(CONFIG)
    found, answers = answers_of(replace(CONFIG, runs=4))
    assert [line.split(": expected loss")[0] for line in found.log] == [f"{2 * k} x 10 particles" for k in (1, 2, 3, 4)]
    h = found.hypotheses
    assert h.result == "converged" and len(np.unique(h.population)) + h.diagnostics.failed_populations == 8
    assert found.posterior.positions.shape[0] == 80
    assert h.diagnostics.point_gradients > 2.5 * small.hypotheses.diagnostics.point_gradients
    assert float(np.exp(np.asarray(found.posterior.log_weights, np.float64)).sum()) == pytest.approx(1.0, abs=1e-4)
    # the first run's answer came in full, and after it none that was underway but whole ones
    full = [len(h.weights) == CONFIG.hypotheses for h in answers]
    assert full[full.index(True) :] == [True] * 4


@pytest.mark.slow
def test_a_cut_leaves_the_runs_before_it_and_repeats_bit_for_bit() -> None:
    config = replace(CONFIG, runs=4)
    small, _ = answers_of(CONFIG)
    stages = small.hypotheses.stage + 2
    found, _ = answers_of(config, stages)
    assert found.hypotheses.result == found.posterior.result == "stages" and found.hypotheses.stage == stages
    assert found.log[-1] == "no room for more (stages)"
    np.testing.assert_array_equal(found.hypotheses.opacity, small.hypotheses.opacity)
    again, _ = answers_of(config, stages)
    np.testing.assert_array_equal(again.hypotheses.opacity, found.hypotheses.opacity)
    exact, _ = answers_of(config, small.hypotheses.stage)
    assert exact.hypotheses.result == "stages" and exact.hypotheses.stage == small.hypotheses.stage


@pytest.mark.slow
def test_a_cut_between_later_runs_keeps_all_that_are_whole() -> None:
    config = replace(CONFIG, runs=4)
    each = [answers_of(replace(CONFIG, runs=runs))[0].hypotheses.stage for runs in (2, 3)]
    found, _ = answers_of(config, (each[0] + each[1]) // 2)
    assert found.hypotheses.result == "stages" and found.posterior.positions.shape[0] == 40
    assert len(np.unique(found.hypotheses.population)) + found.hypotheses.diagnostics.failed_populations == 4
    assert found.log[1].startswith("4 x 10 particles: expected loss") and found.log[-1] == "no room for more (stages)"


def test_no_runs_are_refused() -> None:
    with pytest.raises(ValueError, match="runs 0"):
        ControllerConfig(runs=0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_threads_ask_at_once_and_both_are_answered() -> None:
    """From modes and from the prior at once: on two cores the library of eigenvalues would wait for ever, each for the
    thread that the other holds.
    """
    frame, prior = next(iter(Log(SHIPPED_LOG))), load_prior(TABLETOP)
    hidden = segment(frame)[0]
    both = (_alone(hidden), hidden)

    def opacity(seen: Segment) -> np.ndarray:
        return estimate(frame, seen, prior, stages=6).hypotheses.opacity

    expected = [opacity(seen) for seen in both]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(opacity, both))
    np.testing.assert_array_equal(found, expected)
