"""One vessel of the test seeds in views that hide its handle and that show it, made once a process."""

from functools import cache

import numpy as np

from benchmarks.scenes.vessels import Handle, VesselPicture, VesselView, base_rate, vessel_picture, vessel_view

VESSEL = 2_000_001


@cache
def picture(handle: Handle = "hidden") -> VesselPicture:
    """The vessel's picture."""
    found = vessel_picture(VESSEL, handle)
    assert found is not None
    return found


@cache
def view(handle: Handle = "hidden", depth: bool = True, pose_known: bool = False) -> VesselView:
    """What perception makes of it."""
    return vessel_view(picture(handle), depth, pose_known=pose_known)


@cache
def rate(pose_known: bool = False) -> np.ndarray:
    """The frequency of occupancy, from few objects."""
    return base_rate(24, pose_known=pose_known)
