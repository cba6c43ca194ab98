"""Measures against closed forms, and ranks that are uniform for a calibrated sampler."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.harness.intervals import paired_interval
from benchmarks.measures.metrics import (
    best_of_k_iou,
    coverage,
    energy_score,
    ess_of_weights,
    falsely_free,
    hidden_brier,
    hidden_ece,
    hidden_log_score,
    hidden_nll,
    iou,
    ks_distance,
    mean_iou,
    psnr,
    randomised_rank,
    recall,
    scored_voxels,
    smooth_probability,
    symmetric_chamfer,
)


def test_psnr_of_a_constant_error():
    image = np.full((4, 5, 3), 0.5, np.float32)
    assert psnr(image, image + 0.1) == pytest.approx(20.0, abs=1e-4)
    assert psnr(image, image) == float("inf")


def test_log_score_is_smoothed_alike_and_finite_where_all_hypotheses_are_wrong():
    base, truth = np.array([0.3, 0.3, 0.9]), np.array([True, False, True])
    scored = np.array([True, True, False])
    expected = -0.5 * (np.log(0.02 * 0.3) + np.log(1 - (0.98 + 0.02 * 0.3)))
    assert hidden_nll(np.array([0.0, 1.0, 0.5]), base, truth, scored) == pytest.approx(expected)
    assert hidden_nll(base, base, truth, scored) == pytest.approx(-0.5 * (np.log(0.3) + np.log(0.7)))
    np.testing.assert_allclose(smooth_probability(base, base), base)  # the base rate itself is a fixed point
    assert np.isnan(hidden_nll(base, base, truth, np.zeros(3, bool)))


def test_scored_voxels_are_unseen_and_undecided_by_the_training_set():
    seen = np.array([[[True, False], [False, False]]])
    rate = np.array([[[0.5, 0.5], [0.01, 0.99]]])
    np.testing.assert_array_equal(scored_voxels(seen, rate), [[[False, True], [False, False]]])


def test_brier_and_calibration_error():
    rng = np.random.default_rng(0)
    p = rng.uniform(size=200_000)
    truth, everything = rng.uniform(size=p.size) < p, np.ones(p.size, bool)
    assert hidden_brier(p, truth, everything) == pytest.approx(1 / 6, abs=2e-3)  # E p(1 - p)
    assert hidden_ece(p, truth, everything) < 0.01
    assert hidden_ece(np.ones(4), np.array([1, 0, 0, 0], bool), np.ones(4, bool)) == pytest.approx(0.75)
    assert hidden_log_score(np.array([0.0, 1.0]), np.array([1.0])) == pytest.approx(
        -0.25 * (np.log(0.001) + np.log(0.999)) - 0.5 * np.log(0.001)
    )


def test_overlap_of_boxes():
    truth, half, none = np.zeros((3, 4, 4, 4), bool)
    truth[:2], half[:1] = True, True
    assert iou(half, truth) == 0.5 and iou(none, truth) == 0.0 and iou(none, none) == 1.0
    shapes, weights = np.stack([truth, half, none]), np.array([0.2, 0.5, 0.3])
    assert mean_iou(shapes, weights, truth) == pytest.approx(0.45)
    assert best_of_k_iou(shapes, weights, truth, 1) == pytest.approx(0.45)
    rng = np.random.default_rng(0)
    draws = np.array([1.0, 0.5, 0.0])[rng.choice(3, p=weights, size=(100_000, 3))].max(-1).mean()
    assert best_of_k_iou(shapes, weights, truth, 3) == pytest.approx(draws, abs=5e-3)
    assert recall(half, truth) == 0.5


def test_chamfer_of_shifted_planes():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0], indexing="ij"), -1).reshape(-1, 3)
    assert symmetric_chamfer(grid, grid + np.array([0, 0, 0.3])) == pytest.approx(0.3)
    assert symmetric_chamfer(grid, grid) == 0.0
    # A plane beside half of itself: one direction is exact, the other pays for what is missing.
    half = grid[grid[:, 0] < 10]
    assert symmetric_chamfer(half, grid) == pytest.approx(0.5 * np.mean(np.maximum(grid[:, 0] - 9, 0)))
    assert symmetric_chamfer(grid[:0], grid) == float("inf")


def _zero_or_gamma(rng: np.random.Generator, n: int) -> np.ndarray:
    """Volumes with an atom of 0.6 at zero."""
    return np.where(rng.uniform(size=n) < 0.6, 0.0, rng.gamma(2.0, size=n))


@pytest.mark.parametrize("size", [1, 5, 40])
def test_ranks_of_a_calibrated_sampler_are_uniform_in_spite_of_atoms(size):
    rng = np.random.default_rng(size)
    ranks = np.empty(4000)
    for i in range(ranks.size):
        draws = _zero_or_gamma(rng, size + 1)
        ranks[i] = randomised_rank(draws[1:], np.ones(size), draws[0], rng)
    assert ks_distance(ranks) == pytest.approx(stats.kstest(ranks, "uniform").statistic)
    assert ks_distance(ranks) < 1.63 / np.sqrt(ranks.size)  # the 1% point
    assert coverage(ranks) == pytest.approx(0.9, abs=0.015)


def test_ranks_against_a_weighted_law_are_uniform_and_false_certainty_is_not():
    rng = np.random.default_rng(3)
    values, weights = np.array([0.0, 1.0, 3.0]), np.array([0.5, 0.3, 0.2])
    truths = rng.choice(values, p=weights, size=4000)
    law = [randomised_rank(values, weights, t, rng, truth_weight=0.0) for t in truths]
    sure = [randomised_rank(values, np.array([0.0, 1.0, 0.0]), t, rng) for t in truths]
    assert ks_distance(np.array(law)) < 1.63 / np.sqrt(len(law))
    assert ks_distance(np.array(sure)) > 0.1


def test_falsely_free_counts_only_boxes_given_as_free():
    p_free, occupied = np.array([0.99, 0.97, 0.5, 0.96]), np.array([False, True, True, False])
    assert falsely_free(p_free, occupied) == pytest.approx(1 / 3)
    assert np.isnan(falsely_free(p_free[2:3], occupied[2:3]))


def test_paired_interval_is_students_and_drops_what_has_no_value():
    rng = np.random.default_rng(4)
    a, b = rng.normal(size=12), rng.normal(size=12) + 1.0
    expected = stats.ttest_rel(a, b).confidence_interval(0.95)
    got = paired_interval(np.append(a, np.nan), np.append(b, 0.0))
    assert (got.low, got.high, got.n) == (pytest.approx(expected.low), pytest.approx(expected.high), 12)
    assert got.mean == pytest.approx(np.mean(a - b))
    alone = paired_interval(a[:1], b[:1])
    assert alone.n == 1 and alone.low == -np.inf and alone.high == np.inf


def test_effective_sample_size():
    assert ess_of_weights(np.full(8, 3.0)) == pytest.approx(8)
    assert ess_of_weights(np.array([0.5, 0.5, 0.0])) == pytest.approx(2)


def test_energy_score_is_proper():
    rng = np.random.default_rng(5)
    weights = np.full(400, 1 / 400)
    honest, wide, shifted = (rng.normal(m, s, size=(400, 1)) for m, s in ((0, 1), (0, 4), (2, 1)))
    scores = [
        np.mean([energy_score(x, weights, t) for t in rng.normal(size=(200, 1))]) for x in (honest, wide, shifted)
    ]
    assert scores[0] < min(scores[1:])
    assert energy_score(np.array([[0.0], [2.0]]), np.array([0.5, 0.5]), np.array([0.0])) == pytest.approx(1.0 - 0.5)
