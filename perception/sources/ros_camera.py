"""A CameraInfo message as the camera of the image that it is published with."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.camera import DISTORTION_LENGTHS, Camera

# Drivers' names of lens models, in small letters and nothing between them, by ROS's own.
_MODELS = {
    "plumb_bob": ("plumbbob", "", "none", "brownconrady", "modifiedbrownconrady", "radtan", "radialtangential"),
    "rational_polynomial": ("rationalpolynomial", "rational"),
    "equidistant": ("equidistant", "fisheye", "equi", "kannalabrandt", "kannalabrandt4"),
}
_NAMES = {name: model for model, names in _MODELS.items() for name in names}
_BROWN, _RATIONAL = 5, 8  # coefficients
_INVERSE_PX = 0.3


def is_empty(info: Any) -> bool:
    """Whether a CameraInfo says by an empty K that its camera is not calibrated, as drivers do at their start."""
    return not np.any(_matrices(info)[0])


def to_camera(info: Any, rectified: bool) -> Camera:
    """The camera of a CameraInfo, for the raw image, or for the rectified one (then P holds its matrix).

    Of a sensor that is read in part (`roi`) or binned, it is that of the image: K and P are of all pixels. Raises
    `ValueError` for a lens that is not known.
    """
    K, D, P = _matrices(info)
    if rectified and P.any():
        return _of_image(info, P.reshape(3, 4)[:, :3], np.zeros(_BROWN), "plumb_bob")
    if rectified:  # a driver that leaves P empty publishes what needs no other matrix
        return _of_image(info, K, np.zeros(_BROWN), "plumb_bob")
    name = re.sub("[ _-]", "", info.distortion_model.lower())
    model = _NAMES.get(name, info.distortion_model)
    if not D.any():  # no distortion, whatever the model's name; a fisheye without is one still
        if len(D) not in DISTORTION_LENGTHS.get(model, ()):
            model = "equidistant" if model == "equidistant" else "plumb_bob"
            D = np.zeros(DISTORTION_LENGTHS[model][-1])
        return _of_image(info, K, D, model)
    if name == "inversebrownconrady" and np.isfinite(D).all() and min(K[0, 0], K[1, 1]) > 0:
        return _of_image(info, K, _inverted(K, D, info.width, info.height), "plumb_bob")
    if model == "plumb_bob" and len(D) >= _RATIONAL:
        model = "rational_polynomial"
    return _of_image(info, K, _filled(D, DISTORTION_LENGTHS.get(model, ())), model)


def other_size(info: Any, camera: Camera, image: Any) -> str | None:
    """Words for a CameraInfo whose `camera` has not the size of a raw image; None where it has, or none is known.

    Some drivers crop without a roi, give it in joined pixels, or say `binning` of what is joined already.
    """
    size = getattr(image, "width", camera.width), getattr(image, "height", camera.height)
    if size == (camera.width, camera.height):
        return None
    roi = getattr(info, "roi", None)
    part = f"roi {roi.width}x{roi.height} at {roi.x_offset}, {roi.y_offset}" if roi is not None else "no roi"
    binning = "x".join(str(getattr(info, f"binning_{axis}", 0)) for axis in "xy")
    return (
        f"its camera_info says {info.width}x{info.height} px with {part} (in pixels of the whole sensor) and binning"
        f" {binning}, by which an image is {camera.width}x{camera.height}: mend the driver, or give --camera"
    )


def _filled(D: Float[np.ndarray, "d"], lengths: Sequence[int]) -> Float[np.ndarray, "d"]:
    """The coefficients in the next length that the model has; drivers leave the last zeros out, or add some."""
    if len(D) in lengths:
        return D
    D = np.trim_zeros(D, "b")
    return np.pad(D, (0, next((n - len(D) for n in lengths if n >= len(D)), 0)))


def _inverted(
    K: Float[np.ndarray, "3 3"], D: Float[np.ndarray, "d"], width: int, height: int
) -> Float[np.ndarray, "5"]:
    """Brown's coefficients (k1, k2, p1, p2, k3) of librealsense's inverse lens, whose polynomial takes pixels to rays.

    Brown's lens is linear in them, so that least squares over the picture finds the nearest. Raises `ValueError` where
    that is more than `_INVERSE_PX` off.
    """
    u, v = np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33))
    seen = np.column_stack([(u.ravel() - K[0, 2]) / K[0, 0], (v.ravel() - K[1, 2]) / K[1, 1]])
    coefficients = np.pad(D[:_BROWN], (0, _BROWN - len(D[:_BROWN])))
    true = seen + (_brown_terms(seen) @ coefficients).reshape(-1, 2)
    terms, change = _brown_terms(true), (seen - true).ravel()
    found = np.linalg.lstsq(terms, change, rcond=None)[0]
    off = np.abs((terms @ found - change).reshape(-1, 2) * [K[0, 0], K[1, 1]]).max()
    if not off <= _INVERSE_PX:
        raise ValueError(
            f"the inverse Brown-Conrady lens {D.tolist()} is {off:.1f} px off Brown's; record the rectified image, or"
            " calibrate the camera (farside calibrate)"
        )
    return found


def _brown_terms(xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 5"]:
    """What each of Brown's coefficients (k1, k2, p1, p2, k3) adds to x and y, in turn (m = 2n rows)."""
    x, y = xy.T
    r2 = x * x + y * y
    along_x = (x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3)
    along_y = (y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3)
    return np.stack([along_x, along_y], axis=-1).transpose(1, 2, 0).reshape(-1, _BROWN)


def _matrices(info: Any) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "d"], Float[np.ndarray, "12"]]:
    K, D, P = (getattr(info, name if hasattr(info, name) else name.upper()) for name in "kdp")  # ROS 1 wrote K, D, P
    return np.reshape(K, (3, 3)).astype(np.float64), np.asarray(D, np.float64), np.asarray(P, np.float64)


def _of_image(info: Any, K: Float[np.ndarray, "3 3"], D: Float[np.ndarray, "d"], model: str) -> Camera:
    """With the matrix of the part that was read, and of pixels joined (sensor_msgs/CameraInfo: roi, binning)."""
    width, height, first = info.width, info.height, np.zeros(2)
    roi = getattr(info, "roi", None)
    if roi is not None and roi.width and roi.height:
        width, height, first = roi.width, roi.height, np.array([roi.x_offset, roi.y_offset], np.float64)
    joined = np.array([max(getattr(info, f"binning_{axis}", 1), 1) for axis in "xy"])
    K = K.copy()
    K[:2, 2] -= first
    if (joined > 1).any():
        K[:2, :2] /= joined[:, None]
        K[:2, 2] = (K[:2, 2] + 0.5) / joined - 0.5  # pixel centres are whole numbers
    return Camera(width // int(joined[0]), height // int(joined[1]), K, D, model)
