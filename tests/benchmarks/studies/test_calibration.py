"""Calibration's sums: an error pooled over objects, ranks of draws from the model, the band of uniform samples."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness.results import Results
from benchmarks.measures.metrics import ECE_BINS, uniform_band
from benchmarks.rivals.quick import METHODS, POSTERIOR, RivalConfig
from benchmarks.scenes.conditions import BEHIND, SORTS
from benchmarks.scenes.vessels import pixels_of_handle
from benchmarks.studies.calibration import _answered_by_all, _settings, called_free, pooled_ece
from benchmarks.studies.sbc import CONDITIONS, STATISTICS, Options, drawn_from, identity, main, outside, ranks_of
from perception.inference.settings import ControllerConfig
from probnerf.settings import NetworkConfig


def test_a_pooled_error_lets_objects_that_err_apart_cancel() -> None:
    def line(truth: float) -> dict:
        bins = np.zeros(ECE_BINS)
        bins[7] = 100.0
        return {"voxels": bins.tolist(), "probability": (0.5 * bins).tolist(), "truth": (truth * bins).tolist()}

    assert pooled_ece([line(1.0), line(0.0)])[0] == 0.0
    error, low, high = pooled_ece([line(0.8)] * 9 + [line(0.5)])
    assert error == pytest.approx(0.27) and low <= error <= high


def test_what_is_called_free_at_a_risk() -> None:
    found = called_free(np.array([1.0, 0.96, 0.91, 0.0]), np.array([False, True, False, True]))
    assert (found["wrong_at_0.05"], found["free_at_0.05"]) == (0.5, 0.5)
    assert (found["wrong_at_0.02"], found["free_at_0.02"]) == (0.0, 0.25)
    assert found["wrong_at_0.1"] == pytest.approx(1 / 3)
    assert np.isnan(called_free(np.zeros(2), np.ones(2, bool))["wrong_at_0.2"])


def test_rivals_answers_outlast_a_change_of_the_sampler_and_are_shown_beside_the_new_ones_alone() -> None:
    config, rivals = ControllerConfig(), RivalConfig()
    before = _settings(config, rivals, False)
    other_sampler = _settings(replace(config, runs=2), rivals, False)
    assert [m for m in METHODS if before[m] != other_sampler[m]] == [POSTERIOR]
    other_pixels = _settings(replace(config, infer=replace(config.infer, wall_sigma=0.1)), rivals, False)
    assert all(before[m] != other_pixels[m] for m in METHODS)
    lines = [{"condition": "any view", "object": n, "method": m} for n in (1, 2) for m in METHODS]
    lines = [line for line in lines if (line["object"], line["method"]) != (2, POSTERIOR)]
    assert {line["object"] for line in _answered_by_all(lines)} == {1}


def test_views_with_no_handle_in_sight_are_picked_by_what_is_seen_alone() -> None:
    """One with a handle behind and one without; none that shows its handle, and no can."""
    picture_of = SORTS[BEHIND][1]
    for seed, has_handle in ((1000047, True), (1000009, False)):
        picture = picture_of(seed)
        assert picture is not None and not pixels_of_handle(picture)
        assert bool(picture.placed.shape.has_handle) == has_handle
    assert picture_of(1000003) is None and picture_of(1000000) is None


@pytest.mark.parametrize("n", [20, 200])
def test_the_band_holds_as_many_uniform_samples_as_it_says(n: int) -> None:
    at, low, high = uniform_band(n)
    drawn = np.random.default_rng(7).random((2000, n))
    share = np.stack([(drawn <= a).mean(axis=1) for a in at], axis=1)
    stay = np.mean(np.all((share >= low) & (share <= high), axis=1))
    assert 0.93 < stay < 0.985  # counts are whole numbers: it may hold a little more than 95%
    assert outside(drawn[0] ** 3) > 0.05  # ranks that crowd at one end leave it


def test_ranks_that_are_there_are_not_made_again(tmp_path: Path) -> None:
    kept, ranks = Results(tmp_path / "sbc.jsonl"), np.linspace(0.05, 0.95, 4)
    for number, rank in enumerate(ranks):
        kept.add({**identity(CONDITIONS[0], "weights"), "object": number, "ranks": {"volume": rank}})
    found = main(Options(tmp_path, n=4, conditions="cylinder", results=kept.path))  # nothing to make
    rows = found.rows
    assert {r.n for r in rows} == {4} and found.picture().axes
    assert {r.metric: r.value for r in rows}["coverage90"] == 1.0
    assert len({str(identity(c, "weights")) for c in CONDITIONS}) == len(CONDITIONS)
    with pytest.raises(ValueError, match="has no results of this prior"):
        main(Options(tmp_path, n=4, conditions="shipped prior", results=kept.path, only_chart=True))


@pytest.mark.slow
def test_the_networks_picture_shows_the_truth() -> None:
    """Of most draws the network's density is nats above the prior's at the truth, and at its floor elsewhere."""
    (condition,) = (c for c in CONDITIONS if c.name == "begun at the network, pose known")
    model = condition.model()
    at_truth, elsewhere = [], []
    for seed in range(6):
        truth, _, observation, reference = drawn_from(condition, model, seed)
        assert reference is not None
        at_truth.append(float(reference.over_prior(truth[None])[0]))
        elsewhere.append(float(reference.over_prior(-truth[None])[0]))
        assert np.asarray(observation.pose_sigma).max() == 0.0
    assert np.median(at_truth) > 1.0
    assert np.median(elsewhere) == pytest.approx(np.log(NetworkConfig().prior_share), abs=0.1)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "asked"),
    [("cylinder", set(STATISTICS) - {"delta"}), ("tiny field, delta, pose known", set(STATISTICS) - {"yaw"})],
)
def test_tempered_smc_is_calibrated(name: str, asked: set[str], draws: int = 50) -> None:
    """Processors round otherwise, which draws all ranks anew: a right sampler may fail on one in a hundred."""
    (condition,) = (c for c in CONDITIONS if c.name == name)
    model = condition.model()
    answers = [ranks_of(condition, model, seed) for seed in range(100, 100 + draws)]
    assert {posterior.result for _, posterior in answers} == {"converged"}
    ranks = [found for found, _ in answers]
    assert set(ranks[0]) == asked
    for statistic in asked:
        assert outside(np.array([r[statistic] for r in ranks]), 1.0 - 0.01 / len(asked)) == 0.0, statistic
