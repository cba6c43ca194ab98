"""Faults are what they say and leave a frame alone at none; the worst allowed outcome is a flagged answer."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes.conditions import PICTURES_BEGIN, any_view
from benchmarks.scenes.faults import AXES, Axis, noise_frame, occlusion
from benchmarks.scenes.vessels import base_rate, vessel_view
from benchmarks.studies.stability import Options, Seen, look, main
from perception.inference.settings import ControllerConfig
from perception.sources.frame import Frame
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import load_prior

FAULTS = [axis for axis in AXES if axis.fault is not None]
CONFIGURED = [axis for axis in AXES if axis.configured is not None]


@pytest.fixture(scope="module")
def frame() -> Frame:
    return vessel_view(any_view(TEST_SEEDS[PICTURES_BEGIN])).frame


def same(a: Frame, b: Frame) -> bool:
    pairs = [(a.rgb, b.rgb), (a.label, b.label), (a.camera.K, b.camera.K)]
    if a.depth is not None and b.depth is not None:
        pairs.append((a.depth, b.depth))
    return (a.depth is None) == (b.depth is None) and all(
        np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs
    )


@pytest.mark.parametrize("axis", FAULTS, ids=[a.name for a in FAULTS])
def test_a_fault_of_no_size_is_none_and_a_larger_one_is_larger(axis: Axis, frame: Frame) -> None:
    assert same(axis.fault(frame, axis.amounts[0]), frame)
    changed = [axis.fault(frame, amount) for amount in axis.amounts[1:]]
    assert not any(same(f, frame) for f in changed)
    assert all(f.rgb.shape == frame.rgb.shape for f in changed)
    assert all(f.depth is None or f.depth.shape == frame.depth.shape for f in changed)


@pytest.mark.parametrize("axis", CONFIGURED, ids=[a.name for a in CONFIGURED])
def test_how_it_ships_is_the_first_amount(axis: Axis) -> None:
    assert axis.configured(ControllerConfig(), axis.amounts[0]) == ControllerConfig()
    assert all(axis.configured(ControllerConfig(), amount) != ControllerConfig() for amount in axis.amounts[1:])


def test_an_occluder_hides_the_share_that_it_should(frame: Frame) -> None:
    whole = np.count_nonzero(frame.label == 1)
    for amount in (0.3, 0.6, 0.8):
        left = np.count_nonzero(occlusion(frame, amount).label == 1)
        assert left / whole == pytest.approx(1.0 - amount, abs=0.03)


def test_answers_that_are_there_are_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, float]] = []

    def looked(picture, axis: Axis, amount: float, *_) -> Seen:
        asked.append((axis.name, amount))
        return Seen(0.2 + amount, amount > 0.5, p_free=(0.99, 0.1), occupied=(False, True))

    monkeypatch.setattr("benchmarks.studies.stability.look", looked)
    monkeypatch.setattr("benchmarks.studies.stability.base_rate", lambda _: None)
    settings = {"n": 1, "seeds": 1, "axes": "occluded;flying", "results": tmp_path / "kept.jsonl"}
    first = main(Options(tmp_path, **settings)).rows
    assert len(asked) == 1 + 4 + 3  # as it ships once
    again = main(Options(tmp_path, **settings, only_chart=True)).rows
    assert again == first and len(asked) == 8
    monkeypatch.setattr("benchmarks.studies.stability.ControllerConfig", lambda: ControllerConfig(runs=3))
    assert main(Options(tmp_path, **settings, only_chart=True)).rows == first  # whatever ships
    value = {(r.method, r.condition, r.metric): r.value for r in first}
    assert value["occluded, share", "0.6", "hidden_nll_above_shipped"] == pytest.approx(0.6)
    assert value["occluded, share", "0.6", "flagged"] == 1.0 and value["occluded, share", "0.3", "flagged"] == 0.0
    with pytest.raises(ValueError, match="omit --only-chart"):
        main(Options(tmp_path, **{**settings, "n": 2}, only_chart=True))


def test_seeds_are_told_apart_from_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = {(0, 0.0): 0.1, (1, 0.0): 0.1, (0, 8.0): 0.3, (1, 8.0): 0.5}

    def looked(picture, axis: Axis, amount: float, prior, rate, seed: int) -> Seen:
        return Seen(scores.get((seed, amount), 0.2), False, p_free=(0.99,), occupied=(False,))

    monkeypatch.setattr("benchmarks.studies.stability.look", looked)
    monkeypatch.setattr("benchmarks.studies.stability.base_rate", lambda _: None)
    rows = main(Options(tmp_path, n=2, seeds=2, axes="flying", results=tmp_path / "kept.jsonl")).rows
    row = {(r.condition, r.metric): r for r in rows}
    assert row["8", "hidden_nll"].value == pytest.approx(0.4) and row["8", "hidden_nll"].n == 2
    assert row["8", "between_seeds"].value == pytest.approx(np.std([0.3, 0.5], ddof=1))
    assert row["0", "between_seeds"].value == 0.0 and row["8", "flagged"].n == 4


@pytest.mark.slow
def test_a_frame_that_comes_again_takes_no_doubt() -> None:
    prior, rate, picture = load_prior(None), base_rate(128), any_view(TEST_SEEDS[PICTURES_BEGIN])
    axis = next(a for a in AXES if a.repeated)
    once, often = (look(picture, axis, amount, prior, rate, 0) for amount in (1.0, 12.0))
    assert once.hidden_nll == look(picture, AXES[0], 0.0, prior, rate, 0).hidden_nll  # as without a tracker
    assert often == once


@pytest.mark.slow
def test_a_shape_that_is_none_is_flagged_and_nothing_breaks() -> None:
    prior, rate, picture = load_prior(None), base_rate(128), any_view(TEST_SEEDS[PICTURES_BEGIN])
    whole = look(picture, AXES[0], 0.0, prior, rate, 0)
    assert whole.hidden_nll is not None and not whole.flagged
    noise = look(picture, Axis("noise", (0.0, 1.0), noise_frame), 1.0, prior, rate, 0)
    assert noise.flagged and not noise.broken
    hidden = look(picture, Axis("occluded", (0.0, 0.8), occlusion), 0.8, prior, rate, 0)
    assert not hidden.broken and (hidden.flagged or hidden.hidden_nll > whole.hidden_nll)
