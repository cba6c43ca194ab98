"""Views of simulated objects by condition: the first test seeds of each.

- any view: objects of the family in seed order, seen by a random camera. Nothing is selected by what the view hides,
  so a correct posterior is calibrated here.
- any view, colour only: the same without depth. The support plane comes from the camera's pose.
- any view, pose known: the same in the object's own cube, as if a marker on the object gave its pose.
- half hidden: as any view, with a carton in front that hides 35 to 65% of the object's pixels.
- no handle in sight: as any view, of cups, mugs and pitchers without a pixel of a handle. Whether there is a handle
  behind is not used to select them.
- handle hidden: vessels with a handle of which no pixel shows. They are selected by a truth that the view leaves open,
  so even a correct posterior errs here, towards no handle.
"""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import count

import numpy as np
from jaxtyping import Float

from benchmarks.scenes.cartons import carton_seeds, half_hidden
from benchmarks.scenes.vessels import (
    VesselPicture,
    VesselView,
    ViewConfig,
    pixels_of_handle,
    place,
    shows_handle,
    simulated_camera,
    vessel_picture,
    vessel_view,
)
from perception.simulation.simulated_camera import PlacedObject, TableScene, render
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.objects.tabletop_sampler import CUP, MUG, PITCHER

ANY, COLOUR, KNOWN = "any view", "any view, colour only", "any view, pose known"
HALF, BEHIND, HANDLE = "half hidden", "no handle in sight", "handle hidden"


def any_view(seed: int) -> VesselPicture:
    """The object of a family seed from a random camera."""
    placed, T = _stand(seed)
    camera = simulated_camera(ViewConfig())
    return VesselPicture(placed, camera, T, render(TableScene((placed,)), camera, T))


def _stand(seed: int) -> tuple[PlacedObject, Float[np.ndarray, "4 4"]]:
    return place(seed, np.random.default_rng([seed, 47]), ViewConfig())


def _half(seed: int) -> VesselPicture | None:
    return half_hidden(seed, next(carton_seeds(range(seed + 1, seed + 1000))))


def unseen_handle(seed: int) -> PlacedObject | None:
    """The cup, mug or pitcher of a seed as `any_view` sees it, if a small picture shows no handle."""
    placed, T = _stand(seed)
    return None if placed.shape.kind not in (CUP, MUG, PITCHER) or shows_handle(placed, T) else placed


def _no_handle_in_sight(seed: int) -> VesselPicture | None:
    if unseen_handle(seed) is None:
        return None
    picture = any_view(seed)
    return None if pixels_of_handle(picture) else picture


PICTURES_BEGIN = 6000  # of `faultless_pictures` among the test seeds

# of each condition: where among the test seeds it begins, and its picture; only those of one begin share objects
SORTS: dict[str, tuple[int, Callable[[int], VesselPicture | None]]] = {
    ANY: (0, any_view),
    COLOUR: (0, any_view),
    KNOWN: (0, any_view),
    HALF: (2000, _half),
    BEHIND: (6000, _no_handle_in_sight),
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


def faultless_pictures(n: int) -> list[VesselPicture]:
    """The first `n` views that perception does not refuse without any fault."""
    found: list[VesselPicture] = []
    for number in TEST_SEEDS[PICTURES_BEGIN:]:
        if len(found) == n:
            break
        picture = any_view(number)
        try:
            vessel_view(picture)
            found.append(picture)
        except ValueError:
            continue
    return found
