"""`farside train-network` draws what the prior learnt, trains, and leaves a network that the prior is read with."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest

for library in ("igl", "embreex", "manifold3d"):
    pytest.importorskip(library)

from node.__main__ import main  # noqa: E402
from perception.simulation import training_pictures  # noqa: E402
from probnerf.prior.checkpoint import load_prior, save_prior, save_recognition  # noqa: E402
from probnerf.prior.networks import PRESETS, ProbNeRF, Recognition  # noqa: E402
from probnerf.training import posterior_flow  # noqa: E402
from probnerf.training.settings import PosteriorTrainConfig  # noqa: E402
from probnerf.training.shape_set import DESCRIPTION  # noqa: E402


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder, as `farside train` leaves it."""
    run, tiny = tmp_path_factory.mktemp("run"), PRESETS["tiny"]
    save_prior(run / "prior.safetensors", jax.jit(lambda key: ProbNeRF(tiny, key))(jax.random.key(0)), {})
    recognition = Recognition(DESCRIPTION, tiny.latent, tiny.hyper_hidden, jax.random.key(1))
    save_recognition(run / "prior.recognition.safetensors", recognition, load_prior(run / "prior.safetensors").hash)
    learnt = {"objects": 4, "household": 3, "variants": 8, "meshes": []}
    (run / "learnt.json").write_text(json.dumps(learnt))
    return run


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Drawing and training by stand-ins: what they are asked."""
    found: dict[str, Any] = {}

    def draw_parts(
        folder: Path, numbers: range, families: Any, size: int, processes: int, plain: bool
    ) -> Iterator[Path]:
        found.update(numbers=numbers, families=families, size=size)
        yield from (folder / f"{'plain' if plain else 'part'} {n}" for n in numbers)

    def train(network: Any, pictures: Any, config: PosteriorTrainConfig, folder: Path, prior: Any) -> Iterator:
        found.update(config=config, pictures=pictures, network=network)
        yield SimpleNamespace(average=network), {"step": config.steps, "loss": 1.0}

    monkeypatch.setattr(training_pictures, "draw_parts", draw_parts)
    monkeypatch.setattr(training_pictures.PicturePart, "load", lambda path: path.name)
    monkeypatch.setattr(training_pictures, "picture_set", lambda parts, recognition: parts)
    monkeypatch.setattr(posterior_flow, "train", train)
    return found


def test_the_prior_is_read_with_its_network_afterwards(finished: Path, asked: dict, capsys) -> None:
    arguments = ["--run", str(finished), "--pictures", "200", "--plain", "1600", "--image-size", "16", "--steps", "7"]
    assert main(["train-network", *arguments]) == 0
    assert asked["config"] == PosteriorTrainConfig(steps=7) and asked["pictures"] == [
        "part 0",
        "part 1",
        "plain 0",
        "plain 1",
    ]
    families = asked["families"]
    assert len(families.tabletop) == 4 and len(families.household) == 3 and families.household_variants == 2
    network = load_prior(finished / "prior.safetensors").network
    assert network is not None and network.sizes.image_size == asked["size"] == 16
    assert "prior.network.safetensors" in capsys.readouterr().out


def test_a_folder_without_a_finished_run_is_refused(finished: Path, asked: dict, tmp_path: Path, capsys) -> None:
    assert main(["train-network", "--run", str(tmp_path)]) == 1
    assert "no such prior" in capsys.readouterr().err
    for name in ("prior.safetensors", "prior.recognition.safetensors"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    assert main(["train-network", "--run", str(tmp_path)]) == 1
    assert "learnt.json: no such file" in capsys.readouterr().err
    other = jax.jit(lambda key: ProbNeRF(PRESETS["tiny"], key))(jax.random.key(5))
    save_prior(tmp_path / "prior.safetensors", other, {})
    assert main(["train-network", "--run", str(tmp_path)]) == 1
    assert "belongs to the prior" in capsys.readouterr().err


def test_training_begins_at_an_earlier_network(finished: Path, asked: dict, tmp_path: Path, capsys) -> None:
    arguments = ["train-network", "--pictures", "200", "--plain", "1600", "--image-size", "16", "--steps", "7"]
    for file in finished.glob("*.*"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "prior.network.safetensors").unlink(missing_ok=True)
    prior = str(tmp_path / "prior.safetensors")
    assert main([*arguments, "--run", str(tmp_path), "--start", prior]) == 1
    assert "has no posterior network beside it" in capsys.readouterr().err
    assert main([*arguments, "--run", str(tmp_path), "--seed", "3"]) == 0
    kept = load_prior(tmp_path / "prior.safetensors").network
    assert main([*arguments, "--run", str(tmp_path), "--start", prior, "--seed", "4"]) == 0
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: (a == b).all(), asked["network"], kept)))
    assert main([*arguments[:-3], "32", "--run", str(tmp_path), "--start", prior]) == 1
    assert "{'image_size': '16 instead of 32'}" in capsys.readouterr().err
