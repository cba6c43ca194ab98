"""Draw the pictures that the rivals learn from: `python -m benchmarks.rivals.pictures --family cars --out FILE`.

Objects and cameras depend on the seed alone, so each split is the same whoever draws it.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.harness.command import command
from benchmarks.harness.progress import say
from benchmarks.paper.families import FAMILIES, TAN_HALF_FOV, seeds_of, view_set
from benchmarks.rivals.picture_set import PictureSet
from foundation.worker_pool import worker_pool
from probnerf.training.pictures import ViewSet

PART = 10  # objects, of one job


@dataclass(frozen=True)
class Options:
    """Draw pictures of a family's objects to train rivals on."""

    out: Path
    """The file, .npz."""
    family: Literal["cars", "bodies"] = "cars"
    """What is drawn."""
    split: str = "train"
    """Of which seeds."""
    count: int = 1500
    """Objects, the first seeds."""
    views: int = 24
    """Pictures of each."""
    size: int = 64
    """px a side."""
    processes: int = os.cpu_count() or 1
    """That draw."""


def draw(family: str, views: int, size: int, seeds: Sequence[int]) -> ViewSet:
    """Random views of these objects of the family of this name."""
    return view_set(FAMILIES[family], seeds, views, size)


def draw_pictures(options: Options) -> PictureSet:
    """All pictures, objects in the order of their seeds."""
    seeds = seeds_of(options.split, options.count)
    parts = [seeds[start : start + PART] for start in range(0, len(seeds), PART)]
    drawn = []
    with worker_pool(options.processes) as pool:
        for views in pool.map(partial(draw, options.family, options.views, options.size), parts):
            drawn.append(views)
            if len(drawn) % 10 == 0 or len(drawn) == len(parts):
                say(f"{min(len(drawn) * PART, len(seeds))} of {len(seeds)}")
    return PictureSet(
        rgb=np.concatenate([each.rgb for each in drawn]),
        range=np.concatenate([each.range.astype(np.float16) for each in drawn]),
        T_object_camera=np.concatenate([each.T_object_camera for each in drawn]),
        tan_half_fov=np.asarray(TAN_HALF_FOV, np.float32),
        seed=np.concatenate([each.seeds.astype(np.int64) for each in drawn]),
        family=np.asarray(options.family),
    )


def main(options: Options) -> Path:
    """Draw and write; the path of the file."""
    draw_pictures(options).save(options.out)
    return options.out


if __name__ == "__main__":
    command(main, Options)
