"""From a segment of a frame to what the model conditions on: the object's frame, and rays in its cube."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from calibration.camera import Camera
from perception.plane import heights
from perception.segment import Segment, backproject
from perception.source import Frame
from probnerf.types import BASE_Z, FREE, OBJECT, UNKNOWN, Observation, Rays

# The larger of a body's width and height is this many cube units: the scale convention of the prior.
BODY_EXTENT = 1.4
_LOOKS_DOWN = np.radians(8.0)  # the least angle at which the far side of a top is told from its near side
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

    def to_camera(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Cube coordinates to the camera frame (m)."""
        return points * self.half_extent @ self.T_camera_object[:3, :3].T + self.T_camera_object[:3, 3]

    def to_cube(self, points: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Camera frame (m) to cube coordinates."""
        return (points - self.T_camera_object[:3, 3]) @ self.T_camera_object[:3, :3] / self.half_extent


def observe(
    frame: Frame, segment: Segment, config: ObserveConfig | None = None, seed: int = 0
) -> tuple[Observation, ObjectFrame]:
    """What one frame says about one object, in rays, and the cube that they live in.

    Rays: `colour_rays` OBJECT pixels (colour, and range where measured), then `free_rays` FREE pixels, then
    `occluder_rays` UNKNOWN pixels with the range up to which they are empty, less two sigma. Each group is well spread
    over its pixels and filled up with padding, which says nothing. Deterministic in `seed`.

    Raises `ValueError` where the object is outside the tabletop's range of sizes.
    """
    config = config or ObserveConfig()
    cube = object_frame(frame, segment, config)
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
    close = (ndimage.distance_transform_edt(~segment.mask) <= band).ravel()[flat]
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
            origin=jnp.asarray(np.broadcast_to(origin, (len(chosen), 3)), jnp.float32),
            direction=jnp.asarray(np.where(real[:, None], directions[chosen], towards), jnp.float32),
        ),
        status=jnp.asarray(kind, jnp.int32),
        rgb=jnp.asarray(np.where(real[:, None], frame.rgb.reshape(-1, 3)[flat[chosen]] / 255.0, 0.0), jnp.float32),
        rgb_valid=jnp.asarray(kind == OBJECT),
        range=jnp.asarray(np.where(kind == OBJECT, metres, 0.0) / cube.half_extent, jnp.float32),
        range_sigma=jnp.asarray(sigma / cube.half_extent, jnp.float32),
        range_valid=jnp.asarray(measured & (kind == OBJECT)),
        limit=jnp.asarray(limit, jnp.float32),
        pose_sigma=jnp.asarray(
            [
                cube.xy_sigma,
                cube.xy_sigma,
                cube.log_scale_sigma,
                config.range_offset_sigma / cube.half_extent,
                config.plane_sigma / cube.half_extent,
            ],
            jnp.float32,
        ),
        colour_count=config.colour_rays,
    )
    return observation, cube


def object_frame(frame: Frame, segment: Segment, config: ObserveConfig) -> ObjectFrame:
    """The cube about a segment's object, from its visible points.

    Raises `ValueError` where they are too few, or the object's size is out of range.
    """
    points = backproject(frame)
    core = (segment.status == OBJECT) & np.isfinite(points[..., 2])
    if core.sum() < 10:
        raise ValueError(
            f"object {segment.id} has depth in {core.sum()} pixels inside its outline; move the camera nearer"
        )
    # The rim counts here, where its depth continues the object's: it is wide on surfaces seen at a grazing angle.
    row, column = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    with np.errstate(invalid="ignore"):
        core |= segment.mask & (np.linalg.norm(points - points[row, column], axis=-1) < config.rim_reach)
    core &= heights(points, segment.plane) > 0.0
    # Where the outline borders on something nearer, or on the picture's edge, the object goes on unseen.
    width = config.outline_px
    hidden = ndimage.binary_dilation(np.pad(segment.occluder, width, constant_values=True), iterations=width)
    hidden = hidden[width:-width, width:-width]
    outline = segment.mask & ~ndimage.binary_erosion(segment.mask, border_value=0)
    share = float((hidden & outline).sum() / outline.sum())
    thin = max(1, core.sum() // 10_000)
    cloud = points[core][::thin]
    up, d = segment.plane[:3], segment.plane[3]
    axes = _axes(up, np.median(cloud, axis=0))
    seen = np.column_stack([cloud @ axes[:2].T, heights(cloud, segment.plane)])
    centre, across, height, top_seen = _body(seen, hidden[core][::thin], float(d))
    if height < config.min_height or max(across, height) > config.max_side:
        raise ValueError(
            f"object {segment.id} measures {100 * across:.1f} cm across and {100 * height:.1f} cm in height; tabletop"
            f" objects are {100 * config.min_height:g} cm high to {100 * config.max_side:g} cm: give another object"
        )
    half_extent = max(across, height) / BODY_EXTENT
    foot = centre @ axes[:2] - d * up  # on the plane, where n.p = -d
    T = np.eye(4)
    T[:3, :3] = _axes(up, foot).T
    T[:3, 3] = foot - BASE_Z * half_extent * up
    extra = config.hidden_sigma * share + (0.0 if top_seen else config.side_sigma)
    return ObjectFrame(T, half_extent, segment.plane, config.xy_sigma + extra, config.log_scale_sigma + extra)


def _axes(up: Float[np.ndarray, "3"], at: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rows x, y, z of an object frame at a point of the camera frame: x horizontal towards the camera."""
    x = -at - (-at @ up) * up
    if np.linalg.norm(x) < 1e-3 * np.linalg.norm(at):  # straight from above: towards the picture's lower edge
        x = np.array([0.0, 1.0, 0.0]) - up[1] * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _body(
    seen: Float[np.ndarray, "n 3"], hidden: Bool[np.ndarray, "n"], camera_height: float
) -> tuple[Float[np.ndarray, "2"], float, float, bool]:
    """Horizontal centre, width and height (m) of a body from its visible points (x to the camera, y, height; m).

    Where the camera looks down on the top (the last answer), the top's chords have the axis in their middle, and
    medians over chords pass over handles and spouts. Where it does not, only the near side is seen, and the axis is
    half a width behind it, as in a body of revolution. A side that borders on something `hidden` is not the body's end:
    then the axis is half a width, taken from the top's depth, from the other side.
    """
    x, y, z = seen.T
    height = float(np.percentile(z, 99))
    low, high, low_cut, high_cut = _extents(y, z, hidden)
    middle, length = (low + high) / 2, high - low
    centre_y = float(np.median(middle[length <= np.median(length)]))  # a handle at the side reaches over other heights
    radius = float(np.percentile(np.minimum(centre_y - low, high - centre_y), 90))  # and over one side alone
    front = np.abs(y - centre_y) < 0.35 * radius
    centre_x = float(np.percentile(x[front] if front.any() else x, 95)) - radius
    width = 2.0 * radius
    top = z > height - max(0.01, 0.1 * height)
    top_seen = bool(np.arctan2(camera_height - height, -np.median(x)) > _LOOKS_DOWN and top.sum() > 50)
    if top_seen:
        back, near, _, _ = _extents(x[top], y[top], hidden[top])
        left, right, _, _ = _extents(y[top], x[top], hidden[top])
        centre_x, centre_y = float(np.median(back + near)) / 2, float(np.median(left + right)) / 2
        # The longest side whatever its direction: most chords of a box, some of a disc, few of a handle are that long.
        for angle in np.radians(np.arange(0.0, 180.0, 15.0)):
            along, over = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
            start, end, _, _ = _extents(along[top], over[top], hidden[top])
            width = max(width, float(np.percentile(end - start, 70)))
    if (low_cut.mean() > 0.4) != (high_cut.mean() > 0.4):
        at_high = high_cut.mean() > 0.4
        centre_y = float(np.percentile(low, 30)) + width / 2 if at_high else float(np.percentile(high, 70)) - width / 2
    return np.array([centre_x, centre_y]), width, height, top_seen


def _extents(
    along: Float[np.ndarray, "n"], over: Float[np.ndarray, "n"], hidden: Bool[np.ndarray, "n"], bins: int = 12
) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b"], Bool[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
    """Ends of the points' extent in one coordinate, in equal bins of another, and whether the ends border on hidden."""
    low, high = np.percentile(over, [1, 99])
    at = np.floor((over - low) / max(high - low, 1e-9) * bins)
    rows = []
    for inside in [at == b for b in range(bins) if (at == b).sum() >= 5] or [at == at]:
        first, last = np.percentile(along[inside], [1, 99])
        margin = 0.05 * (last - first)
        cuts = [hidden[inside & end].mean() > 0.3 for end in (along <= first + margin, along >= last - margin)]
        rows.append((first, last, *cuts))
    first, last, first_cut, last_cut = np.array(rows).T
    return first, last, first_cut > 0, last_cut > 0


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
    """
    if len(candidates) <= count:
        return candidates
    if count <= 1:
        return rng.choice(candidates, count)
    first = count // 2
    cut = round(len(candidates) * first / count)
    side = int(np.ptp(pixels[candidates], axis=0).argmax())
    order = candidates[np.argpartition(pixels[candidates, side], cut)]
    return np.append(_spread(pixels, order[:cut], first, rng), _spread(pixels, order[cut:], count - first, rng))


def seen_voxels(frame: Frame, cube: ObjectFrame, grid: int = 64) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels [i_x, i_y, i_z] of the cube that the camera saw: free before the measured end of their ray, or at it.

    "At it": the centre is at most half a voxel's diagonal behind the surface. Not seen: outside the picture, no depth.
    """
    if frame.depth is None:
        return np.zeros((grid, grid, grid), bool)
    points, pixels, inside = _voxels(frame.camera, cube, grid)
    z = frame.depth[pixels[:, 1], pixels[:, 0]]
    distance = np.linalg.norm(points, axis=1)
    half_diagonal = np.sqrt(3.0) / grid * cube.half_extent
    with np.errstate(invalid="ignore"):
        seen = inside & (distance * (1.0 - z / points[:, 2]) <= half_diagonal)
    return seen.reshape(grid, grid, grid)


def inside_view(camera: Camera, cube: ObjectFrame, grid: int = 64) -> Bool[np.ndarray, "grid grid grid"]:
    """Voxels [i_x, i_y, i_z] of the cube whose centre falls inside the picture."""
    return _voxels(camera, cube, grid)[2].reshape(grid, grid, grid)


def _voxels(
    camera: Camera, cube: ObjectFrame, grid: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n 2"], Bool[np.ndarray, "n"]]:
    """Voxel centres in the camera frame (m), the pixel each falls in (clipped), and whether that is in the picture."""
    ticks = -1.0 + (np.arange(grid) + 0.5) * 2.0 / grid
    points = cube.to_camera(np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3))
    px = np.round(np.nan_to_num(camera.project(points), nan=-1.0))
    size = np.array([camera.width, camera.height])
    inside = ((px >= 0) & (px < size)).all(axis=1)
    return points, np.clip(px, 0, size - 1).astype(np.intp), inside
