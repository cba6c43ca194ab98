"""Place and size of an object in a view without depth, from its mask and a given support plane.

Symbols: the camera is h over the plane; a point is at horizontal distance rho from the place below the camera, in
direction phi, at height z; slope = (h - z) / rho is the tangent of its ray's angle below the horizon.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from calibration.camera import Camera
from perception.observation.settings import PlaneGuess
from perception.observation.visible_extent import whole_extent
from perception.sources.frame import Frame
from probnerf.pixel_status import FREE

# Added to the prior's standard deviations without depth (cube units towards the camera and across, log-scale): for
# bodies with a round foot, and for others, whose depth is not visible in a silhouette. From validation objects.
_ROUND, _ANGULAR = (0.03, 0.0, 0.0), (0.30, 0.06, 0.12)
_NOT_ROUND = 0.07  # rms deviation of the foot's outline from an arc, of its radius; cartons: more, others: less
_STEEPEST = 4.0  # slope of the nearest point of the foot (76 degrees), beyond which a picture shows no height
# Share of the mask outside of the upright body's outline, and the same plus the share of the outline that the mask does
# not fill, above which a thing lies. From validation objects: vessels with their handles, and cartons, have less.
_OUTSIDE, _UNLIKE = 0.30, 0.42
_AROUND = 6  # px about the mask in which the outline is compared
_FLAT = 0.3  # height of what lies, of the shorter side of its outline on the plane
_MOST = 0.5  # largest relative error of the distance that counts as a guess


@dataclass(frozen=True, eq=False)
class StandingBody:
    """An upright body on a plane, as a silhouette shows it (camera frame, m), and how far the guess may be off."""

    foot: Float[np.ndarray, "3"]  # where its axis meets the plane
    across: float  # m
    height: float  # m
    sight_sigma: float  # relative; error that distance, place and size share (`standing_body`)
    along_sigma: float  # cube units; of the axis towards the camera, beyond that
    across_sigma: float  # cube units; of the axis across the view
    log_scale_sigma: float


def supposed_plane(frame: Frame, guess: PlaneGuess) -> Float[np.ndarray, "4"]:
    """The support plane (n, d) in the camera frame (m). Raises `ValueError` if it is unknown."""
    if guess.camera_height is not None and guess.tilt is not None:
        tilt = np.radians(guess.tilt)
        return np.array([0.0, -np.cos(tilt), -np.sin(tilt), guess.camera_height])
    if frame.T_world_camera is None:
        raise ValueError(
            "without depth the plane that objects stand on is unknown: record depth or the camera's pose, or give"
            " camera_height (m) and tilt (degrees below the horizon) under segment.guess in the configuration"
        )
    height = float(frame.T_world_camera[2, 3]) - guess.table
    if not height > 0:
        raise ValueError(
            f"the camera is {-height:g} m under the table at {guess.table:g} m; correct segment.guess.table"
        )
    return np.append(frame.T_world_camera[2, :3], height)


def slopes(rays: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, "4"]) -> Float[np.ndarray, "n"]:
    """Tangent of the angle below the horizon of rays in the camera frame."""
    down = -rays @ plane[:3]
    return down / np.sqrt(np.maximum(1.0 - down**2, 1e-12))


def plane_depth(
    camera: Camera, plane: Float[np.ndarray, "4"], status: Int[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Depth (m along z) at which FREE pixels would see the plane: inf above the horizon; NaN in other pixels."""
    v, u = np.nonzero(status == FREE)
    rays = camera.rays(np.column_stack([u, v]))
    down = -rays @ plane[:3]
    depth = np.full(status.shape, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth[v, u] = np.where(down > 0, plane[3] / down * rays[:, 2], np.where(np.isfinite(down), np.inf, np.nan))
    return depth


def standing_body(
    camera: Camera,
    mask: Bool[np.ndarray, "h w"],
    hidden: Bool[np.ndarray, "h w"],
    plane: Float[np.ndarray, "4"],
    plane_sigma: tuple[float, float],
) -> StandingBody:
    """The body that a mask outlines, if it stands on the plane; `plane_sigma`: of the height (m) and the tilt (rad).

    A vertical cylinder of radius R whose axis is at distance D fills the directions |phi| <= alpha, sin alpha = R / D,
    independent of its height. The lowest pixel sees the near side of its foot, slope_near = h / (D - R). The highest
    one sees the far side of its top, slope_far = (h - height) / (D + R), or its near side if the top is above the
    camera. So
        D = h / slope_near / (1 - sin alpha_foot),   R = D sin alpha,   height = h - slope_far D (1 + sin alpha_top),
    with alpha_foot and alpha_top of the pixels nearer than the axis in the foot's plane and farther in the top's.

    A plane that is d_h higher and d_tilt steeper than supposed moves the foot along its ray by the share
    d_h / h + d_tilt / slope of its distance. As the outline stays the same, the body grows by the same share: a scaling
    about the camera, which no pixel can detect. `sight_sigma` is its standard deviation.

    If the foot's outline is not an arc, the body is not one of revolution: its width is visible, its depth hardly. If
    the mask is below the horizon and unlike the upright body's outline (`_lies`), the thing lies, and is as large as
    its own outline is on the plane, less what its height adds behind.
    Raises `ValueError` if the foot is hidden or above the horizon, or seen too steeply or too flatly, or if the middle
    is not seen.
    """
    up, h = plane[:3], float(plane[3])
    v, u = np.nonzero(mask)
    rays = camera.rays(np.column_stack([u, v]))
    known = np.isfinite(rays).all(axis=1)
    rays, covered = rays[known], hidden[v, u][known]
    forward = np.median(rays, axis=0)
    forward -= (forward @ up) * up
    forward /= np.linalg.norm(forward)
    side = np.cross(up, forward)
    phi, slope = np.arctan2(rays @ side, rays @ forward), slopes(rays, plane)
    low, high = _ends(phi, slope, 16)
    middle, length = (low + high) / 2, high - low
    axis = float(np.median(middle[length <= np.median(length)]))  # a handle at the side reaches over other heights
    phi -= axis
    alpha = float(np.percentile(np.minimum(axis - low, high - axis), 90))  # and over one side alone
    central = np.abs(phi) < 0.35 * alpha
    if not central.any():
        raise ValueError(
            "nothing of it is seen about its middle, which shows its height without depth: move the camera"
        )
    top, bottom = (float(np.median(end)) for end in _ends(slope[central], phi[central], 7))
    at_bottom = central & (slope > bottom - 0.1 * (bottom - top))
    if covered[at_bottom].mean() > 0.5:
        raise ValueError(
            "its foot is hidden or cut off, and without depth its place is known from the foot alone: show the foot"
        )
    if bottom > _STEEPEST:
        raise ValueError(
            "it is seen from straight above, and without depth this view does not show its height: tilt the camera"
        )
    if not bottom > 0:
        raise ValueError("its foot is above the horizon: correct the camera's height and tilt, or its pose")
    foot = alpha
    for _ in range(4):
        D = h / bottom / (1.0 - np.sin(foot))
        foot = _half_width(phi[slope > h / (D * np.cos(foot))], 0.3 * alpha, alpha)
    end = alpha
    for _ in range(4):
        height = h - top * D * (1.0 + np.sin(end) if top > 0 else 1.0 - np.sin(end))
        end = _half_width(phi[slope < (h - height) / (D * np.cos(end))], 0.1 * alpha, alpha)
    round_ = _deviation(phi, h / np.maximum(slope, 1e-6), D, foot) < _NOT_ROUND
    along, across, scale = _ROUND if round_ else _ANGULAR
    pixel = 1.0 / camera.K[1, 1]  # rad; the foot's outline is known to about one pixel
    sight = float(np.hypot(plane_sigma[0] / h, np.hypot(plane_sigma[1], pixel) * D / h))
    if sight > _MOST:
        raise ValueError(
            f"its distance would be known to {100 * sight:.0f}%: raise the camera, or give height_sigma and tilt_sigma"
        )
    width = 2.0 * D * np.sin(alpha)
    centre = D * np.array([np.cos(axis), np.sin(axis)])
    if top > 0 and _lies(camera, mask, hidden, plane, forward, axis, (D, 0.5 * width, max(height, 0.0))):
        centre, width, height = _lying(phi + axis, slope, h)
        along, across, scale = _ANGULAR
    place = centre[0] * forward + centre[1] * side - h * up
    return StandingBody(place, float(width), max(float(height), 0.0), sight, along, across, scale)


def _lies(
    camera: Camera,
    mask: Bool[np.ndarray, "h w"],
    hidden: Bool[np.ndarray, "h w"],
    plane: Float[np.ndarray, "4"],
    forward: Float[np.ndarray, "3"],
    axis: float,
    body: tuple[float, float, float],
) -> bool:
    """Whether a mask is unlike the outline of an upright cylinder (distance, radius, height) in direction `axis`."""
    v, u = np.nonzero(ndimage.binary_dilation(mask, iterations=_AROUND))
    rays = camera.rays(np.column_stack([u, v]))
    known = np.isfinite(rays).all(axis=1)
    rays, v, u = rays[known], v[known], u[known]
    phi = np.arctan2(rays @ np.cross(plane[:3], forward), rays @ forward) - axis
    inside, seen = _upright(phi, slopes(rays, plane), float(plane[3]), *body), mask[v, u]
    outside = float((seen & ~inside).sum() / seen.sum())
    empty = float((inside & ~seen & ~hidden[v, u]).sum() / max(inside.sum(), 1))
    return outside > _OUTSIDE or outside + empty > _UNLIKE


def _upright(
    phi: Float[np.ndarray, "n"], slope: Float[np.ndarray, "n"], h: float, D: float, R: float, height: float
) -> Bool[np.ndarray, "n"]:
    """Which rays meet the upright cylinder at distance D in direction 0."""
    half = np.sqrt(np.maximum(R**2 - (D * np.sin(phi)) ** 2, 0.0))
    enters, leaves = h - slope * (D * np.cos(phi) - half), h - slope * (D * np.cos(phi) + half)  # heights
    return (np.abs(D * np.sin(phi)) <= R) & (np.maximum(enters, leaves) >= 0) & (np.minimum(enters, leaves) <= height)


def _lying(
    phi: Float[np.ndarray, "n"], slope: Float[np.ndarray, "n"], h: float
) -> tuple[Float[np.ndarray, "2"], float, float]:
    """Middle (forward, side), longest side and height (m) of what lies flat where a mask's rays meet the plane."""
    rho = h / np.maximum(slope, 0.2 * np.median(slope))
    on_plane = rho[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    centre, _, shorter = whole_extent(on_plane)
    height, away = _FLAT * shorter, centre / np.linalg.norm(centre)
    behind = height / float(np.median(slope))  # so much of the plane its top hides
    on_plane -= np.where(on_plane @ away > centre @ away, behind, 0.0)[:, None] * away
    centre, longest, _ = whole_extent(on_plane)
    return centre, longest, height


def _ends(
    values: Float[np.ndarray, "n"], over: Float[np.ndarray, "n"], bins: int
) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b"]]:
    """Least and largest values in equal bins of another coordinate."""
    low, high = np.percentile(over, [0.5, 99.5])
    at = np.floor((over - low) / max(high - low, 1e-9) * bins)
    inside = [at == b for b in range(bins) if (at == b).sum() >= 4] or [at == at]
    return np.array([values[i].min() for i in inside]), np.array([values[i].max() for i in inside])


def _half_width(phi: Float[np.ndarray, "n"], least: float, most: float) -> float:
    """How far pixels reach to both sides of the axis."""
    low, high = np.percentile(phi, [0.5, 99.5]) if len(phi) else (0.0, 0.0)
    return float(np.clip(min(-low, high), least, most))


def _deviation(phi: Float[np.ndarray, "n"], rho: Float[np.ndarray, "n"], D: float, foot: float) -> float:
    """Rms deviation of the foot's near outline from a circle, relative to its radius; large with too few pixels."""
    at = np.linspace(-0.75, 0.75, 12) * foot
    columns = [np.abs(phi - a) < 0.07 * foot for a in at]
    if not all(c.any() for c in columns):
        return np.inf
    R = D * np.sin(foot)
    arc = D * np.cos(at) - np.sqrt(R**2 - (D * np.sin(at)) ** 2)
    off = (np.array([rho[c].min() for c in columns]) - arc) / R
    return float(np.sqrt(np.mean((off - np.median(off)) ** 2)))
