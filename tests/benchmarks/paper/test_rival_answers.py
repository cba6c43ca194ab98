"""The rivals' answers on the paper's pictures: one interface, with weights of the right family or not at all."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.harness.results import Results
from benchmarks.paper.conditioned import HELD_OUT, PLACES, SIZE, Conditioned
from benchmarks.paper.experiment import Run
from benchmarks.paper.families import BODIES, CARS, TAN_HALF_FOV
from benchmarks.paper.judged import picture_values
from benchmarks.paper.posteriors import keep_rival
from benchmarks.paper.rival_answers import TRAINING, answered, keep_training, trained_rivals, training_table
from benchmarks.rivals.model import save_rival
from benchmarks.rivals.registry import RIVALS
from probnerf.prior.checkpoint import Prior
from probnerf.prior.networks import PRESETS, ProbNeRF

BOX = (-0.7, -0.4, -0.8, 0.7, 0.4, 0.0)
STORY = {"family": "cars", "size": 16, "steps": {"rays": 3}, "objects": 2, "views": 4, "seconds": 1.0, "machine": "one"}


def write(folder: Path, name: str, story: dict[str, Any] | None = None, to: str = "") -> None:
    entry = RIVALS[name]
    sizes = entry.tiny | ({"size": 16} if name == "nerf_vae" else {}) | ({"map_steps": 2} if name == "functa" else {})
    model = entry.model(entry.config(box=BOX, tan_half_fov=TAN_HALF_FOV, **sizes), jax.random.key(0))
    save_rival(folder / f"{to or name}.safetensors", name, model, STORY | (story or {}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("rivals")
    for name in ("functa", "nerf_vae", "pi_gan"):  # no pixelNeRF
        write(found, name)
    return found


@pytest.fixture(scope="module")
def view() -> Conditioned:
    return Conditioned(CARS, 2_000_000, PLACES["cars"][0])


def test_those_without_weights_are_left_out_and_the_table_says_so(folder: Path, tmp_path: Path) -> None:
    assert trained_rivals(tmp_path, CARS) == []
    rivals = trained_rivals(folder, CARS)
    assert [r.name for r in rivals] == ["functa", "nerf_vae", "pi_gan"]
    assert [r.answers for r in rivals] == [True, True, False]
    prior = Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {"family": "cars"}, "hash")
    run = Run(CARS, prior, Results(tmp_path / "rows.jsonl"), 1, None)
    keep_training(run, rivals)
    keep_training(run, rivals)
    assert [line["method"] for line in run.results.lines] == ["ProbNeRF", "Functa", "NeRF-VAE", "pi-GAN"]
    assert all(line["condition"] == f"cars, {TRAINING}" and line["parameters"] > 0 for line in run.results.lines)
    lines = {line[0]: line for line in training_table(run.results.lines)[0].lines}
    assert "left out" in lines["pixelNeRF"][7] and lines["NeRF-VAE"][2:5] == ["3", "2", "8"]


@pytest.mark.nightly
@pytest.mark.parametrize("which", [0, 1])
def test_answers_are_pictures_and_only_draws_differ(
    folder: Path, view: Conditioned, tmp_path: Path, which: int
) -> None:
    prior = Prior(ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {"family": "cars"}, "hash")
    run = Run(CARS, prior, Results(tmp_path / "rows.jsonl"), 1, None)
    for rival in [trained_rivals(folder, CARS)[which]]:
        given, held = answered(rival, view, 0)
        assert given.shape == (len(held), SIZE, SIZE, 3) and held.shape == (len(given), len(HELD_OUT), SIZE, SIZE, 3)
        assert 0.0 <= held.min() and held.max() <= 1.0
        assert (len(held) > 1) == rival.draws
        again, _ = answered(rival, view, 0)
        np.testing.assert_array_equal(given, again)
        keep_rival(run, rival, view, "cars, back", view.seed)
        line = run.results.lines[-1]
        assert ("pixel_sd" in line) == rival.draws and line["settings"]["weights"] == rival.digest
        assert line["psnr_heldout"] == pytest.approx(picture_values(view, given, held)["psnr_heldout"], abs=1e-4)


def test_weights_of_another_family_or_rival_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "nerf_vae")
    with pytest.raises(ValueError, match=r"nerf_vae.safetensors was trained on 'cars', not on 'bodies'; .*--family"):
        trained_rivals(tmp_path, BODIES)
    write(tmp_path, "nerf_vae", to="pixel_nerf")
    with pytest.raises(ValueError, match="holds the rival 'nerf_vae', not 'pixel_nerf'"):
        trained_rivals(tmp_path, CARS)
