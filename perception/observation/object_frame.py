"""The cube that an object is inferred in: its place and size, and their uncertainty."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from calibration.camera import Camera
from perception.observation.segmentation import Segment, backproject
from perception.observation.settings import ObjectFrameConfig
from perception.observation.support_plane import heights
from perception.observation.visible_extent import visible_body
from perception.observation.without_depth import standing_body
from perception.sources.frame import Frame
from probnerf.pixel_status import OBJECT
from probnerf.types import BASE_Z, BODY_EXTENT

# The larger of a body's width and height is this many cube units: the scale convention of the prior.


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
    sight_sigma: float = 0.0  # relative error that distance, place and size share: without depth, or of its scale

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


def object_frame(frame: Frame, segment: Segment, config: ObjectFrameConfig) -> ObjectFrame:
    """The cube about a segment's object: from its visible points or, without depth, from its outline.

    Raises `ValueError` if they are too few, or the object's size is out of range.
    """
    hidden = _beside_the_unseen(segment, config.outline_px)
    outline = segment.mask & ~ndimage.binary_erosion(segment.mask, border_value=0)
    extra = config.hidden_sigma * float((hidden & outline).sum() / outline.sum())
    if frame.depth is None:
        return _outlined_frame(frame.camera, segment, hidden, extra, config)
    cloud, cloud_hidden = _object_points(frame, segment, hidden, config.rim_reach)
    up, d = segment.plane[:3], segment.plane[3]
    axes = _axes(up, np.median(cloud, axis=0))
    body = np.column_stack([cloud @ axes[:2].T, heights(cloud, segment.plane)])
    centre, across, height, top_seen = visible_body(body, cloud_hidden, float(d))
    foot = centre @ axes[:2] - d * up  # on the plane, where n.p = -d
    extra += 0.0 if top_seen else config.side_sigma
    cube = _frame_about(foot, across, height, segment, extra, config)
    return replace(cube, sight_sigma=config.depth_scale_sigma)


def _beside_the_unseen(segment: Segment, width: int) -> Bool[np.ndarray, "h w"]:
    """Pixels within `width` px of a nearer object or of the picture's edge, where more of the object may be hidden."""
    beside = ndimage.binary_dilation(np.pad(segment.occluder, width, constant_values=True), iterations=width)
    return beside[width:-width, width:-width]


def _object_points(
    frame: Frame, segment: Segment, hidden: Bool[np.ndarray, "h w"], rim_reach: float
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """Measured points of the object above the plane (camera frame, m), about 10,000 at most, and which are `hidden`.

    Raises ValueError if there are fewer than ten.
    """
    (box,) = ndimage.find_objects(segment.mask.astype(np.int8))  # all of the object is in it
    points, mask = backproject(frame)[box], segment.mask[box]
    core = (segment.status[box] == OBJECT) & np.isfinite(points[..., 2])
    if core.sum() < 10:
        raise ValueError(
            f"object {segment.id} has depth in {core.sum()} pixels inside its outline; move the camera "
            "nearer, and see that depth is aligned to colour"
        )
    # The rim counts here, where its depth continues the object's: it is wide on surfaces seen at a grazing angle.
    row, column = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    with np.errstate(invalid="ignore"):
        core |= mask & (np.linalg.norm(points - points[row, column], axis=-1) < rim_reach)
    core &= heights(points, segment.plane) > 0.0
    if core.sum() < 10:  # a flat thing, where the plane is measured some millimetres too high
        raise ValueError(
            f"object {segment.id} has {core.sum()} measured points above the plane that it stands on; give the plane,"
            " or another object"
        )
    thin = max(1, core.sum() // 10_000)
    return points[core][::thin], hidden[box][core][::thin]


def _outlined_frame(
    camera: Camera, segment: Segment, hidden: Bool[np.ndarray, "h w"], extra: float, config: ObjectFrameConfig
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
    foot: Float[np.ndarray, "3"],
    across: float,
    height: float,
    segment: Segment,
    extra: float,
    config: ObjectFrameConfig,
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
