"""Training a prior's posterior network: pictures of what the prior learnt, the run, the weights."""

import json
import os
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from node.commands.train import (
    TABLETOP_SHARE,
    drawn_curves,
    household_variants,
    learnt_objects,
    require_mesh_libraries,
    revision,
)
from node.commands.training_options import NetworkTraining
from probnerf.objects.tabletop import TRAIN_SEEDS
from probnerf.prior.checkpoint import (
    load_prior,
    load_recognition,
    network_path,
    recognition_path,
    save_posterior_network,
)
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork
from probnerf.training import posterior_flow as training


def train_network(options: NetworkTraining, out: Console, err: Console) -> bool:
    """Train, or continue an earlier run of the same recipe. False after Ctrl-C.

    Raises FileNotFoundError if the run has no finished prior, ValueError if its network was trained by another recipe
    or training cannot begin at the given one, FloatingPointError if the loss is not finite.
    """
    require_mesh_libraries()
    # only here: it needs them
    from perception.simulation.training_pictures import OBJECTS, PLAIN, VIEWS, PicturePart, draw_parts, picture_set
    from probnerf.training.learnt_objects import Families

    prior_file, folder = options.run / "prior.safetensors", options.run / "network"
    prior = load_prior(prior_file)
    recognition = load_recognition(recognition_path(prior_file), prior)
    learnt = learnt_objects(options.run)
    families = Families(
        tabletop=TRAIN_SEEDS[: learnt["objects"]],
        tabletop_share=TABLETOP_SHARE,
        household=TRAIN_SEEDS[: learnt["household"]],
        household_variants=household_variants(learnt["variants"]),
        folders=tuple(options.run / folder for folder in learnt["meshes"]),
        folder_variants=learnt["variants"],
    )
    told = zlib.crc32(json.dumps([learnt, options.image_size], sort_keys=True).encode())
    size = NetworkSizes(latent=prior.model.latent, image_size=options.image_size)
    network = _first(options, size)
    processes = options.processes or os.cpu_count() or 1
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    state = None
    try:
        with (
            Progress(*columns, TimeRemainingColumn(), console=err, disable=not err.is_terminal) as progress,
            drawn_curves(folder, out),
        ):
            kept, files = options.run / f"pictures-{told:08x}", list[Path]()
            for plain, wanted, each in ((True, options.plain, PLAIN), (False, options.pictures, OBJECTS * VIEWS)):
                count = -(-wanted // each)
                drawing = progress.add_task("plain pictures" if plain else "pictures", total=count)
                for path in draw_parts(kept, range(count), families, size.image_size, processes, plain=plain):
                    files.append(path)
                    progress.advance(drawing)
            pictures = picture_set([PicturePart.load(path) for path in sorted(files)], recognition)
            steps = progress.add_task("steps", total=options.recipe.steps)
            for state, metrics in training.train(  # noqa: B007
                network, pictures, options.recipe, folder, prior.model.flow
            ):
                text = "steps  " + "  ".join(f"{k} {v:.4g}" for k, v in metrics.items() if k != "step")
                progress.update(steps, completed=int(metrics["step"]), description=text)
    except KeyboardInterrupt:
        out.print("stopped; the same command continues from the last checkpoint", highlight=False)
        return False
    if state is None:
        out.print(f"{folder} is trained already", highlight=False, soft_wrap=True)
        return True
    story = {"recipe": asdict(options.recipe), "pictures": len(pictures), "revision": revision()}
    weights = network_path(prior_file)
    save_posterior_network(weights, state.average, prior.hash, story)
    out.print(f"{weights}; every command that reads {prior_file} uses it now", highlight=False, soft_wrap=True)
    return True


def _first(options: NetworkTraining, size: NetworkSizes) -> PosteriorNetwork:
    """The network at the first step: random, or `options.start`'s."""
    if options.start is None:
        key = np.array([0, options.recipe.seed], np.uint32)  # a raw key
        return PosteriorNetwork(size, key)  # type: ignore[arg-type]
    network = load_prior(options.start).network
    if network is None:
        raise ValueError(f"--start {options.start} has no posterior network beside it; leave it out to begin at random")
    if network.sizes != size:
        other = {
            k: f"{v} instead of {asdict(size)[k]}" for k, v in asdict(network.sizes).items() if v != asdict(size)[k]
        }
        raise ValueError(
            f"--start {options.start} has a network of other sizes ({other}); leave it out to begin at random"
        )
    return network
