"""`farside train` hands the recipe over, draws the curves, exports the weights, and can be stopped."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import node.commands.train
from node.__main__ import main
from probnerf.geometry import look_at
from probnerf.prior.checkpoint import load_prior, load_recognition
from probnerf.prior.networks import Recognition
from probnerf.training.pictures import ViewSet
from probnerf.training.settings import TrainConfig
from probnerf.training.srn_dataset import NO_RANGE, Instance, write_instance


@dataclass
class State:
    """What of a training state is read."""

    model: Any
    step: int
    recognition: Any


class Trainer:
    """Stands for the training loop; stops with `error` after its first report, where there is one."""

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self.asked: dict[str, Any] = {}

    def __call__(
        self,
        model: Any,
        solids: Any,
        views: ViewSet,
        likelihood: Any,
        config: TrainConfig,
        folder: Path,
        recognition: Any = None,
        mesh: Any = None,
    ) -> Iterator:
        self.asked = {"model": model, "solids": solids, "views": views, "config": config, "likelihood": likelihood}
        self.asked["recognition"] = recognition
        folder.mkdir(parents=True, exist_ok=True)
        for step in (config.steps // 2, config.steps):
            metrics = {"step": step, "loss": 3.0 / step, "fit": -1.0, "kl": 2.0}
            with (folder / "history.jsonl").open("a") as file:
                file.write(json.dumps(metrics) + "\n")
            yield State(model, step, Recognition(4, 4, 8, jax.random.key(0))), metrics
            if self.error is not None:
                raise self.error


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Trainer:
    stand_in = Trainer()
    monkeypatch.setattr(node.commands.train.training, "train", stand_in)
    return stand_in


def run(folder: Path, *more: str) -> int:
    sizes = ["--preset", "tiny", "--objects", "3", "--pictures", "2", "--steps", "10", "--seed", "4"]
    return main(["train", "--out", str(folder), *sizes, *more])


@pytest.mark.slow
def test_the_recipe_is_handed_over_and_the_weights_exported(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture
) -> None:
    folder = tmp_path / "runs" / "a"
    assert run(folder) == 0
    assert trainer.asked["config"] == TrainConfig(steps=10, seed=4)
    views = trainer.asked["views"]
    assert np.array_equal(views.seeds, [0, 1, 2]) and views.rgb.shape == (3, 2, 16, 16, 3)
    assert [len(shapes) for shapes, _ in trainer.asked["solids"]] == [3]
    prior = load_prior(folder / "prior.safetensors", preset="tiny")
    assert prior.metadata["seeds"] == [0, 3] and prior.metadata["steps"] == 10
    assert prior.metadata["recipe"]["seed"] == 4 and prior.metadata["revision"]
    assert load_recognition(folder / "prior.recognition.safetensors", prior).hidden.first.in_features == 4
    learnt = json.loads((folder / "learnt.json").read_text())
    assert learnt == {"objects": 3, "household": 0, "variants": 8, "meshes": []}
    assert (folder / "curves.png").stat().st_size > 1000
    said = capsys.readouterr().out
    assert str(folder / "curves.png") in said and "farside bench prior --prior" in said


@pytest.mark.slow
def test_training_goes_on_from_weights_of_the_same_preset(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture
) -> None:
    assert run(tmp_path / "a") == 0
    weights = tmp_path / "a" / "prior.safetensors"
    assert run(tmp_path / "b", "--start", str(weights), "--seed", "5") == 0
    kernel = load_prior(weights).model.hyper.weight
    assert np.array_equal(trainer.asked["model"].hyper.weight, kernel)
    started = load_prior(tmp_path / "b" / "prior.safetensors").metadata["start"]
    assert started["hash"] == load_prior(weights).hash and started["recipe"]["seed"] == 4
    assert run(tmp_path / "c", "--preset", "small", "--start", str(weights)) == 1
    assert "holds preset 'tiny', not 'small'" in capsys.readouterr().err


def test_pictures_of_ones_own_take_the_place_of_procedural_objects(
    tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture
) -> None:
    rgb, mask = np.zeros((4, 16, 16, 3), np.uint8), np.zeros((4, 16, 16), bool)
    mask[:, 5:11, 6:10] = True
    T = np.stack([look_at(np.array([np.cos(a), np.sin(a), 0.5]), np.zeros(3)) for a in (0, 1, 2, 3)])
    for name in ("one", "two"):
        write_instance(tmp_path / "data", Instance(name, 12.0, (8.0, 8.0), (0.0, 0.0, 0.0), 1.0, rgb, mask, T))
    folder, more = tmp_path / "run", ["--preset", "tiny", "--steps", "10", "--learning-rate", "0.01"]
    assert main(["train", "--data", str(tmp_path / "data"), "--out", str(folder), *more]) == 0
    assert trainer.asked["solids"] == []
    config = TrainConfig(steps=10, learning_rate=0.01, ray_learning_rate=0.01, solid_steps=0)
    assert trainer.asked["config"] == config
    views = trainer.asked["views"]
    np.testing.assert_array_equal(views.range, np.where(np.stack([mask, mask]), NO_RANGE, 0.0))
    story = load_prior(folder / "prior.safetensors", preset="tiny").metadata
    assert (story["family"], story["data"], story["objects"]) == ("srn", "data", 2)
    assert story["recipe"]["solid_steps"] == 0
    capsys.readouterr()
    assert main(["train", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "b")]) == 1
    assert "none does not exist; give a folder of NAME/intrinsics.txt" in capsys.readouterr().err
    assert main(["train", "--data", str(tmp_path / "data"), "--pictures", "0"]) == 1
    assert "--pictures is 0; give 1 or more" in capsys.readouterr().err


def test_ctrl_c_leaves_the_curves(tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture) -> None:
    trainer.error = KeyboardInterrupt()
    assert run(tmp_path) == 130
    assert (tmp_path / "curves.png").is_file() and not (tmp_path / "prior.safetensors").exists()
    assert "the same command continues from the last checkpoint" in capsys.readouterr().out


def test_a_loss_that_is_no_number_is_one_line(tmp_path: Path, trainer: Trainer, capsys: pytest.CaptureFixture) -> None:
    trainer.error = FloatingPointError("loss is nan at step 5; checkpoint.eqx holds an earlier step")
    assert run(tmp_path) == 1
    assert capsys.readouterr().err == f"farside: error: {trainer.error}\n"
    assert run(tmp_path, "--objects", "0") == 1
    assert "--objects is 0; give 1 to 1000000" in capsys.readouterr().err
