"""What a run's folder holds that cannot be read is named, with how to go on."""

from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from probnerf.training.run_folder import RunFolder
from probnerf.training.shape_set import load_shapes


class State(eqx.Module):
    step: jax.Array
    weights: jax.Array


@dataclass(frozen=True)
class Recipe:
    steps: int = 5


def new(size: int = 3) -> State:
    return State(jnp.array(0), jnp.zeros(size))


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    run = RunFolder(tmp_path, Recipe())
    run.resume(new())
    run.record({"step": 2})
    run.save(State(jnp.array(2), jnp.ones(3)))
    return run


def test_a_run_goes_on(run: RunFolder) -> None:
    assert int(run.resume(new()).step) == 2


@pytest.mark.parametrize("content", [b"", b"noise", bytes(500), None])
def test_a_damaged_checkpoint_is_named(run: RunFolder, content: bytes | None) -> None:
    whole = run.checkpoint.read_bytes()
    run.checkpoint.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ValueError, match=r"checkpoint\.eqx is damaged, or of another model .*; remove it") as caught:
        run.resume(new())
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_model_is_named(run: RunFolder) -> None:
    with pytest.raises(ValueError, match="or of another model"):
        run.resume(new(4))


def test_a_damaged_history_is_named(run: RunFolder, tmp_path: Path) -> None:
    (tmp_path / "history.jsonl").write_text('{"step": 2}\n{"st')
    with pytest.raises(ValueError, match=r"history\.jsonl is damaged; remove it"):
        run.resume(new())


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut", b"noise"])
def test_damaged_shapes_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz is no set of shapes .*; remove it and make it again"):
        load_shapes(tmp_path / "a.npz")
