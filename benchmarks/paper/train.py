"""Train the ProbNeRF prior of one of the paper's families: `python -m benchmarks.paper.train --family cars`.

It goes through `probnerf.training.elbo`, as `farside train` does, and resumes after a stop with the same command.
"""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from benchmarks.paper.families import FAMILIES, SPLITS, shape_set, view_set
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training import elbo
from probnerf.training.settings import TrainConfig
from probnerf.training.shape_set import load_shapes


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
    if not kept.exists():
        out.mkdir(parents=True, exist_ok=True)
        shape_set(
            family, seeds[: options.objects], lambda done, of: None if done % 200 else say(f"{done} of {of}")
        ).save(kept)
    solids = load_shapes(kept)
    views = view_set(family, seeds[: min(options.pictured, options.objects)], options.pictures, preset.image_size)
    say(f"{len(solids)} shapes, {len(views.seeds)} x {options.pictures} pictures")
    model = ProbNeRF(preset, np.array([0, options.recipe.seed], np.uint32))  # type: ignore[arg-type]
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    state = None
    for state, metrics in elbo.train(model, [(solids, 1.0)], views, likelihood, options.recipe, out):  # noqa: B007
        say("  ".join(f"{name} {value:.5g}" for name, value in metrics.items()))
    weights = out / "prior.safetensors"
    if state is not None:
        story = {
            "family": family.name,
            "objects": options.objects,
            "pictured": len(views.seeds),
            "pictures": options.pictures,
        }
        story |= {"recipe": asdict(options.recipe), "steps": int(state.step), "revision": revision()}
        save_prior(weights, state.model, story, half=True)
    return weights


if __name__ == "__main__":
    say(str(main(tyro.cli(Options))))
