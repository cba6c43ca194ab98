"""The paper's experiments: what a picture shows and hides, that answers are judged by it, and rows made only once."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.harness.machine import ROOT
from benchmarks.harness.results import Line, read_lines
from benchmarks.paper import annealing, gate, posteriors
from benchmarks.paper.annealing import ANNEALING, rear_seeds
from benchmarks.paper.conditioned import HELD_OUT, OBJECT_RAYS, PLACES, SIZE, Conditioned, base_rate, rays_of
from benchmarks.paper.families import BODIES, CARS
from benchmarks.paper.judged import judge, pictures, shapes
from benchmarks.paper.methods import FIXED, HMC, HMC_DELTA, PRIOR, VI_DELTA, Effort, Found, Method, Question
from benchmarks.rivals.methods import weighted_posterior
from benchmarks.studies import paper
from benchmarks.studies.paper import Options, main
from probnerf.inference import likelihood_settings
from probnerf.pixel_status import OBJECT
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering.occupancy import voxel_centres

SHORT = Effort(iterations=2, leapfrog_steps=2, vi_steps=3)
BACK, _ = PLACES["cars"]
TINY = PRESETS["tiny"]


@pytest.fixture(scope="module")
def model() -> ProbNeRF:
    return ProbNeRF(TINY, jax.random.key(0))


@pytest.fixture(scope="module")
def view() -> Conditioned:
    return Conditioned(CARS, 2_000_000, BACK, TINY.image_size)


def test_rays_are_of_the_picture_s_pixels(view: Conditioned) -> None:
    seen = view.observation(0)
    status, rgb = np.asarray(seen.status), np.asarray(seen.rgb)
    assert (status == OBJECT).sum() == OBJECT_RAYS == seen.colour_count
    _, directions = rays_of(view.T_object_camera[0])
    at = [int(np.argmin(np.abs(directions - d).sum(axis=1))) for d in np.asarray(seen.rays.direction)]
    np.testing.assert_allclose(rgb, view.given.rgb[0].reshape(-1, 3)[at] / 255.0, atol=1e-6)
    assert view.given.mask[0].ravel()[at].tolist() == (status == OBJECT).tolist()


def test_of_a_left_half_nothing_else_is_used_or_seen() -> None:
    view = Conditioned(BODIES, 2_000_001, PLACES["bodies"][0], TINY.image_size)
    d = np.asarray(view.observation(0).rays.direction) @ view.T_object_camera[0, :3, :3]
    assert (d[:, 0] < 0).all()  # left of the middle
    assert np.asarray(view.picture.unknown)[:, TINY.image_size // 2 :].all()
    points = voxel_centres(32).reshape(-1, 3) - view.T_object_camera[0, :3, 3]
    right = ((points @ view.T_object_camera[0, :3, :3])[:, 0] > 0.02).reshape(32, 32, 32)
    assert view.hidden[right].all() and not view.hidden[~right].all()


def test_hidden_is_what_lies_behind_the_surface(view: Conditioned) -> None:
    """From behind, the bonnet is hidden, and the space behind the car is not."""
    centres = voxel_centres(32)
    inside, behind = view.solid & view.hidden, (centres[..., 0] < -0.85) & (np.abs(centres[..., 1]) < 0.2)
    assert inside.sum() > 0.8 * view.solid.sum()
    assert not view.hidden[behind & (np.abs(centres[..., 2] + 0.4) < 0.2)].any()


def test_a_perfect_answer_is_worth_more_than_a_wrong_one(view: Conditioned, model: ProbNeRF, monkeypatch: Any) -> None:
    rate = np.clip(0.5 + 0.0 * view.solid, 0.1, 0.9)
    other = Conditioned(CARS, 2_000_004, BACK, TINY.image_size)

    def judged(seen: Conditioned) -> dict[str, float]:
        answers = {1: seen.given.rgb / 255.0, 4: seen.held_out.rgb / 255.0}
        monkeypatch.setattr(
            "benchmarks.paper.judged.pictures", lambda *a: answers[len(a[3])][None].repeat(len(a[2]), 0)
        )
        monkeypatch.setattr("benchmarks.paper.judged.shapes", lambda *a: seen.solid[None].repeat(len(a[2]), 0))
        posterior = weighted_posterior(jnp.zeros((2, model.latent)), np.ones(2), 0.0)
        likelihood = likelihood_settings(Question(seen, model, SHORT, 0).config(False), sample_pose=False)
        return judge(view, model, Found(posterior, likelihood, 0.0), rate).values

    right, wrong = judged(view), judged(other)
    assert right["psnr_given"] == right["psnr_heldout"] == float("inf") and right["pixel_sd"] == 0.0
    assert wrong["psnr_heldout"] < 30 and right["hidden_nll"] < 0.02 < wrong["hidden_nll"]


def test_pictures_are_of_each_camera(view: Conditioned, model: ProbNeRF) -> None:
    likelihood = likelihood_settings(Question(view, model, SHORT, 0).config(False), sample_pose=False)
    made = pictures(model, likelihood, jnp.zeros((1, model.latent)), view.held_out.T_object_camera)
    assert made.shape == (1, len(HELD_OUT), SIZE, SIZE, 3) and made.min() >= 0 and made.max() <= 1
    again = pictures(model, likelihood, jnp.zeros((1, model.latent)), view.held_out.T_object_camera[1:2])
    np.testing.assert_allclose(made[:, 1:2], again, atol=1e-5)
    assert shapes(model, likelihood, jnp.zeros((1, model.latent))).shape == (1, 32, 32, 32)


def test_delta_adds_the_field_s_weights_and_one_temperature_is_one(view: Conditioned, model: ProbNeRF) -> None:
    question = Question(view, model, SHORT, 0)
    dims = {m.name: m.answer(question).posterior.positions.shape[1] for m in (HMC, HMC_DELTA, VI_DELTA)}
    assert dims == {"hmc": 4, "hmc, delta": 4 + model.field.size, "vi, delta": 4 + model.field.size}
    assert np.asarray(FIXED.answer(question).posterior.diagnostics.beta).tolist() == [1.0] * 8
    assert HMC.settings(SHORT) != HMC.settings(Effort()) and HMC.settings(SHORT) != HMC_DELTA.settings(SHORT)


def test_the_base_rate_is_a_share() -> None:
    rate = base_rate(CARS, range(2))
    assert set(np.unique(rate)) == {0.0, 0.5, 1.0}


def test_an_ambulance_is_among_the_vehicles_from_behind() -> None:
    seeds = rear_seeds(8)
    assert len(set(seeds)) == 8 and CARS.draw(seeds[0]).mesh.name == "ambulance"


def test_rows_are_kept_and_summed_up(tmp_path: Path, model: ProbNeRF, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = tmp_path / "cars.safetensors"
    save_prior(weights, model, {"family": "cars"})
    monkeypatch.setattr(paper, "weights_of", lambda f: weights if f.name == "cars" else tmp_path / "none")
    monkeypatch.setattr(paper, "SHORT", SHORT)
    values = {"psnr_given": 20.0, "psnr_heldout": 10.0, "psnr_heldout_of_mean": 11.0, "pixel_sd": 0.1}
    values |= {"hidden_nll": 0.3, "hidden_ece": 0.05}
    monkeypatch.setattr(posteriors, "judge", lambda *_: SimpleNamespace(values=values))
    monkeypatch.setattr(posteriors, "base_rate", lambda *_: np.zeros((2, 2, 2)))
    monkeypatch.setattr(gate, "refit", lambda *_: SimpleNamespace(iou=0.9))
    tints = np.linspace(0.0, 1.0, 8)[:, None, None, None, None]
    monkeypatch.setattr(annealing, "pictures", lambda *_: np.broadcast_to(tints, (8, 1, SIZE, SIZE, 3)))
    asked: list[str] = []

    def noted(method: Method) -> Method:
        def answer(question: Question) -> Found:
            asked.append(method.name)
            return method.answer(question)

        return replace(method, answer=answer)

    monkeypatch.setattr(paper, "METHODS", (noted(HMC), noted(PRIOR)))
    options: dict[str, Any] = {
        "quick": True,
        "rivals": tmp_path,
        "experiments": "gate;posteriors;annealing",
        "families": "cars;bodies",
        "results": tmp_path / "kept.jsonl",
    }
    found = main(Options(tmp_path, **options))
    assert asked == ["hmc", "the prior alone"] * 2
    titles = [t.title for t in found.tables]
    assert titles[0].startswith("The paper's claims") and titles[2] == "z~ fitted to the solid"
    assert titles[4:6] == ["cars, back", "cars, three-quarter view"]
    assert "0.900" in found.tables[2].lines[0][2] and found.tables[2].lines[0][2].endswith("pass")
    value = {(r.condition, r.method, r.metric): r.value for r in found.rows}
    assert value["cars, back", "the prior alone", "hidden_nll_above_hmc"] == 0.0
    assert value[ANNEALING, "hmc", "psnr_given, best"] > value[ANNEALING, "hmc", "psnr_given, worst"]
    assert found.picture is not None and found.picture().axes
    assert main(Options(tmp_path, **options)).rows == found.rows and len(asked) == 4
    small = {**options, "quick": False, "small": True, "n": 1}
    again = main(Options(tmp_path, **small))
    assert len(asked) == 8 and again.tables[-1].lines[0] == ["psnr_given", "dB", "4", "0.0000", "0.0000"]
    with pytest.raises(ValueError, match=r"no family \['boats'\]; there are: cars; bodies"):
        main(Options(tmp_path, families="boats"))
    monkeypatch.setattr(paper, "weights_of", lambda _: tmp_path / "none")
    with pytest.raises(ValueError, match="train one with"):
        main(Options(tmp_path))


@pytest.mark.slow
def test_a_killed_run_goes_on_and_has_the_same_rows(tmp_path: Path) -> None:
    """`--small`, killed when it has fitted one object of three, and begun again; beside a run that nothing ended."""

    def begun(name: str) -> subprocess.Popen:
        asked = ["--small", "--n", "3", "--experiments", "gate", "--out", str(tmp_path / name)]
        command = [sys.executable, "-m", "farside", "bench", "paper", *asked]
        path, none = {**os.environ, "PYTHONPATH": str(ROOT)}, subprocess.DEVNULL
        return subprocess.Popen(command, cwd=ROOT, env=path, stdout=none, stderr=none)

    def rows(name: str) -> list[Line]:
        lines = read_lines(tmp_path / name / "paper-small.jsonl")
        return [{k: v for k, v in line.items() if k not in ("machine", "revision")} for line in lines]

    def fitted(name: str) -> int:
        return sum("iou" in line for line in rows(name))

    with begun("killed") as killed:
        while fitted("killed") < 1:
            assert killed.poll() is None
            time.sleep(0.02)
        killed.kill()
    assert fitted("killed") < 3
    for name in ("killed", "whole"):
        with begun(name) as run:
            assert run.wait() == 0
    assert fitted("killed") == 3 and rows("killed") == rows("whole")
