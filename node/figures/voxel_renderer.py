"""Solid voxel grids as shaded pictures, by marching rays in NumPy. Cube units, view frame (`probnerf.types`).

A viewpoint looks at the cube's centre; pictures are square. Symbols: G voxels per axis, s pixels per side.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped
from scipy import ndimage

from calibration.camera import Camera
from perception.answers.hypotheses import Hypotheses
from perception.observation.object_frame import ObjectFrame
from probnerf.geometry import look_at, pinhole_rays
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.rendering.voxel_rays import met, nearest
from probnerf.types import BASE_Z

RADIUS = 1.15  # a picture shows this much around the cube's centre
SEEN, UNSEEN = np.array([0.62, 0.70, 0.78]), np.array([0.95, 0.60, 0.28])  # paint of surface the camera saw, or not
STATUS = {OBJECT: ("object", "#2ca02c"), FREE: ("free", "#4f8fd0"), UNKNOWN: ("unknown", "#303030")}  # of a pixel
_GROUND = np.array([0.93, 0.93, 0.92])
_HIGHEST = np.deg2rad(35.0)  # elevation from which the far side is shown
_STEP = 0.75  # voxels
_LEAST_PART = 0.01  # of the largest part's voxels; smaller ones are not drawn


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A square picture's rays."""

    T_cube_camera: Float[np.ndarray, "4 4"]
    directions: Float[np.ndarray, "n 3"]  # unit, row by row
    size: int

    @property
    def origin(self) -> Float[np.ndarray, "3"]:
        """The camera's place."""
        return self.T_cube_camera[:3, 3]


def viewpoint(frame: ObjectFrame, size: int, behind: bool = False) -> Viewpoint:
    """The camera's own viewpoint, turned to the cube's centre; or the opposite one, from at most 35 degrees above."""
    position = frame.to_cube(np.zeros(3))
    distance = float(np.linalg.norm(position))
    if behind:
        elevation = min(float(np.arcsin(position[2] / distance)), _HIGHEST)
        away = -position[:2] / max(float(np.linalg.norm(position[:2])), 1e-9)
        position = distance * np.array([*(np.cos(elevation) * away), np.sin(elevation)])
    return _viewpoint(position, size)


def orbit(frame: ObjectFrame, size: int, steps: int) -> list[Viewpoint]:
    """Viewpoints all around the cube, the first on the camera's side, from at most 35 degrees above."""
    position = frame.to_cube(np.zeros(3))
    distance = float(np.linalg.norm(position))
    elevation = min(float(np.arcsin(position[2] / distance)), _HIGHEST)
    azimuth = float(np.arctan2(position[1], position[0])) + 2.0 * np.pi * np.arange(steps) / steps
    across = np.cos(elevation) * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    return [_viewpoint(distance * np.array([x, y, np.sin(elevation)]), size) for x, y in across]


def _viewpoint(position: Float[np.ndarray, "3"], size: int) -> Viewpoint:
    """A camera at `position` (cube units) that looks at the cube's centre."""
    T = look_at(position, np.zeros(3))
    _, directions = pinhole_rays(T, 0.5 * size * float(np.linalg.norm(position)) / RADIUS, size)
    return Viewpoint(T, directions.astype(np.float64), size)


def look_up(image: np.ndarray, camera: Camera, frame: ObjectFrame, view: Viewpoint, outside: float) -> np.ndarray:
    """A frame's picture (or map) resampled along the viewpoint's rays: a crop, rotated to the cube's centre.

    Only for a viewpoint at the camera's position, where a rotation has no parallax. `outside` fills pixels beyond the
    picture.
    """
    rays = view.directions @ frame.T_camera_object[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.nan_to_num(np.round(camera.project(rays)), nan=-1.0)
    inside = (rays[:, 2] > 0) & ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    u, v = np.where(inside[:, None], pixels, 0).astype(int).T
    found = np.where(inside.reshape(-1, *[1] * (image.ndim - 2)), image[v, u], outside)
    return found.reshape(view.size, view.size, *image.shape[2:])


def level(h: Hypotheses, index: int) -> Float[np.ndarray, "G G G"]:
    """A field whose surface at 1/2 is that of a hypothesis: its walls' opacity, which places the surface between
    voxels, and 1 inside. Parts of less than a hundredth of the largest one are left out.
    """
    solid = h.solid[index]
    parts, _ = ndimage.label(solid, np.ones((3, 3, 3)))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    solid = solid & (sizes >= _LEAST_PART * sizes.max())[parts]
    opacity = h.opacity[index].astype(np.float32) / 255.0
    inside = ndimage.binary_erosion(solid)
    outside = np.where(sizes[parts] == 0, np.minimum(opacity, 0.45), 0.0)
    return np.where(solid, np.where(inside, 1.0, np.maximum(opacity, 0.55)), outside)


def shade(
    h: Hypotheses, shape: Shaped[np.ndarray, "G G G"], view: Viewpoint, base: float = BASE_Z
) -> Float[np.ndarray, "s s 3"]:
    """A shape (`level`, or which voxels are solid) on the plane at height `base`, lit from above left; grey where the
    camera saw it, orange elsewhere.
    """
    solid = shape >= 0.5
    rgb = np.ones((len(view.directions), 3))
    ground = _meet_ground(view, base)
    with np.errstate(invalid="ignore"):
        on_ground = view.origin + ground[:, None] * view.directions
    lit = np.isfinite(ground) & (np.abs(on_ground[:, :2]) < 1.0).all(axis=1)
    low = np.asarray(solid[:, :, : int(0.3 * solid.shape[2])].any(axis=2), np.float32)
    for _ in range(3):
        low = _blurred(low)
    rgb[lit] = _GROUND * (1.0 - 0.35 * nearest(np.pad(low, 1), *on_ground[lit][:, :2].T))[:, None]
    t, normals = march(shape, view)
    hit = np.isfinite(t) & ~(ground < t - 0.03)
    points = view.origin + t[hit, None] * view.directions[hit]
    # Was the space in front of the surface seen? The surface itself is within the noise of depth.
    before = points + 2.5 / solid.shape[0] * normals[hit]
    seen = _trilinear(_blurred(_blurred(h.seen.astype(np.float32))), before) >= 0.5
    paint = np.where(seen[:, None], SEEN, UNSEEN)
    T = view.T_cube_camera
    light = T[:3, :3] @ np.array([-0.5, -0.7, -0.6])  # to the left, up, towards the viewer
    light = light / np.linalg.norm(light)
    facing = np.clip(normals[hit] @ light, 0.0, 1.0)
    rim = np.clip(-np.einsum("ij,ij->i", normals[hit], view.directions[hit]), 0.0, 1.0)
    rgb[hit] = paint * (0.42 + 0.5 * facing + 0.18 * rim)[:, None]
    return np.clip(rgb, 0.0, 1.0).reshape(view.size, view.size, 3)


def march(
    shape: Shaped[np.ndarray, "G G G"], view: Viewpoint
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Distance to the first surface along each ray (inf: none) and its outward unit normal."""
    solid = shape >= 0.5
    t_hit, normals = np.full(len(view.directions), np.inf), np.zeros((len(view.directions), 3))
    if not solid.any():
        return t_hit, normals
    grid = solid.shape[0]
    field = _blurred(shape.astype(np.float32))
    occupied = np.argwhere(solid)
    low, high = -1.0 + (occupied.min(axis=0) - 1) * 2.0 / grid, -1.0 + (occupied.max(axis=0) + 2) * 2.0 / grid
    step = _STEP * 2.0 / grid
    fine = np.pad(_doubled(field) >= 0.5, 1)  # else an outline has steps of a voxel
    for rays, t, inside in met(fine, view.origin, view.directions, 2.0 * _STEP, low=low, high=high):
        hit = np.flatnonzero(inside.any(axis=1))
        t_hit[rays[hit]] = t[hit, inside[hit].argmax(axis=1)]
    chosen = np.flatnonzero(np.isfinite(t_hit))
    before, after = t_hit[chosen] - 1.5 * step, t_hit[chosen] + 0.5 * step
    for _ in range(6):  # bisection, on the field between voxel centres
        middle = 0.5 * (before + after)
        beyond = _trilinear(field, view.origin + middle[:, None] * view.directions[chosen]) >= 0.5
        before, after = np.where(beyond, before, middle), np.where(beyond, middle, after)
    t_hit[chosen] = after
    soft = _blurred(_blurred(field))
    points = view.origin + after[:, None] * view.directions[chosen]
    gradient = np.stack([_trilinear(g, points) for g in np.gradient(soft)], axis=-1)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals[chosen] = np.where(length > 1e-6, -gradient / np.maximum(length, 1e-6), -view.directions[chosen])
    return t_hit, normals


def largest_along(values: Float[np.ndarray, "G G G"], view: Viewpoint) -> Float[np.ndarray, "s s"]:
    """The largest value that each ray meets in the cube (0 where it meets none)."""
    out = np.zeros(len(view.directions))
    for rays, _, along in met(np.pad(values, 1), view.origin, view.directions, 1.0):
        out[rays] = along.max(axis=1)
    return out.reshape(view.size, view.size)


def _meet_ground(view: Viewpoint, base: float) -> Float[np.ndarray, "n"]:
    with np.errstate(divide="ignore"):
        t = (base - view.origin[2]) / view.directions[:, 2]
    return np.where(t > 0, t, np.inf)


def _blurred(field: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """[1 2 1] / 4 along every axis; outside is 0."""
    for axis in range(field.ndim):
        wide = np.pad(field, [(1, 1) if a == axis else (0, 0) for a in range(field.ndim)])
        wide = np.moveaxis(wide, axis, 0)
        field = np.moveaxis(0.25 * wide[:-2] + 0.5 * wide[1:-1] + 0.25 * wide[2:], 0, axis)
    return field


def _doubled(field: Float[np.ndarray, "G G G"]) -> Float[np.ndarray, "H H H"]:
    """Interpolated at the middles of half as large voxels (H = 2 G); the border's value outside."""
    for axis in range(3):
        wide = np.moveaxis(np.pad(field, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge"), axis, 0)
        below, above = 0.25 * wide[:-2] + 0.75 * wide[1:-1], 0.75 * wide[1:-1] + 0.25 * wide[2:]
        pairs = np.stack([below, above], axis=1)
        field = np.moveaxis(pairs.reshape(-1, *pairs.shape[2:]), 0, axis)
    return field


def _trilinear(values: Float[np.ndarray, "G G G"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Interpolation between voxel centres; the border's value outside them."""
    grid = values.shape[0]
    at = np.clip((points + 1.0) * (0.5 * grid) - 0.5, 0.0, grid - 1.001)
    i = at.astype(np.int32)
    f = at - i
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1.0 - f), axis=1)
        total += weight * values[tuple((i + corner).T)]
    return total
