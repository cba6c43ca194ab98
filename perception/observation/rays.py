"""From a segment of a frame to the model's observation: rays in the object's cube."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from calibration.camera import Camera
from perception.observation.object_frame import ObjectFrame, object_frame
from perception.observation.segmentation import Segment
from perception.observation.settings import ObserveConfig
from perception.sources.frame import Frame
from probnerf.pixel_status import FREE, OBJECT, UNKNOWN
from probnerf.types import Observation, Rays, on_device

NO_LIMIT = 1e3  # cube units: a ray that misses the object without an end


@dataclass(frozen=True, eq=False)
class _WindowPixels:
    """The data of each of the n pixels in the cube's window, row by row."""

    pixels: Int[np.ndarray, "n 2"]  # u, v
    direction: Float[np.ndarray, "n 3"]  # of its ray, along the cube's axes, unit
    meets_cube: Bool[np.ndarray, "n"]
    status: Int[np.ndarray, "n"]  # UNKNOWN, OBJECT or FREE
    occluder: Bool[np.ndarray, "n"]  # it sees something nearer than the object
    near_outline: Bool[np.ndarray, "n"]
    rgb: UInt8[np.ndarray, "n 3"]
    range_m: Float[np.ndarray, "n"]  # along the ray; NaN: not measured


def observe(
    frame: Frame,
    segment: Segment,
    config: ObserveConfig | None = None,
    seed: int = 0,
    cube: ObjectFrame | None = None,
) -> tuple[Observation, ObjectFrame]:
    """One frame's observation of one object, as rays, and the rays' cube: `cube`, if it is known already.

    It is the first of the `observations` with the same seed.
    """
    (first,), cube = observations(frame, segment, replace(config or ObserveConfig(), choices=1), seed, cube)
    return first, cube


def observations(
    frame: Frame,
    segment: Segment,
    config: ObserveConfig | None = None,
    seed: int = 0,
    cube: ObjectFrame | None = None,
) -> tuple[tuple[Observation, ...], ObjectFrame]:
    """Observations of one object in one frame, each of its own choice of pixels, and the cube that is theirs.

    Rays: `colour_rays` OBJECT pixels (colour, and range where measured), then `free_rays` FREE pixels, then
    `occluder_rays` UNKNOWN pixels with the range up to which they are empty, less two sigma. Each group is well spread
    over its pixels and filled with padding, which has no effect. Deterministic in `seed`.

    Raises `ValueError` if the object is outside the tabletop's range of sizes.
    """
    config = config or ObserveConfig()
    cube = cube or object_frame(frame, segment, config)
    window, widths = _window_pixels(frame, segment, cube, config), pose_widths(frame.camera, cube, config)
    seeds = [[seed], *([seed, number] for number in range(1, config.choices))]
    cells = _cells_of(window, config)
    chosen = [_chosen_pixels(cells, config, np.random.default_rng(own)) for own in seeds]
    return tuple(_observation(window, pixels, widths, cube, config) for pixels in chosen), cube


def _window_pixels(frame: Frame, segment: Segment, cube: ObjectFrame, config: ObserveConfig) -> _WindowPixels:
    """The pixels of the window that the cube falls in, with status, colour and range."""
    window = _window(frame.camera, cube, config.cube)
    v, u = np.mgrid[window]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    rays = frame.camera.rays(pixels)
    directions = rays @ cube.T_camera_object[:3, :3]
    depth = np.full(segment.mask.shape, np.nan) if frame.depth is None else frame.depth
    distance = np.linalg.norm(cube.T_camera_object[:3, 3])
    band_px = config.outline_band * cube.half_extent * frame.camera.K[0, 0] / distance
    return _WindowPixels(
        pixels=pixels,
        direction=directions,
        meets_cube=_meets_cube(cube.to_cube(np.zeros(3)), directions, config.cube),
        status=segment.status[window].ravel(),
        occluder=segment.occluder[window].ravel(),
        near_outline=_near_mask(segment.mask, window, band_px).ravel(),
        rgb=frame.rgb[window].reshape(-1, 3),
        range_m=depth[window].ravel() / rays[:, 2],  # z-depth to range along the ray
    )


def _near_mask(
    mask: Bool[np.ndarray, "h w"], window: tuple[slice, slice], band_px: float
) -> Bool[np.ndarray, "rows columns"]:
    """Which pixels of the window lie in the mask or at most `band_px` from it."""
    (box,) = ndimage.find_objects(mask.astype(np.int8))
    part = tuple(slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in zip(window, box, strict=True))
    near = np.zeros_like(mask)
    near[part] = ndimage.distance_transform_edt(~mask[part]) <= band_px
    return near[window]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Areas of the window of which each ray draws its own pixel."""

    objects: list[Int[np.ndarray, "k"]]
    near: list[Int[np.ndarray, "k"]]  # FREE and close to the object: they bound its outline
    free: list[Int[np.ndarray, "k"]]
    occluders: list[Int[np.ndarray, "k"]]


def _cells_of(window: _WindowPixels, config: ObserveConfig) -> _Cells:
    """Half of the free rays pass close to the object."""

    def cells(candidates: Bool[np.ndarray, "n"], count: int) -> list[Int[np.ndarray, "k"]]:
        return _halved(window.pixels, np.flatnonzero(window.meets_cube & candidates), count)

    free = window.status == FREE
    near = cells(free & window.near_outline, config.free_rays // 2)
    return _Cells(
        objects=cells(window.status == OBJECT, config.colour_rays),
        near=near,
        free=cells(free, config.free_rays - len(near)),
        occluders=cells(window.occluder, config.occluder_rays),
    )


def _chosen_pixels(cells: _Cells, config: ObserveConfig, rng: np.random.Generator) -> Int[np.ndarray, "rays"]:
    """Index of each ray's pixel, group by group: OBJECT, FREE, those that see an occluder; -1: padding."""

    def drawn(areas: list[Int[np.ndarray, "k"]], taken: Int[np.ndarray, "t"]) -> Int[np.ndarray, "drawn"]:
        pixels = []
        for area in areas:
            pixel = area[rng.integers(len(area))]
            if pixel in taken:  # seldom
                left = np.setdiff1d(area, taken)
                pixels += [rng.choice(left)] if len(left) else []
            else:
                pixels.append(pixel)
        return np.array(pixels, np.intp)

    def padded(indices: Int[np.ndarray, "k"], count: int) -> Int[np.ndarray, "count"]:
        return np.append(indices, np.full(count - len(indices), -1))

    none = np.array([], np.intp)
    near = drawn(cells.near, none)
    groups = [
        padded(drawn(cells.objects, none), config.colour_rays),
        padded(np.append(near, drawn(cells.free, near)), config.free_rays),
        padded(drawn(cells.occluders, none), config.occluder_rays),
    ]
    return np.concatenate(groups).astype(np.intp)


def _observation(
    window: _WindowPixels,
    chosen: Int[np.ndarray, "rays"],
    pose_sigma: Float[np.ndarray, "5"],
    cube: ObjectFrame,
    config: ObserveConfig,
) -> Observation:
    """The chosen pixels as an Observation. Padding looks at the cube's centre and has no effect.

    A range d has the standard deviation a + b d^2. A FREE ray is empty up to its measured end, an occluder's up to two
    standard deviations before it.
    """
    real = chosen >= 0
    status = np.where(real, window.status[chosen], UNKNOWN)
    measured = real & np.isfinite(window.range_m[chosen])
    sigma = config.range_sigma_a + config.range_sigma_b * window.range_m[chosen] ** 2
    range_m, sigma = np.nan_to_num(window.range_m[chosen]), np.nan_to_num(sigma, nan=config.range_sigma_a)
    free_limit = np.where(measured, range_m / cube.half_extent, NO_LIMIT)
    occluder_limit = np.where(measured, np.maximum(range_m - 2.0 * sigma, 0.0) / cube.half_extent, 0.0)
    limit = np.select([status == FREE, status == UNKNOWN], [free_limit, occluder_limit], 0.0)
    origin = cube.to_cube(np.zeros(3))
    towards = -origin / np.linalg.norm(origin)
    return Observation(
        rays=Rays(
            origin=on_device(np.broadcast_to(origin, (len(chosen), 3))),
            direction=on_device(np.where(real[:, None], window.direction[chosen], towards)),
        ),
        status=on_device(status, np.int32),
        rgb=on_device(np.where(real[:, None], window.rgb[chosen] / 255.0, 0.0)),
        rgb_valid=on_device(status == OBJECT, np.bool_),
        range=on_device(np.where(status == OBJECT, range_m, 0.0) / cube.half_extent),
        range_sigma=on_device(sigma / cube.half_extent),
        range_valid=on_device(measured & (status == OBJECT), np.bool_),
        limit=on_device(limit),
        pose_sigma=on_device(pose_sigma),
        colour_count=config.colour_rays,
    )


def pose_widths(camera: Camera, cube: ObjectFrame, config: ObserveConfig) -> Float[np.ndarray, "5"]:
    """Prior standard deviations of x, y, log-scale, range offset and z, in the order of `Observation.pose_sigma`."""
    own = [
        cube.xy_sigma + cube.along_sigma,
        cube.xy_sigma,
        cube.log_scale_sigma,
        config.range_offset_sigma / cube.half_extent,
        config.plane_sigma / cube.half_extent,
    ]
    return np.hypot(own, calibration_widths(camera, cube))


def calibration_widths(camera: Camera, cube: ObjectFrame) -> Float[np.ndarray, "5"]:
    """What an uncertain calibration adds in quadrature to `pose_sigma`; zeros where K_std is not known.

    A point at pixel u and depth z lies sideways at X = z (u - cx) / f. With s = std(f) / f (rms of both axes):

    - dX / X = -df / f: lateral sizes, at a depth that the sensor gives, are uncertain by s. So is the scale.
    - X at the object itself shifts by X s, and by std(cx) z / f: the axis' place, in both horizontal directions.
    - One picture shows an object of size S at distance d and one of (1 + s) S at (1 + s) d: angles err by s, and the
      ranges would tie the size down to better than that. The offset that they share gets s d.
    The plane is seen by the same rays and errs with the object, so its height gets nothing. Deviations of the
    distortion are left out: they are correlated with those of f and c. These are widths of the prior. The likelihood
    uses the stated intrinsics, and narrows all of place and size except along the shared offset.
    """
    if camera.K_std is None:
        return np.zeros(5)
    focal = camera.K[[0, 1], [0, 1]]
    s = float(np.sqrt(((camera.K_std[[0, 1], [0, 1]] / focal) ** 2).mean()))
    at = cube.T_camera_object[:3, 3]
    shift = np.hypot(s * at[:2], camera.K_std[:2, 2] * at[2] / focal) / cube.half_extent  # right, down
    sideways = float(np.sqrt((shift**2).mean()))
    return np.array([sideways, sideways, s, s * np.linalg.norm(at) / cube.half_extent, 0.0])


def _window(camera: Camera, cube: ObjectFrame, half: float) -> tuple[slice, slice]:
    """The part of the picture that a cube of half side `half` (cube units) may fall in."""
    corners = half * (2.0 * np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3) - 1.0)
    px = camera.project(cube.to_camera(corners))
    if not np.isfinite(px).all():  # the camera is inside or beside the cube
        return slice(0, camera.height), slice(0, camera.width)
    low = np.clip(np.floor(px.min(axis=0)), 0, [camera.width, camera.height]).astype(int)
    high = np.clip(np.ceil(px.max(axis=0)) + 1, 0, [camera.width, camera.height]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _meets_cube(
    origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"], half: float
) -> Bool[np.ndarray, "n"]:
    """Which rays pass through the cube of half side `half`; false for NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.array([[[-half]], [[half]]]) - origin) / directions
    near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return (far > np.maximum(near, 0.0)) & np.isfinite(directions).all(axis=1)


def _halved(pixels: Int[np.ndarray, "n 2"], candidates: Int[np.ndarray, "m"], count: int) -> list[Int[np.ndarray, "k"]]:
    """`count` parts of the candidates (or one each, if there are fewer), of even number and area.

    The candidates are halved along their longer side until a part is left for every ray. Pixels of one row or column
    keep their order, so that every machine makes the same.
    """
    if len(candidates) <= count:
        return list(candidates[:, None])
    if count <= 1:
        return [candidates] * count
    first = count // 2
    cut = round(len(candidates) * first / count)
    side = int(np.ptp(pixels[candidates], axis=0).argmax())
    order = candidates[np.argsort(pixels[candidates, side], kind="stable")]
    return _halved(pixels, order[:cut], first) + _halved(pixels, order[cut:], count - first)
