"""The main job with nothing replaced: the shipped recording, a small untrained prior, and few particles."""

from pathlib import Path

import jax
import pytest

from node.__main__ import main
from perception.answers.hypotheses_file import load_scene
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF

FEW = """
controller:
  hypotheses: 4
  grid: 16
  infer:
    lattice: 8
    smc: {populations: 2, particles: 4, start_particles: 8, moves: 1, leapfrog_steps: 1}
"""


@pytest.mark.slow
@pytest.mark.parametrize("method", ["tempered_smc", "annealed_hmc"])
def test_stages_make_a_run_repeatable(tmp_path: Path, method: str, capsys: pytest.CaptureFixture) -> None:
    prior, config = tmp_path / "tiny.safetensors", tmp_path / "few.yaml"
    save_prior(prior, ProbNeRF(PRESETS["tiny"], jax.random.key(0)), {})
    config.write_text(FEW)
    run = ["replay", "--prior", str(prior), "--config", str(config), "--method", method, "--stages", "2"]
    for out in ("first", "second"):
        assert main([*run, "--out", str(tmp_path / out)]) == 0
    assert main([*run, "--out", str(tmp_path / "other"), "--seed", "1", "--object", "1"]) == 0
    assert "object 2" in capsys.readouterr().out
    files = sorted(p.name for p in (tmp_path / "first").iterdir() if p.is_file())
    assert files == ["object_1.npz", "object_1.png", "object_2.npz", "object_2.png"]
    for name in ("object_1.npz", "object_2.npz"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()
    assert (tmp_path / "first" / "object_1.npz").read_bytes() != (tmp_path / "other" / "object_1.npz").read_bytes()
    scene = load_scene(tmp_path / "first")
    assert [h.object_id for h in scene] == [1, 2] and all(h.result == "stages" for h in scene)
