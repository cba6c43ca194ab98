"""Training a prior: the views, the run (resumed after a stop), its curves, and the weights at the end."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from node.commands.options import Training
from node.figures.object_figure import draw_training
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.tabletop import TRAIN_SEEDS
from probnerf.prior.checkpoint import load_prior, save_prior
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.rendering import foam
from probnerf.training import elbo as training
from probnerf.training.pictures import ViewSet, draw_views
from probnerf.training.srn_dataset import read_views
from probnerf.training.surface_samples import Solids, draw_solids


def train(options: Training, out: Console, err: Console) -> bool:
    """Train, or continue an earlier run of the same recipe in `options.out`. False after Ctrl-C.

    Raises ValueError if the folder holds another recipe, FloatingPointError if the loss is not finite.
    """
    preset, config, folder = PRESETS[options.preset], options.recipe, options.out
    if options.data is not None:  # there is no phase that trains only the decoder
        config = replace(config, solid_steps=0, ray_learning_rate=config.learning_rate)
    if not 1 <= options.objects <= len(TRAIN_SEEDS):
        raise ValueError(f"--objects is {options.objects}; give 1 to {len(TRAIN_SEEDS)}")
    if options.pictured < 1:
        raise ValueError(f"--pictured is {options.pictured}; give 1 or more")
    if options.pictures is not None and options.pictures < 1:
        raise ValueError(f"--pictures is {options.pictures}; give 1 or more")
    begun = None if options.start is None else load_prior(options.start, preset=options.preset)
    key = np.array([0, config.seed], np.uint32)  # a raw key
    model = ProbNeRF(preset, key) if begun is None else begun.model  # type: ignore[arg-type]
    history, curves, weights = folder / "history.jsonl", folder / "curves.png", folder / "prior.safetensors"
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    state = None
    try:
        with Progress(*columns, TimeRemainingColumn(), console=err, disable=not err.is_terminal) as progress:
            solids, views, story = _material(options, preset.image_size, progress)
            steps = progress.add_task("steps", total=config.steps)
            for state, metrics in training.train(model, solids, views, likelihood, config, folder):  # noqa: B007
                text = "steps  " + "  ".join(f"{k} {v:.4g}" for k, v in metrics.items() if k != "step")
                progress.update(steps, completed=int(metrics["step"]), description=text)
    except KeyboardInterrupt:
        out.print("stopped; the same command continues from the last checkpoint", highlight=False)
        return False
    finally:
        if history.is_file() and (lines := history.read_text(encoding="utf-8").splitlines()):
            draw_training(curves, [json.loads(line) for line in lines])
            out.print(str(curves), highlight=False, soft_wrap=True)
    if state is None:
        out.print(f"{folder} is trained already", highlight=False, soft_wrap=True)
        return True
    story |= {
        "recipe": asdict(config),
        "steps": int(state.step),
        "revision": _revision(),
        "start": None if begun is None else {"hash": begun.hash, **begun.metadata},
        "gate": None,
    }
    save_prior(weights, state.model, story)
    out.print(f"{weights}; judge it with `farside bench prior --prior {weights}`", highlight=False, soft_wrap=True)
    return True


def _material(options: Training, size: int, progress: Progress) -> tuple[Solids | None, ViewSet, dict[str, Any]]:
    """The training data, and their description for the weights' metadata."""

    def advance(task: TaskID) -> Callable[[int, int], None]:
        return lambda done, total: progress.update(task, completed=done, total=total)

    if options.data is not None:
        reading = progress.add_task("objects", total=None)
        views = read_views(options.data, size, options.pictures, advance(reading))
        return None, views, {"family": "srn", "data": options.data.name, "objects": len(views.seeds)}
    sampling = progress.add_task("objects", total=options.objects)
    seeds = np.asarray(TRAIN_SEEDS[: options.objects])
    solids = draw_solids(seeds, progress=advance(sampling))
    pictured, pictures = min(options.pictured, options.objects), options.pictures or 8
    drawing = progress.add_task("pictures", total=pictured)
    views = draw_views(seeds[:pictured], pictures, size, progress=advance(drawing))
    seed_range = [TRAIN_SEEDS.start, TRAIN_SEEDS.start + options.objects]
    return solids, views, {"family": "tabletop", "seeds": seed_range, "pictured": pictured, "pictures": pictures}


def _revision() -> str:
    """The checkout's git revision, with + where files were changed; empty outside a checkout."""
    command = ("git", "-C", str(Path(__file__).parent), "describe", "--always", "--abbrev=12", "--dirty=+")
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
