"""The encoder's input picture, cut out of a frame."""

import numpy as np

from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import Segment
from perception.sources.frame import Frame
from probnerf.geometry import look_at, pinhole_rays
from probnerf.pixel_status import OBJECT, UNKNOWN
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.types import on_device


def crop(frame: Frame, segment: Segment, cube: ObjectFrame, size: int) -> EncoderPicture:
    """The encoder's picture: the frame as seen by a camera at the same place that looks at the cube's centre.

    A rotation of the camera moves no parallax, so this is a look-up: each pixel takes the nearest one of the frame.
    Without depth the object's pixels have colour alone.
    """
    centre = cube.to_cube(np.zeros(3))
    tan_half = ENCODER_RADIUS / float(np.linalg.norm(centre))
    T_view_camera = look_at(centre, np.zeros(3))
    _, directions = pinhole_rays(T_view_camera, 0.5 * size / tan_half, size)
    rays = directions.astype(np.float64) @ cube.T_camera_object[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.round(frame.camera.project(rays)).astype(int)
    height, width = segment.mask.shape
    inside = (rays[:, 2] > 0) & np.all((pixels >= 0) & (pixels < [width, height]), axis=1)
    u, v = np.where(inside[:, None], pixels, 0).T
    status = np.where(inside, segment.status[v, u], UNKNOWN)
    z = np.full(len(v), np.nan, np.float32) if frame.depth is None else frame.depth[v, u]
    range_cube = np.where(np.isfinite(z), z, 0.0) / np.maximum(rays[:, 2], 1e-6) / cube.half_extent
    is_object = status == OBJECT
    return EncoderPicture(
        rgb=on_device((frame.rgb[v, u] / 255.0).reshape(size, size, 3)),
        distance=on_device(np.where(is_object, np.where(np.isfinite(z), range_cube, -1.0), 0.0).reshape(size, size)),
        unknown=on_device((status == UNKNOWN).reshape(size, size)),
        T_view_camera=on_device(T_view_camera),
        tan_half_fov=on_device(tan_half),
    )
