"""The grids of samples: true pictures first, then draws, then the deviation between them; drawn into a file."""

from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.paper import grids
from benchmarks.paper.conditioned import PLACES, SIZE, Conditioned
from benchmarks.paper.families import CARS
from benchmarks.paper.grids import AHEAD, DOWN, Options, answer_rows, deviation, main, sample_rows
from benchmarks.paper.methods import HMC, PRIOR, Effort
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF

TINY = PRESETS["tiny"]


@pytest.fixture(scope="module")
def model() -> ProbNeRF:
    return ProbNeRF(TINY, jax.random.key(0))


def test_a_map_is_the_deviation_between_draws() -> None:
    shown = np.zeros((2, 3, 3, 3))
    shown[1, 0, 0] = (0.3, 0.3, 0.6)
    found = deviation(shown)
    assert found[0, 0] == pytest.approx(np.sqrt((0.15**2 + 0.15**2 + 0.3**2) / 3.0))
    assert np.count_nonzero(found) == 1


@pytest.mark.nightly
def test_rows_are_truth_draws_and_map(model: ProbNeRF, monkeypatch: pytest.MonkeyPatch, draws: int = 3) -> None:
    monkeypatch.setattr(grids, "DRAWS", draws)
    monkeypatch.setattr(grids, "CHAINS", draws)
    view = Conditioned(CARS, 2_000_000, PLACES["cars"][0], TINY.image_size)
    for method, last in ((PRIOR, False), (HMC, True)):
        given, hidden = answer_rows(view, model, Effort(2, 2, 3), method, last)
        assert given[0].endswith("given") and hidden[0].endswith("hidden side")
        assert [p.shape for p in given[1]] == [(SIZE, SIZE, 3)] * (1 + draws) + [(SIZE, SIZE)]
        np.testing.assert_array_equal(given[1][0], view.given.rgb[0] / 255.0)
        np.testing.assert_array_equal(hidden[1][0], view.held_out.rgb[AHEAD] / 255.0)
        np.testing.assert_allclose(given[1][-1], deviation(np.stack(given[1][1:-1])))


def test_samples_stand_above_true_cars(model: ProbNeRF, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grids, "ACROSS", 2)
    rows = sample_rows(model, CARS)
    assert [label for label, _ in rows] == ["prior"] * (DOWN // 2) + ["true"] * (DOWN // 2)
    assert all(len(shown) == 2 for _, shown in rows)
    assert np.abs(rows[0][1][0] - rows[0][1][1]).max() > 0 and np.abs(rows[-1][1][0] - rows[-1][1][1]).max() > 0


def test_sheets_are_drawn_as_asked(tmp_path: Path, model: ProbNeRF, monkeypatch: pytest.MonkeyPatch) -> None:
    save_prior(tmp_path / "cars.safetensors", model, {"family": "cars"})
    monkeypatch.setattr(grids, "sample_rows", lambda *_: [("a", [np.zeros((4, 4, 3))] * 3), ("b", [np.zeros((4, 4))])])
    main(Options(tmp_path / "docs", "samples", tmp_path / "cars.safetensors"))
    assert [path.name for path in (tmp_path / "docs").iterdir()] == ["bench_paper_grid_samples.png"]
    with pytest.raises(ValueError, match=r"no sheet \['all'\]; there are: samples; answers; annealing"):
        main(Options(tmp_path, "all"))
