"""What is wrong with an input of the paper's experiments is said in one line, with the remedy."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.harness.command import command
from benchmarks.paper import families, grids
from benchmarks.paper.families import BODIES, CARS, write_srn
from benchmarks.rivals import pictures, train
from benchmarks.rivals.picture_set import PictureSet
from benchmarks.studies import paper
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.training.srn_dataset import read_views


@dataclass(frozen=True)
class _Options:
    name: str = "a"


def test_a_command_says_its_error_in_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    def main(options: _Options) -> str:
        if options.name == "bad":
            raise ValueError("two\nlines")
        return options.name

    monkeypatch.setattr("sys.argv", ["x"])
    command(main, _Options)
    assert capsys.readouterr().err.strip() == "a"
    monkeypatch.setattr("sys.argv", ["x", "--name", "bad"])
    with pytest.raises(SystemExit, match=r"^error: two lines$"):
        command(main, _Options)


def _no_pose(folder: Path) -> None:
    (folder / "pose" / "000001.txt").unlink()


def _wrong_size(folder: Path) -> None:
    path = folder / "intrinsics.txt"
    path.write_text(re.sub(r"16 16\s*$", "32 32\n", path.read_text()))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_no_pose, r"rgb/000001\.png has no pose/000001\.txt; add it"),
        (_wrong_size, r"000000\.png is 16x16 px but intrinsics\.txt says 32x32; correct one"),
    ],
)
def test_a_damaged_data_folder_is_refused(damage: Callable[[Path], None], message: str, tmp_path: Path) -> None:
    write_srn(CARS, 0, tmp_path, 2, 16)
    assert read_views(tmp_path, 16).rgb.shape == (1, 2, 16, 16, 3)
    (folder,) = tmp_path.iterdir()
    damage(folder)
    with pytest.raises(ValueError, match=message) as error:
        read_views(tmp_path, 16)
    assert "\n" not in str(error.value)


def test_an_unknown_split_is_refused(tmp_path: Path) -> None:
    for main, options in (
        (families.main, families.Options(tmp_path / "srn", split="dev")),
        (pictures.main, pictures.Options(tmp_path / "set.npz", split="dev")),
    ):
        with pytest.raises(ValueError, match=r"^no split 'dev'; there are: train, val, test$"):
            main(options)
    with pytest.raises(ValueError, match="0 objects were asked for"):
        families.seeds_of("val", 0)
    assert not list(tmp_path.iterdir())


def test_pictures_of_a_size_that_cannot_be_halved_are_refused(tmp_path: Path) -> None:
    rgb = np.zeros((4, 3, 20, 20, 3), np.uint8)
    poses = np.broadcast_to(np.eye(4, dtype=np.float32), (4, 3, 4, 4))
    PictureSet(rgb, rgb[..., 0].astype(np.float16), poses, np.asarray(0.5, np.float32), np.arange(4)).save(
        tmp_path / "set.npz"
    )
    with pytest.raises(ValueError, match=r"set\.npz has pictures of 20 px; .*--size 32"):
        train.main(train.Options("nerf_vae", tmp_path / "set.npz", tmp_path / "out"))


def test_a_prior_of_another_family_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cars.safetensors"
    save_prior(path, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {"family": BODIES.name})
    monkeypatch.setattr(paper, "weights_of", lambda _: path)
    with pytest.raises(ValueError, match=r"cars\.safetensors was trained on 'bodies', not on 'cars'; train one with"):
        paper.main(paper.Options(tmp_path, families="cars"))


def test_an_unknown_experiment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"no experiment \['magic'\]; there are: gate; posteriors"):
        paper.main(paper.Options(tmp_path, experiments="magic"))


def _asked(**options: Any) -> Callable[[Path], object]:
    return lambda folder: paper.main(paper.Options(folder, results=folder / "rows.jsonl", **options))


@pytest.mark.parametrize(
    ("main", "message"),
    [
        (_asked(n=0), r"^--n is 0; give 1 object or more$"),
        (_asked(rivals=Path("none")), r"^none: no such folder of rivals; train some with"),
        (_asked(features=Path("none")), r"^none: no such network of features; train one with"),
        (_asked(inception=Path("none")), r"^none: no such weights; "),
        (_asked(meshes=Path("none")), r"^none/hatchback/meshes holds no \.obj; give a folder"),
        (_asked(experiments="others"), r"not part of this repository; give a folder of them with --meshes$"),
    ],
)
def test_what_is_not_there_is_refused_before_anything_is_measured(
    main: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        main(tmp_path)
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


def test_grids_are_not_drawn_of_another_family(tmp_path: Path) -> None:
    path = tmp_path / "prior.safetensors"
    save_prior(path, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    with pytest.raises(ValueError, match=r"prior\.safetensors was trained on 'another family', not on 'cars'"):
        grids.main(grids.Options(tmp_path, prior=path))
