"""Whether depth has the scale of a length that is known.

All depth times a factor about the camera is a scene that looks the same, so that no single view shows a wrong scale;
the distance of the support plane does, where the camera's height above it is known.
"""

import numpy as np
from jaxtyping import Float

from perception.observation.settings import PlaneGuess
from perception.sources.frame import Frame

LEAST = 0.02  # relative error of scale that is named
_SAME = (np.cos(np.radians(5.0)), 0.25)  # of a pose whose plane z = `table` is the one seen: normals, relative height


def scale_doubt(frame: Frame, plane: Float[np.ndarray, "4"], guess: PlaneGuess) -> str:
    """What is wrong with the depth that shows this support plane (camera frame, m), or an empty text.

    The height is the given one (`camera_height`), or that of the camera's pose where the pose is about the same plane.
    Named is what is beyond 2% and two standard deviations of the height.
    """
    seen = float(plane[3])
    if guess.camera_height is not None:
        known, source = guess.camera_height, "as given"
    elif frame.T_world_camera is not None:
        known, source = float(frame.T_world_camera[2, 3]) - guess.table, "by its pose"
        aligned = float(frame.T_world_camera[2, :3] @ plane[:3]) > _SAME[0]
        if not (aligned and known > 0 and abs(seen / known - 1.0) < _SAME[1]):
            return ""
    else:
        return ""
    if abs(seen - known) <= max(LEAST * known, 2.0 * guess.height_sigma):
        return ""
    error = 100.0 * (seen / known - 1.0)
    return (
        f"depth shows the camera {seen:.3f} m above the plane that objects stand on, {source} it is {known:.3f} m: "
        f"depth is {abs(error):.0f}% too {'long' if error > 0 else 'short'}, or the height is wrong; calibrate the "
        "depth, or state its relative error (controller.observe.depth_scale_sigma)"
    )
