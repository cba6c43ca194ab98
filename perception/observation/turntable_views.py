"""Posed pictures of one object on a plate: undistorted squares, the object's masks, and its size.

The plate frame is z up, z = 0 on the plate, metres (see calibration.turntable_pose).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy import ndimage

from calibration.boards import Board
from perception.sources.frame import Frame
from probnerf.types import BASE_Z, BODY_EXTENT

_GRID = 48  # voxels per side of the carving
_PX_PER_SQUARE = 40


@dataclass(frozen=True)
class PlateMaskConfig:
    """What separates the object from its surroundings."""

    lowest: float = 0.006  # m above the plate; lower points are the plate: depth errs by millimetres
    contrast: float = 30.0  # of 255: a pixel that differs more from the empty plate belongs to the object
    blur: float = 1.5  # px: error of the empty plate's edges
    speck: int = 5  # px: thinner regions are noise, and thinner gaps are closed


@dataclass(frozen=True, eq=False)
class Square:
    """The largest square about a frame's optical axis, as a pinhole camera with square pixels sees it."""

    rgb: UInt8[np.ndarray, "s s 3"]
    depth: Float32[np.ndarray, "s s"] | None  # m along z, NaN where unknown
    inside: Bool[np.ndarray, "s s"]  # the frame has this pixel
    focal: float  # px

    @property
    def side(self) -> int:
        """Pixels."""
        return self.rgb.shape[0]

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Camera matrix, pixel centres at whole numbers."""
        middle = 0.5 * self.side - 0.5
        return np.array([[self.focal, 0, middle], [0, self.focal, middle], [0, 0, 1]])


def square(frame: Frame) -> Square:
    """Undistort a frame, and cut out the square about its optical axis; the camera's place and axes stay."""
    camera = frame.camera
    side, focal = min(camera.width, camera.height), float(camera.K[1, 1])
    blank = Square(np.zeros((side, side, 3), np.uint8), None, np.zeros((side, side), bool), focal)
    v, u = np.mgrid[:side, :side].reshape(2, -1)
    rays = np.column_stack([u, v, np.ones(side * side)]) @ np.linalg.inv(blank.K).T
    x, y = camera.project(rays).astype(np.float32).T.reshape(2, side, side)  # by its own model, whichever it is
    rgb = cv2.remap(frame.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    depth = None
    if frame.depth is not None:
        depth = cv2.remap(frame.depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
    inside = (x >= 0) & (y >= 0) & (x <= camera.width - 1) & (y <= camera.height - 1)
    return Square(np.asarray(rgb, np.uint8), None if depth is None else np.asarray(depth, np.float32), inside, focal)


def plate_points(view: Square, T_plate_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "s s 3"]:
    """Each pixel's point in the plate frame, NaN without depth."""
    assert view.depth is not None
    v, u = np.mgrid[: view.side, : view.side] - (0.5 * view.side - 0.5)
    points = np.stack([u / view.focal, v / view.focal, np.ones_like(u)], axis=-1) * view.depth[..., None]
    return points @ T_plate_camera[:3, :3].T + T_plate_camera[:3, 3]


def mask_by_depth(
    view: Square, T_plate_camera: Float[np.ndarray, "4 4"], board: Board, config: PlateMaskConfig
) -> Bool[np.ndarray, "s s"]:
    """The pixels of things on the board that are higher than `lowest`."""
    x, y, z = np.moveaxis(plate_points(view, T_plate_camera), -1, 0)
    width, height = board.size
    with np.errstate(invalid="ignore"):
        over = (np.abs(x) < 0.5 * width) & (np.abs(y) < 0.5 * height) & (z > config.lowest) & (z < 2 * max(board.size))
    return _largest(over, config)


def mask_by_picture(
    view: Square,
    T_plate_camera: Float[np.ndarray, "4 4"],
    board: Board,
    empty: tuple[Square, Float[np.ndarray, "4 4"]] | None,
    config: PlateMaskConfig,
) -> Bool[np.ndarray, "s s"]:
    """The pixels that differ from the empty plate.

    `empty` is a picture of it with its T_plate_camera, from the present place of the camera: the board is turned to
    where it is in `view`, the rest stays. None: the board as printed, on white.
    """
    box = (view.side, view.side)
    to_view = _plate_to_pixels(view, T_plate_camera)
    w, h = board.size
    on_board = _on_board(board, to_view, box)
    if empty is not None:
        other, T_other = empty
        to_other = _plate_to_pixels(other, T_other)
        turned = cv2.warpPerspective(other.rgb, to_view @ np.linalg.inv(to_other), box, borderMode=cv2.BORDER_REPLICATE)
        around = cv2.dilate(_on_board(board, to_other, box).astype(np.uint8), np.ones((5, 5), np.uint8))
        ground = cv2.inpaint(other.rgb, around, 3, cv2.INPAINT_TELEA)  # fill in where the board was and is no longer
        expected = np.where(on_board[..., None], turned, ground).astype(np.float32)
    else:
        printed = board.picture(_PX_PER_SQUARE)
        px = _PX_PER_SQUARE / board.square
        to_print = np.array([[px, 0, 0.5 * w * px - 0.5], [0, -px, 0.5 * h * px - 0.5], [0, 0, 1]])
        ideal = cv2.warpPerspective(printed, to_view @ np.linalg.inv(to_print), box, borderValue=255)[..., None] / 255.0
        # paper and ink as this light shows them; the object hides less than half of either
        paper, ink = (np.median(view.rgb[on_board & (ideal[..., 0] == value)], axis=0) for value in (1.0, 0.0))
        expected = (ink + ideal * (paper - ink)).astype(np.float32)
    if empty is None:  # pixels at least as bright as paper count as empty
        expected = np.where(on_board[..., None], expected, np.clip(view.rgb, expected, 255.0).astype(np.float32))
    seen, wanted = (cv2.GaussianBlur(np.asarray(a, np.float32), (0, 0), config.blur) for a in (view.rgb, expected))
    differs = np.abs(seen - wanted) > config.contrast
    wide = _largest(differs.any(axis=-1) & view.inside, config)
    return ndimage.binary_erosion(wide, np.ones((3, 3)))  # by about the width that the blur added


def bounds_by_depth(
    view: Square, T_plate_camera: Float[np.ndarray, "4 4"], mask: Bool[np.ndarray, "s s"]
) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest x, y, z (m, plate frame) of the object's visible part in one view."""
    points = plate_points(view, T_plate_camera)[mask]
    points = points[np.isfinite(points[:, 2])]
    if not len(points):
        return np.array([np.full(3, np.inf), np.full(3, -np.inf)])
    return np.percentile(points, [1.0, 99.0], axis=0)


def bounds_by_carving(
    masks: Bool[np.ndarray, "v s s"],
    T_plate_cameras: Float[np.ndarray, "v 4 4"],
    focal: float,
    board: Board,
    share: float = 0.9,
) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest x, y, z (m, plate frame) of the visual hull: what `share` of the masks allow.

    From cameras above, a flat top looks pointed: the height is too large then. Raises ValueError if nothing is left.
    """
    reach = 0.5 * max(board.size)
    step = 2.0 * reach / _GRID
    axis = (np.arange(_GRID) + 0.5) * step
    grid = np.stack(np.meshgrid(axis - reach, axis - reach, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    side = masks.shape[1]
    votes = np.zeros(len(grid))
    for mask, T in zip(masks, T_plate_cameras, strict=True):
        p = (grid - T[:3, 3]) @ T[:3, :3]
        pixel = np.rint(p[:, :2] / p[:, 2:] * focal + 0.5 * side - 0.5).astype(int)
        seen = (pixel >= 0).all(axis=1) & (pixel < side).all(axis=1) & (p[:, 2] > 0)
        votes[seen] += mask[pixel[seen, 1], pixel[seen, 0]]
    kept = grid[votes >= share * len(masks)]
    if not len(kept):
        raise ValueError("the views' masks have no object in common; check the pictures, or give another --background")
    return np.array([kept.min(axis=0) - 0.5 * step, kept.max(axis=0) + 0.5 * step])


def cube_of(bounds: Float[np.ndarray, "2 3"]) -> tuple[tuple[float, float, float], float]:
    """Centre and side (m, plate frame) of the cube in which an object stands as the tabletop family does."""
    sides = np.append(bounds[1, :2] - bounds[0, :2], bounds[1, 2])
    half = float(sides.max()) / BODY_EXTENT
    x, y = 0.5 * (bounds[0, :2] + bounds[1, :2])
    return (float(x), float(y), -BASE_Z * half), 2.0 * half


def _plate_to_pixels(view: Square, T_plate_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 3"]:
    """Homography from (x, y, 1) on the plate to pixels."""
    T_camera_plate = np.linalg.inv(T_plate_camera)
    return view.K @ T_camera_plate[:3, [0, 1, 3]]


def _on_board(board: Board, to_pixels: Float[np.ndarray, "3 3"], shape: tuple[int, int]) -> Bool[np.ndarray, "s s"]:
    w, h = board.size
    outline = np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) * 0.5
    corners = np.rint(cv2.perspectiveTransform(outline[None], to_pixels)[0]).astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(shape, np.uint8), corners, 1).astype(bool)


def _largest(mask: Bool[np.ndarray, "s s"], config: PlateMaskConfig) -> Bool[np.ndarray, "s s"]:
    """The largest connected piece, without specks and with small gaps closed."""
    kernel = np.ones((config.speck, config.speck), np.uint8)
    clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, kernel)
    label, count = ndimage.label(clean, np.ones((3, 3)))
    if count == 0:
        return np.zeros(mask.shape, bool)
    return label == 1 + np.argmax(np.bincount(label.ravel())[1:])
