"""The controller: what makes the model grow, what stops it, and that a cut leaves the answer before it standing."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from perception.controller import ControllerConfig, Estimate, estimate
from perception.hypotheses import Hypotheses
from perception.segment import segment
from probnerf.infer import InferConfig, quick_smc
from probnerf.store import load_prior
from tests.perception.test_track import frame_from

CONFIG = ControllerConfig(
    # no climbs, which cost every level the same
    infer=InferConfig(smc=replace(quick_smc(), populations=2, particles=32, start_particles=128), encoder_starts=False),
    hypotheses=8,
    first_hypotheses=4,
    grid=32,
    levels=(3, 1),
)


def answers_of(config: ControllerConfig, stages: int | None = None) -> tuple[Estimate, list[Hypotheses]]:
    frame, told = frame_from(0.0), list[Hypotheses]()
    found = estimate(
        frame, segment(frame)[0], load_prior(), config, seed=3, stages=stages, on_answer=told.append
    )  # fmt: skip
    return found, told


@pytest.mark.slow
def test_where_little_is_asked_the_least_level_is_all() -> None:
    found, told = answers_of(replace(CONFIG, unexplained=1.0, tolerance=inf))
    assert len(found.log) == 1 and found.log[0].startswith("2 x 10 particles: error")
    assert found.hypotheses is told[-1] and found.hypotheses.result == "converged"
    assert all(h.result == "underway" for h in told[:-1]) and len(told[0].weights) == CONFIG.first_hypotheses
    assert found.posterior.positions.shape[0] == 20


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{"unexplained": 0.0, "tolerance": inf}, {"unexplained": 1.0, "tolerance": 0.0}])
def test_unexplained_pixels_make_it_grow_and_so_does_error(limits: dict[str, float]) -> None:
    small, _ = answers_of(replace(CONFIG, unexplained=1.0, tolerance=inf))
    found, told = answers_of(replace(CONFIG, **limits))
    assert ["->" in line for line in found.log] == [True, True, False]
    assert "2 x 10 particles -> 2 x 32 particles: error" in found.log[0]
    assert "2 x 32 particles -> 4 x 32 particles: error" in found.log[1]
    h = found.hypotheses
    assert h.result == "converged" and len(np.unique(h.population)) == 4
    assert h.diagnostics["point_gradients"] > 5 * small.hypotheses.diagnostics["point_gradients"]
    assert float(np.exp(np.asarray(found.posterior.log_weights, np.float64)).sum()) == pytest.approx(1.0, abs=1e-4)
    # the least level's answer came in full, and after it none that was underway
    full = [len(t.weights) == CONFIG.hypotheses for t in told]
    assert full[full.index(True) :] == [True] * 3


@pytest.mark.slow
def test_a_cut_leaves_the_answer_before_it_and_repeats_bit_for_bit() -> None:
    config = replace(CONFIG, tolerance=0.0)
    small, _ = answers_of(replace(CONFIG, unexplained=1.0, tolerance=inf))
    stages = small.hypotheses.stage + 2
    found, _ = answers_of(config, stages)
    assert found.hypotheses.result == found.posterior.result == "stages" and found.hypotheses.stage == stages
    assert "cut short (stages)" in found.log[-1]
    np.testing.assert_array_equal(found.hypotheses.opacity, small.hypotheses.opacity)
    again, _ = answers_of(config, stages)
    np.testing.assert_array_equal(again.hypotheses.opacity, found.hypotheses.opacity)
    exact, _ = answers_of(config, small.hypotheses.stage)
    assert exact.hypotheses.result == "stages" and exact.hypotheses.stage == small.hypotheses.stage


def test_levels_that_do_not_fall_are_refused() -> None:
    for levels in ((1, 2), (2, 2), (), (0,)):
        with pytest.raises(ValueError, match="levels"):
            ControllerConfig(levels=levels)
