"""Views of objects as they come, or picked for what they hide, by condition: the first test seeds of each.

- any view: the next objects of the family as they come, any kind, from a random camera. Nothing is selected by what the
  view hides, so a right posterior is calibrated here.
- any view, colour only: the same without depth; the plane is the one that the camera's pose gives.
- any view, pose known: the same, in the object's own cube, as a marker on it would tell it.
- half hidden: as any view, with a carton before them that hides 35 to 65% of their pixels.
- handle hidden: vessels whose handle no pixel shows. They are selected by a truth that the view leaves open (every one
  has a handle): even a right posterior errs here, towards no handle.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import count

import numpy as np

from benchmarks.occluded import carton_seeds, half_hidden
from benchmarks.scene import VesselPicture, VesselView, ViewConfig, place, simulated_camera, vessel_picture, vessel_view
from perception.simulate import Scene, render
from probnerf.families.tabletop import TEST_SEEDS

ANY, COLOUR, KNOWN = "any view", "any view, colour only", "any view, pose known"
HALF, HANDLE = "half hidden", "handle hidden"


def any_view(seed: int) -> VesselPicture:
    """The object of a family seed from a random camera."""
    config = ViewConfig()
    placed, T = place(seed, np.random.default_rng([seed, 47]), config)
    camera = simulated_camera(config)
    return VesselPicture(placed, camera, T, render(Scene((placed,)), camera, T))


def _half(seed: int) -> VesselPicture | None:
    return half_hidden(seed, next(carton_seeds(range(seed + 1, seed + 1000))))


# of each condition: where among the test seeds it begins, and its picture; only those of one begin share objects
SORTS: dict[str, tuple[int, Callable[[int], VesselPicture | None]]] = {
    ANY: (0, any_view),
    COLOUR: (0, any_view),
    KNOWN: (0, any_view),
    HALF: (2000, _half),
    HANDLE: (4000, partial(vessel_picture, handle="hidden")),
}


def views(condition: str, n: int, known: Callable[[int], bool]) -> Iterator[tuple[int, VesselView | None]]:
    """(seed, view) of the first `n` objects; None where `known` says that it is not needed."""
    begin, picture_of = SORTS[condition]
    found = 0
    for number in count(begin):
        if found == n or number >= len(TEST_SEEDS):
            return
        seed = TEST_SEEDS[number]
        if known(seed):
            found += 1
            yield seed, None
            continue
        picture = picture_of(seed)
        try:
            view = None if picture is None else vessel_view(picture, condition != COLOUR, pose_known=condition == KNOWN)
        except ValueError:  # outside perception's range of sizes, or too few pixels
            continue
        if view is not None:
            found += 1
            yield seed, view
