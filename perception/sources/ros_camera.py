"""A CameraInfo message as the camera of the image that it is published with."""

from typing import Any

import numpy as np
from jaxtyping import Float

from calibration.camera import Camera

# Drivers' names of lens models, in small letters without spaces and underscores, by ROS's own.
_MODELS = {
    "plumb_bob": ("plumbbob", "", "none", "brownconrady", "modifiedbrownconrady", "radtan", "radialtangential"),
    "rational_polynomial": ("rationalpolynomial", "rational"),
    "equidistant": ("equidistant", "fisheye", "equi", "kannalabrandt", "kannalabrandt4"),
}
_NAMES = {name: model for model, names in _MODELS.items() for name in names}
_BROWN, _RATIONAL = 5, 8  # coefficients


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
    name = info.distortion_model.lower().replace(" ", "").replace("_", "")
    model = _NAMES.get(name, info.distortion_model)
    if not D.any():  # no distortion, whatever the model's name; a fisheye without is one still
        return _of_image(info, K, np.zeros(4 if model == "equidistant" else _BROWN), _plain(model))
    if name == "inversebrownconrady":
        raise ValueError(
            f"distortion model {info.distortion_model!r} maps the other way and is not read; record the rectified"
            " image, or calibrate the camera (farside calibrate)"
        )
    if model == "rational_polynomial" and len(D) <= _BROWN:  # the same lens without its denominator
        D = np.pad(D, (0, _RATIONAL - len(D)))
    elif model == "plumb_bob" and len(D) >= _RATIONAL:
        model = "rational_polynomial"
    return _of_image(info, K, D, model)


def _plain(model: str) -> str:
    return "equidistant" if model == "equidistant" else "plumb_bob"


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
    K[:2, :2] /= joined[:, None]
    K[:2, 2] = (K[:2, 2] + 0.5) / joined - 0.5  # pixel centres are whole numbers
    return Camera(width // int(joined[0]), height // int(joined[1]), K, D, model)
