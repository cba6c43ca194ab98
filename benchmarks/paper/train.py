"""Train the ProbNeRF prior of one of the paper's families: `python -m benchmarks.paper.train --family cars`.

It goes through `probnerf.training.elbo`, as `farside train` does, and resumes after a stop with the same command.
"""

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.harness.command import command
from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from benchmarks.paper.families import FAMILIES, SPLITS, shape_set, view_set
from foundation.worker_pool import worker_pool
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import load_prior, recognition_path, save_prior, save_recognition
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training import elbo
from probnerf.training.on_device import shapes_on_device, train_solids
from probnerf.training.pictures import joined_views
from probnerf.training.run_folder import RunFolder
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import ShapeSet, joined, load_shapes

_PART = 50  # objects that one process makes at a time
_CALL = 100  # steps


@dataclass(frozen=True)
class Options:
    """Train a prior of one family."""

    family: Literal["cars", "bodies"] = "cars"
    """What it learns."""
    out: Path | None = None
    """Folder of the run; runs/paper-FAMILY by default."""
    preset: Literal["small", "paper", "tiny"] = "small"
    """Sizes of the model."""
    objects: int = 2458
    """The first of the training seeds; SRN Cars has 2458."""
    pictured: int = 1000
    """Of them, those that are seen in pictures, too."""
    pictures: int = 12
    """Pictures of each."""
    processes: int = 1
    """That make shapes and pictures."""
    on_device: bool = False
    """Draw the solid phase's batches on the accelerator, many steps a call."""
    recipe: tyro.conf.OmitArgPrefixes[TrainConfig] = field(
        default_factory=lambda: TrainConfig(
            steps=12_000, solid_steps=10_000, points=256, colours=128, learning_rate=1.5e-3, level=0.4, kl_warmup=500
        )
    )


def main(options: Options) -> Path:
    """Train, or go on; the path of the weights."""
    family, seeds = FAMILIES[options.family], SPLITS["train"]
    preset = PRESETS[options.preset]
    out = options.out or Path(f"runs/paper-{family.name}")
    kept = out / f"shapes-{family.name}-{options.objects}.npz"
    chosen, count = seeds[: options.objects], min(options.pictured, options.objects)
    with worker_pool(options.processes) as pool:
        if not kept.exists():
            out.mkdir(parents=True, exist_ok=True)
            joined(list(pool.map(partial(shape_set, family), _parts(chosen)))).save(kept)
        solids = load_shapes(kept)
        draw = partial(view_set, family, views=options.pictures, size=preset.image_size)
        views = joined_views(list(pool.map(draw, _parts(seeds[:count]))))
    say(f"{len(solids)} shapes, {len(views.seeds)} x {options.pictures} pictures")
    model = ProbNeRF(preset, np.array([0, options.recipe.seed], np.uint32))  # type: ignore[arg-type]
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    weights = out / "prior.safetensors"
    story = {
        "family": family.name,
        "objects": options.objects,
        "pictured": len(views.seeds),
        "pictures": options.pictures,
        "recipe": asdict(options.recipe),
        "revision": revision(),
    }

    def save(state: elbo.TrainState) -> None:
        save_prior(weights, state.model, story | {"steps": int(state.step)}, half=True)
        save_recognition(recognition_path(weights), state.recognition, load_prior(weights).hash)

    if options.on_device and options.recipe.solid_steps:
        save(_solid_phase(model, solids, likelihood, options.recipe, out))
    for state, metrics in elbo.train(model, [(solids, 1.0)], views, likelihood, options.recipe, out):
        say("  ".join(f"{name} {value:.5g}" for name, value in metrics.items()))
        save(state)
    return weights


def _parts(seeds: range) -> list[range]:
    return [seeds[start : start + _PART] for start in range(0, len(seeds), _PART)]


def _solid_phase(
    model: ProbNeRF, solids: ShapeSet, likelihood: Likelihood, config: TrainConfig, folder: Path
) -> elbo.TrainState:
    """The solid phase with batches drawn on the accelerator. `elbo.train` goes on from its checkpoint."""
    run = RunFolder(folder, config)
    state = run.resume(elbo.initial_state(jax.tree.map(jnp.copy, model), config))
    shapes, count = shapes_on_device([(solids, 1.0)]), min(_CALL, config.solid_steps)
    for step in range(int(state.step), config.solid_steps - count + 1, count):
        state, parts = train_solids((likelihood, config, shapes, count), state)
        if step % (10 * count) == 0:
            metrics = {"step": step + count, "rays": False, **{k: float(v[-1]) for k, v in parts.items()}}
            if not np.isfinite(metrics["loss"]):
                raise FloatingPointError(f"loss is {metrics['loss']} at step {step + count}")
            run.record(metrics)
            run.save(state)
            say("  ".join(f"{name} {value:.5g}" for name, value in metrics.items()))
    run.save(state)
    return state


if __name__ == "__main__":
    command(main, Options)
