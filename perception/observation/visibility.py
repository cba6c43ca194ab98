"""The part of an object's cube that the camera saw."""

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from calibration.camera import Camera
from perception.observation.object_frame import ObjectFrame
from perception.observation.segmentation import Segment, backproject
from perception.observation.without_depth import plane_depth
from perception.sources.frame import Frame
from probnerf.pixel_status import OBJECT
from probnerf.rendering.occupancy import above_plane, voxel_index


def seen_voxels(
    frame: Frame, segment: Segment, cube: ObjectFrame, grid: int = 64
) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels [i_x, i_y, i_z] of the cube that the camera saw: free before the measured end of their ray, or at it.

    "At it": the centre is at most half a voxel's diagonal behind the surface. Not seen: outside the picture, no depth.
    In a frame without any depth a ray ends on the supposed plane where its pixel is FREE of the object; the rays of
    other pixels may end anywhere, so that nothing on them is seen, not even before the object.
    """
    half_diagonal = np.sqrt(3.0) / grid * cube.half_extent
    return _behind_the_end(frame, segment, cube, grid) <= half_diagonal


def surface_voxels(
    frame: Frame, segment: Segment, cube: ObjectFrame, grid: int = 64
) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels above the plane in which a pixel measured the object.

    Pixels at edges of depth (two voxels within their neighbours) are left out: a sensor's may lie between two surfaces.
    None of a frame without depth.
    """
    voxels = np.zeros(grid**3, bool)
    if frame.depth is not None:
        ours = (segment.status == OBJECT) & np.isfinite(frame.depth)
        far = ndimage.maximum_filter(np.where(ours, frame.depth, -np.inf), 3)
        near = ndimage.minimum_filter(np.where(ours, frame.depth, np.inf), 3)
        flat = ours & (far - np.where(ours, near, 0.0) < 4.0 / grid * cube.half_extent)
        points = cube.to_cube(backproject(frame)[flat])
        voxels[voxel_index(points[(np.abs(points) < 1.0).all(axis=1)], grid)] = True
    return voxels.reshape(grid, grid, grid) & above_plane(grid)


def answered_voxels(
    frame: Frame, segment: Segment, cube: ObjectFrame, grid: int = 64
) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels at which shapes must be evaluated: all except those at least two voxels before a measured end and two
    voxels from any other. That space is free for every shape.
    """
    rest = ~(_behind_the_end(frame, segment, cube, grid) <= -4.0 / grid * cube.half_extent)
    return rest | ndimage.binary_dilation(rest & above_plane(grid), iterations=2)


@lru_cache(maxsize=2)  # what is seen of an object, and where its shapes are asked
def _behind_the_end(
    frame: Frame, segment: Segment, cube: ObjectFrame, grid: int
) -> Float[np.ndarray, "grid grid grid"]:
    """How far each voxel's centre lies behind the end of its ray, m; NaN if unknown."""
    points, pixels, inside = _voxels(frame.camera, cube, grid)
    depth = plane_depth(frame.camera, cube.plane, segment.status) if frame.depth is None else frame.depth
    z = depth[pixels[:, 1], pixels[:, 0]]
    distance = np.sqrt(np.einsum("ij,ij->i", points, points))
    with np.errstate(invalid="ignore"):
        behind = np.where(inside, distance * (1.0 - z / points[:, 2]), np.nan)
    behind = behind.reshape(grid, grid, grid)
    behind.flags.writeable = False
    return behind


def inside_view(camera: Camera, cube: ObjectFrame, grid: int = 64) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels [i_x, i_y, i_z] of the cube whose centre falls inside the picture."""
    return _voxels(camera, cube, grid)[2].reshape(grid, grid, grid)


def _voxels(
    camera: Camera, cube: ObjectFrame, grid: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Voxel centres in the camera frame (m), the pixel each falls in (clipped), and whether that is in the picture."""
    # sums along axes: a product of so small a matrix takes longer, and its threads wait for each other on busy cores
    ticks = (-1.0 + (np.arange(grid) + 0.5) * 2.0 / grid) * cube.half_extent
    lattice = np.empty((grid, grid, grid, 3))
    for axis, (a, b, c, d) in enumerate(cube.T_camera_object[:3]):
        lattice[..., axis] = (a * ticks[:, None] + b * ticks)[:, :, None] + (c * ticks + d)
    points = lattice.reshape(-1, 3)
    px = np.round(np.nan_to_num(camera.project(points), nan=-1.0))
    size = np.array([camera.width, camera.height])
    inside = ((px >= 0) & (px < size)).all(axis=1)
    return points, np.clip(px, 0, size - 1).astype(np.intp), inside
