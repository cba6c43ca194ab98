"""From a segment of a frame to what the model conditions on: the object's frame, and rays in its cube."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from calibration.camera import Camera
from perception.observation.segmentation import Segment, backproject
from perception.observation.support_plane import heights
from perception.observation.visible_extent import visible_body
from perception.observation.without_depth import standing_body
from perception.sources.frame import Frame
from probnerf.types import BASE_Z, FREE, OBJECT, UNKNOWN, Observation, Rays, on_device

# The larger of a body's width and height is this many cube units: the scale convention of the prior.
BODY_EXTENT = 1.4
NO_LIMIT = 1e3  # cube units: a ray that misses the object without an end


@dataclass(frozen=True)
class ObserveConfig:
    """How a segment becomes an Observation. Ray counts are fixed, so that no frame compiles anew."""

    colour_rays: int = 32  # OBJECT pixels
    free_rays: int = 26  # FREE pixels, half of them near the outline
    occluder_rays: int = 6  # UNKNOWN pixels that see something nearer
    range_sigma_a: float = 1.0e-3  # m; sigma of a range d: a + b d^2
    range_sigma_b: float = 2.0e-3  # 1/m
    cube: float = 1.2  # half side (cube units) of the box that a ray must meet to be worth asking
    outline_band: float = 0.25  # cube units either side of the mask that count as near its outline
    xy_sigma: float = 0.08  # cube units; prior width of the body's axis about the guess
    log_scale_sigma: float = 0.06
    range_offset_sigma: float = 0.005  # m; bias that all ranges of a view share
    plane_sigma: float = 0.005  # m; of the plane's height, which a sensor measures at a grazing angle
    hidden_sigma: float = 0.3  # added to all widths, times the share of the outline that is hidden or cut off
    side_sigma: float = 0.08  # added to all widths where the camera does not look down on the top
    rim_reach: float = 0.02  # m; a rim pixel this near its neighbour inside the outline is of the object
    outline_px: int = 5  # px from the outline within which something nearer hides what goes on
    min_height: float = 0.02  # m; the tabletop's range of sizes
    max_side: float = 0.40  # m


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """The cube that an object is inferred in. p_camera = T_camera_object @ (half_extent p_cube).

    Axes: z up along the support plane's normal, x horizontal towards the camera, y = z cross x. The plane is
    z = BASE_Z in the cube, and x = y = 0 is the guess of the body's axis.
    """

    T_camera_object: Float[np.ndarray, "4 4"]  # m
    half_extent: float  # m per cube unit
    plane: Float[np.ndarray, "4"]  # (n, d): n.p + d = 0 in the camera frame (m)
    xy_sigma: float  # cube units; standard deviation of the axis about the guess
    log_scale_sigma: float
    along_sigma: float = 0.0  # cube units; of the axis towards the camera (x), on top of xy_sigma
    sight_sigma: float = 0.0  # without depth: relative error of the distance, which place and size share (`monocular`)

    def to_camera(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Cube coordinates to the camera frame (m)."""
        return points * self.half_extent @ self.T_camera_object[:3, :3].T + self.T_camera_object[:3, 3]

    def seen_from(self, T_other_camera: Float[np.ndarray, "4 4"]) -> "ObjectFrame":
        """The same cube in another camera's frame: p_other = T_other_camera @ p_camera."""
        R, t = T_other_camera[:3, :3], T_other_camera[:3, 3]
        normal = R @ self.plane[:3]
        plane = np.append(normal, self.plane[3] - normal @ t)
        return replace(self, T_camera_object=T_other_camera @ self.T_camera_object, plane=plane)

    def to_cube(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Camera frame (m) to cube coordinates."""
        return (points - self.T_camera_object[:3, 3]) @ self.T_camera_object[:3, :3] / self.half_extent


def observe(
    frame: Frame,
    segment: Segment,
    config: ObserveConfig | None = None,
    seed: int = 0,
    cube: ObjectFrame | None = None,
) -> tuple[Observation, ObjectFrame]:
    """What one frame says about one object, in rays, and the cube that they live in: `cube`, if it is known already.

    Rays: `colour_rays` OBJECT pixels (colour, and range where measured), then `free_rays` FREE pixels, then
    `occluder_rays` UNKNOWN pixels with the range up to which they are empty, less two sigma. Each group is well spread
    over its pixels and filled up with padding, which says nothing. Deterministic in `seed`.

    Raises `ValueError` where the object is outside the tabletop's range of sizes.
    """
    config = config or ObserveConfig()
    cube = cube or object_frame(frame, segment, config)
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: frame.camera.height, : frame.camera.width]
    window = _window(frame.camera, cube, config.cube)
    pixels = np.stack([u[window].ravel(), v[window].ravel()], axis=-1)
    flat = np.ravel_multi_index((pixels[:, 1], pixels[:, 0]), u.shape)
    rays = frame.camera.rays(pixels)
    directions = rays @ cube.T_camera_object[:3, :3]
    origin = cube.to_cube(np.zeros(3))
    usable = _meets_cube(origin, directions, config.cube)
    status = segment.status.ravel()[flat]
    depth = np.full(u.shape, np.nan) if frame.depth is None else frame.depth
    metres = depth.ravel()[flat] / rays[:, 2]  # z-depth to range along the ray
    sigma = config.range_sigma_a + config.range_sigma_b * metres**2

    # Half of the free rays pass close to the object: they bound its outline.
    focal = frame.camera.K[0, 0]
    band = config.outline_band * cube.half_extent * focal / np.linalg.norm(cube.T_camera_object[:3, 3])
    (box,) = ndimage.find_objects(segment.mask.astype(np.int8))
    part = tuple(slice(min(a.start, b.start), max(a.stop, b.stop)) for a, b in zip(window, box, strict=True))
    close = np.zeros_like(segment.mask)
    close[part] = ndimage.distance_transform_edt(~segment.mask[part]) <= band
    close = close.ravel()[flat]
    free = usable & (status == FREE)
    near = _spread(pixels, np.flatnonzero(free & close), config.free_rays // 2, rng)
    rest = np.setdiff1d(np.flatnonzero(free), near)
    groups = [
        (_spread(pixels, np.flatnonzero(usable & (status == OBJECT)), config.colour_rays, rng), config.colour_rays),
        (np.append(near, _spread(pixels, rest, config.free_rays - len(near), rng)), config.free_rays),
        (
            _spread(pixels, np.flatnonzero(usable & segment.occluder.ravel()[flat]), config.occluder_rays, rng),
            config.occluder_rays,
        ),
    ]
    # Slots without a pixel look at the cube's centre and say nothing.
    chosen = np.concatenate([np.append(i, np.full(count - len(i), -1)) for i, count in groups]).astype(np.intp)
    real = chosen >= 0
    towards = -origin / np.linalg.norm(origin)
    kind = np.where(real, status[chosen], UNKNOWN)
    measured = real & np.isfinite(metres[chosen])
    metres, sigma = np.nan_to_num(metres[chosen]), np.nan_to_num(sigma[chosen], nan=config.range_sigma_a)
    limit = np.where(kind == FREE, np.where(measured, metres / cube.half_extent, NO_LIMIT), 0.0)
    occluded = (kind == UNKNOWN) & measured
    limit = np.where(occluded, np.maximum(metres - 2.0 * sigma, 0.0) / cube.half_extent, limit)
    observation = Observation(
        rays=Rays(
            origin=on_device(np.broadcast_to(origin, (len(chosen), 3))),
            direction=on_device(np.where(real[:, None], directions[chosen], towards)),
        ),
        status=on_device(kind, np.int32),
        rgb=on_device(np.where(real[:, None], frame.rgb.reshape(-1, 3)[flat[chosen]] / 255.0, 0.0)),
        rgb_valid=on_device(kind == OBJECT, np.bool_),
        range=on_device(np.where(kind == OBJECT, metres, 0.0) / cube.half_extent),
        range_sigma=on_device(sigma / cube.half_extent),
        range_valid=on_device(measured & (kind == OBJECT), np.bool_),
        limit=on_device(limit),
        pose_sigma=on_device(
            np.hypot(
                [
                    cube.xy_sigma + cube.along_sigma,
                    cube.xy_sigma,
                    cube.log_scale_sigma,
                    config.range_offset_sigma / cube.half_extent,
                    config.plane_sigma / cube.half_extent,
                ],
                calibration_widths(frame.camera, cube),
            )
        ),
        colour_count=config.colour_rays,
    )
    return observation, cube


def calibration_widths(camera: Camera, cube: ObjectFrame) -> Float[np.ndarray, "5"]:
    """What an uncertain calibration adds in quadrature to `pose_sigma`; zeros where K_std is not known.

    A point at pixel u and depth z lies sideways at X = z (u - cx) / f. With s = std(f) / f (rms of both axes):

    - dX / X = -df / f: lateral sizes, at a depth that the sensor gives, are uncertain by s. So is the scale.
    - X at the object itself shifts by X s, and by std(cx) z / f: the axis' place, in both horizontal directions.
    - One picture shows an object of size S at distance d and one of (1 + s) S at (1 + s) d: angles err by s, and the
      ranges would tie the size down to better than that. The offset that they share gets s d.
    The plane is seen by the same rays and errs with the object, so its height gets nothing. Deviations of the
    distortion are left out, for they are bound up with those of f and c. These are widths of the prior: what the
    likelihood then says of place and size is said by the stated intrinsics, and narrows all but what the offset frees.
    """
    if camera.K_std is None:
        return np.zeros(5)
    focal = camera.K[[0, 1], [0, 1]]
    s = float(np.sqrt(((camera.K_std[[0, 1], [0, 1]] / focal) ** 2).mean()))
    at = cube.T_camera_object[:3, 3]
    shift = np.hypot(s * at[:2], camera.K_std[:2, 2] * at[2] / focal) / cube.half_extent  # right, down
    sideways = float(np.sqrt((shift**2).mean()))
    return np.array([sideways, sideways, s, s * np.linalg.norm(at) / cube.half_extent, 0.0])


def object_frame(frame: Frame, segment: Segment, config: ObserveConfig) -> ObjectFrame:
    """The cube about a segment's object: from its visible points or, without depth, from its outline.

    Raises `ValueError` where they are too few, or the object's size is out of range.
    """
    # Where the outline borders on something nearer, or on the picture's edge, the object goes on unseen.
    width = config.outline_px
    hidden = ndimage.binary_dilation(np.pad(segment.occluder, width, constant_values=True), iterations=width)
    hidden = hidden[width:-width, width:-width]
    outline = segment.mask & ~ndimage.binary_erosion(segment.mask, border_value=0)
    extra = config.hidden_sigma * float((hidden & outline).sum() / outline.sum())
    if frame.depth is None:
        return _outlined_frame(frame.camera, segment, hidden, extra, config)
    (box,) = ndimage.find_objects(segment.mask.astype(np.int8))  # all of the object is in it
    points, mask, hidden = backproject(frame)[box], segment.mask[box], hidden[box]
    core = (segment.status[box] == OBJECT) & np.isfinite(points[..., 2])
    if core.sum() < 10:
        raise ValueError(
            f"object {segment.id} has depth in {core.sum()} pixels inside its outline; move the camera "
            "nearer, and see that depth is aligned to colour"
        )
    # The rim counts here, where its depth continues the object's: it is wide on surfaces seen at a grazing angle.
    row, column = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    with np.errstate(invalid="ignore"):
        core |= mask & (np.linalg.norm(points - points[row, column], axis=-1) < config.rim_reach)
    core &= heights(points, segment.plane) > 0.0
    thin = max(1, core.sum() // 10_000)
    cloud = points[core][::thin]
    up, d = segment.plane[:3], segment.plane[3]
    axes = _axes(up, np.median(cloud, axis=0))
    seen = np.column_stack([cloud @ axes[:2].T, heights(cloud, segment.plane)])
    centre, across, height, top_seen = visible_body(seen, hidden[core][::thin], float(d))
    foot = centre @ axes[:2] - d * up  # on the plane, where n.p = -d
    extra += 0.0 if top_seen else config.side_sigma
    return _frame_about(foot, across, height, segment, extra, config)


def _outlined_frame(
    camera: Camera, segment: Segment, hidden: Bool[np.ndarray, "h w"], extra: float, config: ObserveConfig
) -> ObjectFrame:
    """The cube about an object without depth; place and size have the error of the supposed plane, too."""
    try:
        body = standing_body(camera, segment.mask, hidden, segment.plane, segment.plane_sigma or (0.0, 0.0))
    except ValueError as error:
        raise ValueError(f"object {segment.id}: {error}") from None
    height = max(body.height, config.min_height)  # of a low box that is taken for a round thing, nothing is left
    cube = _frame_about(body.foot, body.across, height, segment, extra, config)
    return replace(
        cube,
        xy_sigma=cube.xy_sigma + body.across_sigma,
        log_scale_sigma=cube.log_scale_sigma + body.log_scale_sigma,
        along_sigma=body.along_sigma,
        sight_sigma=body.sight_sigma,
    )


def _frame_about(
    foot: Float[np.ndarray, "3"], across: float, height: float, segment: Segment, extra: float, config: ObserveConfig
) -> ObjectFrame:
    """The cube of a body that stands at `foot` (camera frame, m), `extra` added to its widths."""
    if height < config.min_height or max(across, height) > config.max_side:
        raise ValueError(
            f"object {segment.id} measures {100 * across:.1f} cm across and {100 * height:.1f} cm in height; tabletop"
            f" objects are {100 * config.min_height:g} cm high to {100 * config.max_side:g} cm: give another object"
        )
    half_extent = max(across, height) / BODY_EXTENT
    up = segment.plane[:3]
    T = np.eye(4)
    T[:3, :3] = _axes(up, foot).T
    T[:3, 3] = foot - BASE_Z * half_extent * up
    return ObjectFrame(T, half_extent, segment.plane, config.xy_sigma + extra, config.log_scale_sigma + extra)


def _axes(up: Float[np.ndarray, "3"], at: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows x, y, z of an object frame at a point of the camera frame: x horizontal towards the camera."""
    x = -at - (-at @ up) * up
    if np.linalg.norm(x) < 1e-3 * np.linalg.norm(at):  # straight from above: towards the picture's lower edge
        x = np.array([0.0, 1.0, 0.0]) - up[1] * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


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


def _spread(
    pixels: Int[np.ndarray, "n 2"], candidates: Int[np.ndarray, "m"], count: int, rng: np.random.Generator
) -> Int[np.ndarray, "k"]:
    """`count` of the candidates (or all, if fewer), evenly over the area that they cover.

    The candidates are halved along their longer side until every cell holds one wanted pixel; each cell draws its own.
    Pixels of one row or column keep their order, so that every machine draws the same.
    """
    if len(candidates) <= count:
        return candidates
    if count <= 1:
        return rng.choice(candidates, count)
    first = count // 2
    cut = round(len(candidates) * first / count)
    side = int(np.ptp(pixels[candidates], axis=0).argmax())
    order = candidates[np.argsort(pixels[candidates, side], kind="stable")]
    return np.append(_spread(pixels, order[:cut], first, rng), _spread(pixels, order[cut:], count - first, rng))
