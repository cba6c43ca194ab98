"""The things that stand in a frame without a label map, and what they stand on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from calibration.camera import Camera
from perception.observation.clusters import groups, unstacked
from perception.observation.rims import is_inside
from perception.observation.settings import SegmentConfig
from perception.observation.support_plane import (
    heights,
    horizontal,
    noise_growth,
    on_plane,
    over,
    planes,
    upward,
)
from perception.observation.visible_extent import whole_extent

_SQUARE = np.ones((3, 3), bool)
_FOOT = 0.03  # m; what stands is seen down to this height, up to 1 m from the camera
_NEAREST = 0.05  # m; the camera's least height over a support
_PARALLEL = np.cos(np.radians(15.0))
_APART = 0.05  # m between the heights of two supports


@dataclass(frozen=True, eq=False)
class Thing:
    """The pixels of one thing, and its support."""

    mask: Bool[np.ndarray, "h w"]
    plane: Float[np.ndarray, "4"]


@dataclass(eq=False)
class Standing:
    """What was found, the largest first, and what was not taken for an object, with the reason."""

    things: list[Thing] = field(default_factory=list)
    left_out: list[tuple[Bool[np.ndarray, "h w"], str]] = field(default_factory=list)


def candidates(points: Float[np.ndarray, "h w 3"], config: SegmentConfig) -> list[Float[np.ndarray, "4"]]:
    """The planes of a frame, or the given one. Raises `ValueError` if there is none."""
    if config.plane.given is not None:
        plane = np.asarray(config.plane.given) / np.linalg.norm(config.plane.given[:3])
        return [plane * (np.sign(plane[3]) or 1.0)]
    measured = np.isfinite(points[..., 2]).astype(np.float32)
    found = []
    for plane in planes(points, config.plane):
        on = on_plane(points, plane, config.plane)
        around = ndimage.uniform_filter(on.astype(np.float32)) / np.maximum(ndimage.uniform_filter(measured), 1e-6)
        if plane[3] > _NEAREST and on.any() and np.median(around[on]) > 0.5:  # else it is scattered noise
            found.append(plane)
    if not found:
        raise ValueError(
            "no support plane was found; show more of the table, check the depth and its unit, or give the plane"
            " (--plane) or the camera's pose"
        )
    return found


def standing(
    points: Float[np.ndarray, "h w 3"],
    camera: Camera,
    supports: Sequence[Float[np.ndarray, "4"]],
    config: SegmentConfig,
) -> Standing:
    """The things that stand on the supports of a frame (`points` of its pixels in the camera frame, m).

    The first support is the plane that carries most: pixels of clusters of an object's size that reach down to it. A
    plane parallel to it that carries nearly as much (`also`) is one, too. `supports`: at least one (`candidates`).
    """
    carried = [_carried(points[::2, ::2], plane, config) * upward(plane) for plane in supports]
    order = sorted(range(len(supports)), key=lambda i: -carried[i])
    first = supports[order[0]]
    found = Standing()
    taken = np.zeros(points.shape[:2], bool)
    for i in order:
        plane = supports[i]
        if plane is not first:
            seen = points[on_plane(points, plane, config.plane) & ~taken]
            if (
                len(seen) < config.min_cluster_pixels
                or carried[i] < config.plane.also * max(carried[order[0]], 1.0)
                or plane[:3] @ first[:3] < _PARALLEL
                or abs(float(np.median(heights(seen, first)))) < _APART
            ):
                continue
        own = _on(points, plane, taken, camera, config)
        found.things += own.things
        found.left_out += own.left_out
        for mask in [thing.mask for thing in own.things] + [mask for mask, _ in own.left_out]:
            taken |= mask
    found.things.sort(key=lambda thing: -int(thing.mask.sum()))
    return found


def in_box(
    points: Float[np.ndarray, "h w 3"],
    box_px: tuple[int, int, int, int],
    supports: Sequence[Float[np.ndarray, "4"]],
    config: SegmentConfig,
) -> Thing:
    """The one thing in a box (x0 y0 x1 y1, px; ends exclusive). Raises `ValueError` if there is nothing."""
    x0, y0, x1, y1 = box_px
    height, width = points.shape[:2]
    if not (0 <= x0 < x1 <= width and 0 <= y0 < y1 <= height):
        raise ValueError(
            f"the box {x0} {y0} {x1} {y1} is empty or leaves the picture of {width}x{height} px; give X0 Y0 X1 Y1"
            " inside it"
        )
    outside = np.ones((height, width), bool)
    outside[y0:y1, x0:x1] = False
    best, most = None, 0
    for plane in supports:
        mask = np.zeros((height, width), bool)
        for pixels, cloud in _clusters(points, plane, config, 1, outside):
            low = np.percentile(heights(cloud, plane), 5) < _FOOT * np.median(noise_growth(cloud))
            edge = np.isin(pixels[:, 0], (y0, y1 - 1)) | np.isin(pixels[:, 1], (x0, x1 - 1))
            if low and edge.sum() < 0.5 * np.ptp(pixels, axis=0).max():  # else a neighbour reaches in
                mask[pixels[:, 0], pixels[:, 1]] = True
        if mask.sum() * upward(plane) > most:
            best, most = (mask, plane), int(mask.sum() * upward(plane))
    if best is None:
        raise ValueError(f"nothing that stands on a plane is whole in the box {x0} {y0} {x1} {y1}; draw it again")
    mask, plane = best
    up = heights(points, plane) / noise_growth(points)
    near = ndimage.binary_dilation(mask, iterations=3) & ~outside & (up > config.base) & (up < config.max_height)
    return Thing(_filled(mask | near, points, plane, config), plane)


def _carried(points: Float[np.ndarray, "h w 3"], plane: Float[np.ndarray, "4"], config: SegmentConfig) -> int:
    """How many pixels of clusters of an object's size stand on a plane (of a picture with every second pixel)."""
    count = 0
    for pixels, cloud in _clusters(points, plane, config, 2):
        height = heights(cloud, plane)
        low = np.percentile(height, 5) < _FOOT * np.median(noise_growth(cloud))
        if low and height.max() > config.min_height and not _why_not(cloud, plane, pixels, points.shape[:2], config):
            count += len(pixels)
    return count


def _clusters(
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    config: SegmentConfig,
    every: int = 1,
    outside: Bool[np.ndarray, "h w"] | None = None,
) -> Iterator[tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]]:
    """Pixels and points of clusters over the largest patch of a plane, none `outside`, of every n-th pixel."""
    seen = points[on_plane(points, plane, config.plane)]
    if not len(seen):
        return
    # Elsewhere the plane may cut a chair or a shelf.
    patch = groups(seen @ horizontal(plane).T, 0.02)
    table = seen[patch == np.bincount(patch).argmax()][::7]
    height, z = heights(points, plane), points[..., 2]
    high = (height > config.above * noise_growth(points)) & (height < config.max_height)
    if outside is not None:
        high &= ~outside
    # Where one thing ends before another their outlines are left out, so that things that touch come apart. A level
    # face seen at a grazing angle spans much depth, but no height.
    steps = (
        ndimage.maximum_filter(np.where(high, extent, -np.inf), 3)
        - ndimage.minimum_filter(np.where(high, extent, np.inf), 3)
        for extent in (z, height)
    )
    solid = high & ~((next(steps) > config.depth_step * every) & (next(steps) > 0.2 * config.depth_step * every))
    where, group = np.argwhere(solid), groups(points[solid], config.voxel * every)
    for i in np.flatnonzero(np.bincount(group) >= config.min_cluster_pixels // every**2):
        pixels = where[group == i]
        cloud = points[pixels[:, 0], pixels[:, 1]]
        if over(cloud[::7], plane, table).mean() >= 0.5:
            yield pixels, cloud


def _why_not(
    cloud: Float[np.ndarray, "n 3"],
    plane: Float[np.ndarray, "4"],
    pixels: Int[np.ndarray, "n 2"],
    size: tuple[int, ...],
    config: SegmentConfig,
) -> str:
    """Why a cluster is no object that can be inferred, or an empty string."""
    side = whole_extent(cloud[:: max(len(cloud) // 2000, 1)] @ horizontal(plane).T)[1]
    if side > config.max_side:
        return f"{100 * side:.0f} cm wide, more than {100 * config.max_side:.0f}"
    border = (pixels == 0) | (pixels == np.array(size) - 1)
    length = np.ptp(pixels, axis=0).max()
    if border.any(axis=1).sum() > config.cut_off * length:
        return "cut off by the picture's border"
    return ""


def _on(
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    taken: Bool[np.ndarray, "h w"],
    camera: Camera,
    config: SegmentConfig,
) -> Standing:
    """The things on one plane, pixels of those `taken` left out."""
    height, growth = heights(points, plane), noise_growth(points)
    pieces = []
    for pixels, cloud in _clusters(np.where(taken[..., None], np.nan, points), plane, config):
        pieces += [pixels[i] for i in unstacked(cloud, heights(cloud, plane), plane, config)]
    pieces = [pixels for pixels in pieces if len(pixels) >= config.min_cluster_pixels]
    pieces = _whole_vessels(pieces, points, plane, float(camera.K[0, 0]))
    pieces.sort(key=lambda pixels: -len(pixels))
    # Outlines and bases (thinner than `above`) go to what they are next to in space.
    owner = np.zeros(points.shape[:2], np.intp)
    for number, pixels in enumerate(pieces, start=1):
        owner[pixels[:, 0], pixels[:, 1]] = number
    loose = (owner == 0) & (height > config.base * growth) & (height < config.max_height) & ~taken
    if pieces and loose.any():
        reach = np.where(height[loose] > config.above * growth[loose], 2.0 * config.voxel, config.voxel)
        gap, at = cKDTree(points[owner > 0]).query(points[loose], distance_upper_bound=2.0 * config.voxel)
        owner[loose] = np.where(gap < reach, np.append(owner[owner > 0], 0)[at], 0)
    found = Standing()
    for number, pixels in enumerate(pieces, start=1):
        mask = _filled(owner == number, points, plane, config)
        cloud = points[pixels[:, 0], pixels[:, 1]]
        reason = _why_not(cloud, plane, np.argwhere(mask), mask.shape, config)
        if not reason and height[pixels[:, 0], pixels[:, 1]].max() <= config.min_height:
            reason = f"lower than {100 * config.min_height:g} cm"
        if not reason and _floats(mask, points, plane, camera, config):
            reason = "nothing that carries it is seen"
        if reason:
            found.left_out.append((mask, reason))
        else:
            found.things.append(Thing(mask, plane))
    return found


def _whole_vessels(
    pieces: list[Int[np.ndarray, "n 2"]],
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    focal: float,
) -> list[Int[np.ndarray, "m 2"]]:
    """Pieces, where the inside of an open vessel has joined its outer wall."""
    clouds = [points[pixels[:, 0], pixels[:, 1]] for pixels in pieces]
    whole = list(range(len(pieces)))
    for inner in sorted(range(len(pieces)), key=lambda i: len(pieces[i])):
        for outer in range(len(pieces)):
            if outer == inner or whole[outer] == whole[inner]:
                continue
            if is_inside(clouds[inner], clouds[outer], plane, focal):
                old = whole[inner]
                whole = [whole[outer] if name == old else name for name in whole]
                break
    return [
        np.concatenate([pieces[i] for i in range(len(pieces)) if whole[i] == name]) for name in dict.fromkeys(whole)
    ]


def _floats(
    mask: Bool[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    camera: Camera,
    config: SegmentConfig,
) -> bool:
    """Whether a camera that looks under a thing sees nothing that carries it: what is there is farther, or unknown."""
    cloud = points[mask & np.isfinite(points[..., 2])]
    height = heights(cloud, plane)
    low = float(np.percentile(height, 2))
    if low < max(config.lifted, _FOOT):
        return False
    beneath = cloud[height < low + 0.02] - np.linspace(0.01, low, 6)[:, None, None] * plane[:3]
    u, v = np.rint(camera.project(beneath.reshape(-1, 3))).astype(int).T
    inside = (u >= 0) & (u < mask.shape[1]) & (v >= 0) & (v < mask.shape[0])
    u, v, z = u[inside], v[inside], beneath.reshape(-1, 3)[inside, 2]
    carried = mask[v, u] | (points[v, u, 2] < z + 0.02)
    return bool(carried.mean() < 0.3) if len(z) else False


def _filled(
    mask: Bool[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
    plane: Float[np.ndarray, "4"],
    config: SegmentConfig,
) -> Bool[np.ndarray, "h w"]:
    """A mask with its small gaps in depth, and with the floor of a bowl: what it encloses low down, within its outline
    seen from above (through a handle the table behind it is seen).
    """
    height = heights(points, plane) / noise_growth(points)
    gap = np.isnan(height)
    mask = mask | (gap & ndimage.binary_closing(mask, iterations=5))
    holes, _ = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    small = np.bincount(holes.ravel()) < 0.02 * mask.sum()
    small[0] = False
    reach = 0.25 * np.sqrt(mask.sum())  # px; at a rim depth is often missing
    low = np.abs(height) <= config.above
    ring = mask | (~low & (ndimage.distance_transform_edt(~mask) < reach))
    inside = (
        ndimage.binary_fill_holes(ndimage.binary_closing(ring, _SQUARE, iterations=max(2, round(0.3 * reach)))) & ~mask
    )
    floor = inside & low
    floor[floor] = over(points[floor], plane, points[mask & ~gap][::7], -0.005)
    if floor.any():  # and what is missing between it and the wall
        floor |= gap & ndimage.binary_closing(mask | floor, _SQUARE, iterations=6)
    return mask | (gap & small[holes]) | floor
