"""Faults of depth that follow from what the scene looks like: filled cavities, fattened edges, shadows, blind surfaces.

Each takes a faultless picture and returns what the sensor would see, or which pixels it loses. `sensor_faults.sense`
puts them together.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage.morphology import reconstruction

from calibration.camera import Camera
from perception.simulation.simulated_camera import FaultlessImage

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709
_DEEP = 0.004  # m below its opening from which a pixel counts as inside a cavity
_SMOOTH_STEP = 0.015  # m: a spatial filter averages across less, and keeps edges


def luminance(picture: FaultlessImage) -> Float[np.ndarray, "h w"]:
    """Brightness of each pixel in [0, 1]. It stands for the light that comes back to an active sensor."""
    return picture.rgb @ _LUMINANCE


def cavity_depth(picture: FaultlessImage) -> Float[np.ndarray, "h w"]:
    """How far each object pixel lies behind the opening of the cavity that it is in, m along z; 0 outside cavities.

    A cavity is a basin of larger depth that nearer pixels enclose. It is flooded up to its lowest pass, which for a
    mug is the far rim: there is its opening. (Morphological reconstruction, Vincent 1993.)
    """
    found = np.zeros(picture.depth.shape)
    objects = ndimage.find_objects((picture.label > 0).astype(np.int8))
    if not objects:
        return found
    # One pixel more on each side, through which what is no cavity drains.
    box = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in objects[0])
    depth = picture.depth[box]
    depth = np.where(np.isfinite(depth), depth, 1e3)
    dry = depth.copy()
    dry[1:-1, 1:-1] = depth.min()
    level = reconstruction(dry, depth, method="dilation")
    found[box] = np.where(picture.label[box] > 0, depth - level, 0.0)
    return found


def fill_cavities(picture: FaultlessImage, deep: Float[np.ndarray, "h w"], share: float) -> FaultlessImage:
    """Cavities (`cavity_depth`: `deep`, m) shallower by `share` of the way to their opening, times their brightness.

    Light that is reflected twice inside a bright concave thing (multi-path) blurs the pattern or the phase, and the
    sensor reports its inside too near and too flat: 1 closes a white mug.
    """
    nearer = share * np.clip(luminance(picture), 0.0, 1.0) * deep
    return replace(
        picture,
        depth=picture.depth - nearer,
        nearest=picture.nearest - nearer,
        farthest=picture.farthest - nearer,
    )


def in_cavity(picture: FaultlessImage, deep: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The brightness of pixels inside a cavity (`cavity_depth`); 0 elsewhere."""
    return np.where(deep > _DEEP, np.clip(luminance(picture), 0.0, 1.0), 0.0)


def fatten_edges(picture: FaultlessImage, width: int, step: float) -> FaultlessImage:
    """Foreground depth spread by `width` px over what is behind it, where depth steps by more than `step` (m).

    A matched block that straddles an outline takes the disparity of the side with more texture, mostly the nearer one.
    Colour and label stay. Outlines become sharp: a block has one disparity.
    """
    depth = picture.depth
    for _ in range(width):
        near = ndimage.grey_erosion(depth, (3, 3), mode="nearest")
        with np.errstate(invalid="ignore"):  # beside nothing there may be nothing
            depth = np.where(depth - near > step, near, depth)
    with np.errstate(invalid="ignore"):
        straddles = (picture.farthest - picture.nearest > step) & (depth - picture.nearest < step)
        one = straddles | (depth < picture.depth)
    return replace(
        picture,
        depth=depth,
        nearest=np.where(one, depth, picture.nearest),
        farthest=np.where(one, depth, picture.farthest),
    )


def stereo_shadow(depth: Float[np.ndarray, "h w"], focal: float, baseline: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that the second eye, or the projector, does not see; it is `baseline` m to the right (negative: left).

    A point at depth z and column u falls at u - focal baseline / z in the second picture. It is hidden where something
    on the second eye's side falls further over. So a shadow lies on the far side of the foreground as seen from the
    second eye (left of it for an eye on the right) and is focal |baseline| (1 / z_near - 1 / z_far) px wide.
    """
    if baseline < 0:
        return stereo_shadow(depth[:, ::-1], focal, -baseline)[:, ::-1]
    column = np.arange(depth.shape[1]) - focal * baseline / depth
    rightwards = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    lost = np.zeros(depth.shape, bool)
    lost[:, :-1] = column[:, :-1] > rightwards[:, 1:] + 1.0
    return lost


def mirror_angle(depth: Float[np.ndarray, "h w"], camera: Camera, baseline: float) -> Float[np.ndarray, "h w"]:
    """Degrees between each pixel's normal and the one that would mirror the projector into the eye; NaN: no surface.

    The projector is `baseline` m to the right of the eye. Normals are those of the depth picture.
    """
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()])).reshape(*depth.shape, 3)
    points = rays / rays[..., 2:] * np.where(np.isfinite(depth), depth, np.nan)[..., None]
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    halfway = _unit(-points) + _unit(np.array([baseline, 0.0, 0.0]) - points)
    cosine = np.abs(np.einsum("...i,...i", _unit(normal), _unit(halfway)))
    return np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0)))


def smoothed(depth: Float[np.ndarray, "h w"], lost: Bool[np.ndarray, "h w"], width: float) -> Float[np.ndarray, "h w"]:
    """Depth after the sensor's spatial filter: an average over `width` px that keeps edges and holes (bilateral)."""
    known = np.where(lost | ~np.isfinite(depth), 0.0, depth).astype(np.float32)  # so far off that it has no weight
    averaged = cv2.bilateralFilter(known, 2 * int(np.ceil(2 * width)) + 1, _SMOOTH_STEP, width)
    return np.where(known > 0, averaged, depth)


def _unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
