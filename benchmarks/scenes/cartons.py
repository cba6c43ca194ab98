"""Objects that are half hidden from the camera by a carton."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.scenes.vessels import VesselPicture, ViewConfig, place, simulated_camera
from perception.simulation.simulated_camera import PlacedObject, TableScene, render
from probnerf.objects.tabletop import KINDS

HIDDEN = (0.35, 0.65)  # share of the object's pixels that the carton hides


def carton_seeds(seeds: Sequence[int]) -> Iterator[int]:
    """Those of the family seeds that are cartons."""
    return (s for s in seeds if KINDS[int(PlacedObject(s, 0, 0, 0).shape.kind)] == "carton")


def half_hidden(seed: int, carton: int) -> VesselPicture | None:
    """The first of a few draws in which the carton, on the way to the camera, hides as much as it should."""
    config = ViewConfig(elevation=(15.0, 40.0))
    rng, camera = np.random.default_rng([seed, 43]), simulated_camera(config)
    small = simulated_camera(
        replace(config, width=80, height=60, focal=75.0)
    )  # to try a place, a small picture will do
    for _ in range(20):
        placed, T = place(seed, rng, config)
        towards = np.arctan2(T[1, 3] - placed.y, T[0, 3] - placed.x) + rng.uniform(-0.6, 0.6)
        away = placed.half_extent + PlacedObject(carton, 0, 0, 0).half_extent
        at = (placed.x + away * np.cos(towards), placed.y + away * np.sin(towards))
        before = PlacedObject(carton, float(at[0]), float(at[1]), float(rng.uniform(-np.pi, np.pi)))
        alone, shown = (int((render(TableScene(o), small, T).label == 1).sum()) for o in ((placed,), (placed, before)))
        if HIDDEN[0] <= 1.0 - shown / max(alone, 1) <= HIDDEN[1]:
            return VesselPicture(placed, camera, T, render(TableScene((placed, before)), camera, T))
    return None
