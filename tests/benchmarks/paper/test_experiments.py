"""The paper's other experiments, on a tiny model: rows once, and tables of what they say."""

from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks.harness.results import Results, newest
from benchmarks.harness.rows import Row
from benchmarks.measures.frechet import frechet_distance
from benchmarks.paper import decoders, deltas, prior_samples, renderers
from benchmarks.paper.conditioned import PLACES
from benchmarks.paper.experiment import Run
from benchmarks.paper.families import CARS
from benchmarks.paper.methods import HMC, HMC_DELTA, SWEEP, Effort, Question
from benchmarks.paper.rival_answers import keep_training
from benchmarks.rivals.features import Features, FeatureSizes, features_of
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import PRESETS, ProbNeRF

TINY = PRESETS["tiny"]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    prior = Prior(ProbNeRF(TINY, jax.random.key(0)), {"family": "cars"}, "hash")
    return Run(CARS, prior, Results(tmp_path / "rows.jsonl"), 1, Effort(2, 2, 3), quick=True)


def test_prior_samples_have_a_distance_in_named_features(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prior_samples, "COUNTS", (3, 4))
    model = Features(FeatureSizes((4, 4), 4), jax.random.key(0))
    features = prior_samples.FeatureFile(partial(features_of, model), "mine 1234")
    for _ in range(2):  # the second time nothing is made
        prior_samples.measure(run, [], features, (3,))
    names = ["ProbNeRF", prior_samples.OTHERS]
    assert [line["method"] for line in run.results.lines] == [f"{name}{prior_samples.SAMPLES}" for name in names]
    (table,) = prior_samples.tables(run.results.lines, [])
    assert "mine 1234" in table.title and table.header[1] == "n 3"
    assert table.lines[0][0] == "ProbNeRF" and table.lines[0][-1] == "84.6"
    T = np.concatenate([CARS.cameras(seed, 1) for seed in range(1_000_000, 1_000_003)])
    truth = prior_samples._true(run, 0)(3, T)
    other = prior_samples._true(run, 4)(3, T)
    expected = frechet_distance(features_of(model, other), features_of(model, truth))
    assert run.results.lines[1]["distance"] == pytest.approx(expected, abs=1e-3)


def test_inception_s_rows_hide_no_others_and_have_a_table_of_their_own(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(prior_samples, "COUNTS", (3, 4))
    monkeypatch.setattr(prior_samples, "load_inception", lambda path: {})
    monkeypatch.setattr(
        prior_samples, "inception_features", lambda weights, rgb: rgb[:, ::32, ::32].reshape(len(rgb), -1)
    )
    (tmp_path / "inception.npz").write_bytes(b"weights")
    own = prior_samples.FeatureFile(lambda rgb: rgb.mean(axis=(1, 2)), "mine 1234")
    inception = prior_samples.features_in(tmp_path / "none", tmp_path / "inception.npz")
    assert inception is not None and inception.name.startswith("inception ")
    for features in (own, inception):
        prior_samples.measure(run, [], features, (3,))
    assert newest(run.results.lines, run.prior.identity) == run.results.lines
    rows: list[Row] = []
    first, second = prior_samples.tables(run.results.lines, rows)
    assert "mine 1234" in first.title and inception.name in second.title and "mine" not in second.title
    assert [line[0] for line in first.lines] == [line[0] for line in second.lines] == ["ProbNeRF", prior_samples.OTHERS]
    assert [row.metric for row in rows] == ["frechet"] * 2 + ["fid"] * 2


def test_features_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.safetensors: no such network of features; train one with"):
        prior_samples.features_in(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no")
    with pytest.raises(ValueError, match=r"bad.safetensors is not a readable"):
        prior_samples.features_in(tmp_path / "bad.safetensors")


def test_acceptance_is_of_a_draw_with_delta(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, str]] = []

    def told(key, model, rays, position, step, name, iterations, span):
        asked.append((position.size, name))
        assert rays.origin.shape == (renderers.RAYS, 3) and iterations == 3
        nearest = -np.sum((np.asarray(rays.origin) - CARS.middle) * np.asarray(rays.direction), axis=1)
        assert span[0] < nearest.min() and nearest.max() < span[1]
        return np.full(8, 0.25 if float(step) > 0.01 else 0.75)

    monkeypatch.setattr(renderers, "acceptance", told)
    renderers.measure(run)
    model = run.prior.model
    assert asked == [(model.latent + model.field.size, name) for name in renderers.NAMES for _ in renderers.STEPS]
    (table,) = renderers.tables(run.results.lines, [])
    assert table.lines[0][2:] == ["0.75", "0.75", "0.75", "0.25", "0.25"]
    assert renderers.by_step(run.results.lines, "foam")[0.0005] == [0.75]


@pytest.mark.nightly
def test_decoders_are_timed_in_one_run(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = {"ProbNeRF": 0.1, "NeRF-VAE, own sizes": 0.4, "Functa, own sizes": 2.0}
    shown: list[str] = []

    def timed(runs, repeats):
        shown.extend(runs)
        return seconds

    monkeypatch.setattr(decoders, "median_seconds", timed)
    decoders.measure(run, [])
    assert shown == list(seconds)
    lines = {line["method"].removesuffix(decoders.DECODER): line for line in run.results.lines}
    assert lines["NeRF-VAE, own sizes"]["ratio"] == 4.0 and lines["ProbNeRF"]["ratio"] == 1.0
    assert lines["ProbNeRF"]["operations"] == 2 * run.prior.model.field.size
    assert lines["Functa, own sizes"]["operations"] > 2 * 5 * 256 * 256
    (table,) = decoders.tables(run.results.lines, [])
    assert table.lines[-1][0] == "Functa, published"
    keep_training(run, [])  # the same model with other settings: no row hides another
    assert newest(run.results.lines, run.prior.identity) == run.results.lines


def test_a_scale_of_delta_is_another_method_and_delta_moves_by_it(run: Run) -> None:
    effort = run.effort
    settings = [m.settings(effort) for m in (HMC_DELTA, *SWEEP)]
    assert "delta_scale" not in settings[0] and len({s["delta_scale"] for s in settings[1:]}) == len(SWEEP)
    view = deltas.Conditioned(CARS, 2_000_000, PLACES["cars"][1], TINY.image_size)
    found = SWEEP[0].answer(Question(view, run.prior.model, effort, 0))
    assert found.likelihood.delta_scale == SWEEP[0].delta_scale and found.likelihood.sample_delta


def test_the_sweep_is_compared_on_the_same_objects() -> None:
    def line(method: str, thing: int, given: float) -> dict:
        return {"method": method, "condition": deltas.INFORMATIVE, "object": thing, "psnr_given": given} | {
            "psnr_heldout": 1.0,
            "settings": {},
        }

    lines = [line(HMC.name, 0, 10.0), line(HMC.name, 1, 30.0), line(SWEEP[0].name, 0, 12.0)]
    (table,) = deltas.tables(lines, [], range(2))
    assert table.lines[0][:3] == ["0", "1", "10.0"] and table.lines[1][:3] == [f"{SWEEP[0].delta_scale:g}", "1", "12.0"]
    assert table.lines[1][3].startswith("+2.0")
    assert deltas.tables(lines[:2], [], range(2)) == []


def test_others_cars_are_seen_as_the_family_s_are(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    car = CARS.draw(7)
    asked: list[tuple[str, str, str | int]] = []

    def answered(run, method, view, condition, thing, rate):
        assert view.subject is car and view.given.mask.any()
        np.testing.assert_array_equal(view.T_object_camera[0], CARS.camera(view.place.azimuth, view.place.elevation))
        asked.append((method.name, condition, thing))

    monkeypatch.setattr(deltas, "read_road_mesh", lambda folder, name: car)
    monkeypatch.setattr(deltas, "keep_answer", answered)
    deltas.measure_others(run, tmp_path, [])
    assert asked == [
        (method.name, f"other people's cars, {place.name}", "hatchback")
        for place in PLACES["cars"]
        for method in deltas.ON_OTHERS
    ]
