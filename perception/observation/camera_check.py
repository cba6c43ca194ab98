"""Whether a camera's intrinsics can be those of its picture. If not, later errors would name another cause."""

import numpy as np

from calibration.camera import Camera

_FOCAL = (0.1, 100.0)  # of the picture's width, as lenses have it
_UNSEEN = 0.5  # of the picture's middle; fisheyes see a circle, and of some calibrations the corners have no ray


def check_camera(camera: Camera) -> None:
    """Raises `ValueError` for intrinsics of another resolution, or that can be no camera's."""
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    if not (0 <= cx <= camera.width and 0 <= cy <= camera.height):
        raise ValueError(
            f"the camera's principal point ({cx:.0f}, {cy:.0f}) is outside of the picture of"
            f" {camera.width}x{camera.height} px: its matrix is of another resolution; scale it to this one, or"
            " calibrate at this size"
        )
    f = camera.K[0, 0]
    if not _FOCAL[0] <= f / camera.width <= _FOCAL[1]:
        raise ValueError(
            f"the camera's focal length is {f:.4g} px, which no picture {camera.width} px wide has; give its matrix in"
            " pixels, or calibrate"
        )
    if camera.K_std is not None and not camera.K_std[0, 0] < f:
        raise ValueError(
            f"the camera's focal length is {f:.4g} px with a deviation of {camera.K_std[0, 0]:.4g}: it is not"
            " determined; calibrate again"
        )
    grid = np.meshgrid(*(size * np.linspace(0.375, 0.625, 9) for size in (camera.width, camera.height)))
    unseen = float(np.isnan(camera.rays(np.stack(grid, axis=-1).reshape(-1, 2))).any(axis=1).mean())
    if unseen > _UNSEEN:
        raise ValueError(
            f"the camera's lens ({camera.model} {camera.distortion.tolist()}) has no ray for {100 * unseen:.0f}% of the"
            " picture's middle; calibrate it again, or give a camera file (--camera)"
        )
