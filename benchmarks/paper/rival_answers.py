"""The rivals on the paper's pictures: what is trained, how it answers to one picture, and how it was trained."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.harness.results import Line
from benchmarks.harness.tables import Table, verdict
from benchmarks.paper.conditioned import SIZE, Conditioned
from benchmarks.paper.experiment import Run
from benchmarks.paper.families import Family, render
from benchmarks.paper.judged import DRAWS
from benchmarks.rivals.layers import parameters
from benchmarks.rivals.model import Conditioned as Answering
from benchmarks.rivals.registry import RIVALS, load

TRAINING = "how each was trained"
LEAST_SHOWN = 23.0  # dB: a rival that shows pictures of its own training set worse than this is not healthy
HEALTHY = f"healthy alone: psnr_given_learnt >= {LEAST_SHOWN:g} dB"
HEALTH = ("psnr_given_learnt", "psnr_others_learnt", "psnr_given_new", "psnr_others_new")


@dataclass(frozen=True, eq=False)
class TrainedRival:
    """A rival with its weights."""

    name: str
    model: Any
    story: dict[str, Any]
    digest: str  # of the file

    @property
    def label(self) -> str:
        """Its name in tables."""
        return RIVALS[self.name].label

    @property
    def draws(self) -> bool:
        """Whether answers differ from draw to draw."""
        return RIVALS[self.name].draws

    @property
    def answers(self) -> bool:
        """Whether it answers to a picture at all; a generator only samples."""
        return isinstance(self.model, Answering)

    @cached_property
    def settings(self) -> Line:
        """What its rows keep."""
        return {"weights": self.digest, "draws": DRAWS if self.draws else 1}


def trained_rivals(folder: Path, family: Family) -> list[TrainedRival]:
    """Those of the registry whose weights are in the folder, in its order.

    Raises FileNotFoundError if there is no folder, and ValueError for a file that is no rival, is another rival's, or
    learnt another family.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no such folder of rivals; train some with `python -m benchmarks.rivals.train`"
        )
    found = []
    for name in RIVALS:
        path = folder / f"{name}.safetensors"
        if not path.is_file():
            continue
        model, story = load(path)
        if story["model"] != name:
            raise ValueError(f"{path} holds the rival '{story['model']}', not '{name}'; give it its own name")
        if story.get("family") != family.name:
            raise ValueError(
                f"{path} was trained on '{story.get('family')}', not on '{family.name}'; train it on pictures of"
                f" `python -m benchmarks.rivals.pictures --family {family.name}`"
            )
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:8]
        found.append(TrainedRival(name, model, story, digest))
    return found


def answered(
    rival: TrainedRival, view: Conditioned, seed: int
) -> tuple[Float[np.ndarray, "S s s 3"], Float[np.ndarray, "S v s s 3"]]:
    """Pictures of its draws from the given place and from the held-out ones, in [0, 1].

    It is given the picture at the size that it learnt, and shows the size that all are judged at.
    """
    size, T = int(rival.story["size"]), view.T_object_camera
    given = view.given if size == SIZE else render(view.subject, T, size)
    key = jax.random.fold_in(jax.random.key(seed), view.seed)
    draws = DRAWS if rival.draws else 1
    states = _conditioned(rival.model, jnp.asarray(given.rgb[0]), jnp.asarray(T[0]), key, draws)
    cameras = jnp.asarray(np.concatenate([T, view.held_out.T_object_camera]), jnp.float32)
    shown = [
        np.asarray(shown_by(rival.model, jax.tree.map(lambda a, i=i: a[i], states), cameras)) for i in range(draws)
    ]
    made = np.clip(np.stack(shown).astype(np.float64), 0.0, 1.0)
    return made[:, 0], made[:, 1:]


@partial(jax.jit, static_argnums=4)
def _conditioned(model: Any, picture: Array, T: Array, key: Array, draws: int) -> Any:
    return model.condition(picture, T, key, draws)


@jax.jit
def shown_by(model: Any, state: Any, T_object_camera: Float[Array, "v 4 4"]) -> Float[Array, "v s s 3"]:
    """A rival's pictures at the size that all are judged at."""
    return model.render(state, T_object_camera, SIZE)


def keep_training(run: Run, rivals: Sequence[TrainedRival]) -> None:
    """Add a row for each model: its parameters, what it learnt from, how long, and how well it shows it."""
    learnt = run.prior.metadata
    prior = {
        "parameters": parameters(run.prior.model), "steps": learnt.get("steps", 0), "objects": learnt.get("objects", 0),
        "pictures": learnt.get("pictured", 0) * learnt.get("pictures", 0), "size": run.prior.model.preset.image_size,
        "seconds": learnt.get("seconds", -1.0), "trained_on": learnt.get("machine", "not recorded"),
    }  # fmt: skip
    condition = f"{run.family.name}, {TRAINING}"
    if (line := run.missing("ProbNeRF", {"weights": run.prior.hash}, condition, 0)) is not None:
        run.results.add({**line, **prior})
    for rival in rivals:
        if (line := run.missing(rival.label, rival.settings, condition, 0)) is None:
            continue
        story = rival.story
        run.results.add(
            {
                **line, "parameters": parameters(rival.model), "steps": sum(story["steps"].values()),
                "objects": story["objects"], "pictures": story["objects"] * story["views"], "size": story["size"],
                "seconds": story["seconds"], "trained_on": story["machine"],
                **{name: story[name] for name in HEALTH if name in story},
            }
        )  # fmt: skip


def training_table(lines: Sequence[Line]) -> list[Table]:
    """Sizes and training budgets, and each model's own pictures of what it learnt and of new objects."""
    cells = []
    for line in (line for line in lines if line["condition"].endswith(TRAINING)):
        seconds = f"{line['seconds']:.0f}" if line["seconds"] >= 0 else "not recorded"
        counts = [f"{line[name]:,}" for name in ("parameters", "steps", "objects", "pictures", "size")]
        health = [f"{line[name]:.1f}" if name in line else "" for name in HEALTH]
        gate = verdict(line[HEALTH[0]], least=LEAST_SHOWN) if HEALTH[0] in line else ""
        cells.append([line["method"], *counts, seconds, line["trained_on"], *health, gate])
    if cells:
        missing = [e.label for e in RIVALS.values() if e.label not in [cell[0] for cell in cells]]
        blank = [""] * 6
        cells += [[label, *blank, "no weights: left out", *[""] * (len(HEALTH) + 1)] for label in missing]
    header = ("method", "parameters", "steps", "objects", "pictures", "px", "seconds", "machine", *HEALTH, HEALTHY)
    return [Table(f"Models, {TRAINING}", header, cells)] if cells else []


def unhealthy(lines: Sequence[Line]) -> dict[str, float]:
    """What rivals show of their own training set, dB, where it is below the gate."""
    own = [line for line in lines if line["condition"].endswith(TRAINING) and HEALTH[0] in line]
    return {line["method"]: line[HEALTH[0]] for line in own if line[HEALTH[0]] < LEAST_SHOWN}
