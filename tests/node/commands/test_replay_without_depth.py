"""`farside replay` without depth: its options reach perception, its picture is drawn, and what is missing is named."""

from dataclasses import replace
from pathlib import Path

import cv2
import jax
import pytest

from node.__main__ import main
from node.figures.object_figure import draw_object
from node.figures.summary import warnings
from perception.observation.segmentation import segment
from perception.simulation.simulated_camera import place_camera
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from tests.node.mugs import mug_hypotheses, table_frame, write_folder

FEW = """
segment: {guess: {camera_height: 0.3, tilt: 32.7}}
controller:
  hypotheses: 4
  grid: 16
  infer:
    lattice: 8
    smc: {populations: 2, particles: 4, start_particles: 8, moves: 1, leapfrog_steps: 1}
"""


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--box", "1", "2", "30", "40"], "nothing that stands on a plane is whole in the box 1 2 30 40"),
        (["--colour-only"], "give camera_height (m) and tilt"),
        (["--colour-only", "--box", "1", "2", "300", "40"], "leaves the picture of 240x180 px"),
        (["--colour-only", "--object", "9"], "no object 9"),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture
) -> None:
    folder, prior = write_folder(tmp_path / "table", table_frame()), tmp_path / "tiny.safetensors"
    save_prior(prior, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    out = tmp_path / "out"
    assert main(["replay", str(folder), "--prior", str(prior), "--out", str(out), *arguments]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("farside: error: ") and says in error
    assert not out.exists()


def test_a_picture_without_depth_is_drawn_and_says_so(tmp_path: Path) -> None:
    T = place_camera((0.42, 0.0, 0.3), (0.0, 0.0, 0.03))
    frame = replace(table_frame(), depth=None, T_world_camera=T)
    found = segment(frame, 1)[0]
    h = mug_hypotheses(frame, found, [0.5, 2.0], [0.5, 0.5])
    assert any(line.startswith("no depth: distance and size are known to") for line in warnings(h))
    draw_object(tmp_path / "mug.png", h, frame, found)
    assert cv2.imread(str(tmp_path / "mug.png")) is not None


@pytest.mark.slow
def test_replay_infers_what_stands_in_the_box(tmp_path: Path) -> None:
    frame = table_frame()
    folder = write_folder(tmp_path / "table", frame)
    (folder / "label.png").unlink()
    prior, config = tmp_path / "tiny.safetensors", tmp_path / "few.yaml"
    save_prior(prior, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    config.write_text(FEW)
    rows, columns = (frame.label == 1).any(axis=1).nonzero()[0], (frame.label == 1).any(axis=0).nonzero()[0]
    box = [columns[0] - 5, rows[0] - 5, columns[-1] + 6, rows[-1] + 6]
    run = ["replay", str(folder), "--prior", str(prior), "--config", str(config), "--stages", "1", "--colour-only"]
    assert main([*run, "--out", str(tmp_path / "out"), "--box", *map(str, box)]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["frame", "object_1.npz", "object_1.png"]
