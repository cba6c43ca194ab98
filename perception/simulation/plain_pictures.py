"""Plain pictures to train the posterior network on: one object alone, as the encoder's crop would show it.

They pass by perception: the cube is the object's own with errors of the usual widths, the mask is the true one but for
its rim, ranges have a bias and white noise. So they are ten times as fast to draw as those of `training_pictures`, and
teach how whole shapes look, for which a network needs very many objects. The others teach what perception makes of
them: what is beside, in front, missing and mistaken.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from perception.observation.settings import ObserveConfig
from perception.simulation.ray_caster import Hits, RayCaster
from probnerf.geometry import look_at, pinhole_rays
from probnerf.prior.encoder_input import ENCODER_RADIUS
from probnerf.training.learnt_objects import Colours, LearntObject
from probnerf.types import Pose, on_device


@dataclass(frozen=True)
class PlainDraws:
    """What is drawn. Ranges are uniform; cube units."""

    elevation: tuple[float, float] = (12.0, 70.0)  # degrees above the table
    distance_m: tuple[float, float] = (0.35, 1.0)  # from the cube's middle,
    nearest: float = 3.5  # and at least so far
    observe: ObserveConfig = field(default_factory=ObserveConfig)  # perception's widths of the pose
    unsure: float = 0.5  # probability that the pose is less sure than the least, as where a part is hidden,
    extra_sigma: tuple[float, float] = (0.0, 0.3)  # by so much
    noise: tuple[float, float] = (0.002, 0.02)  # of each range
    rim: float = 0.7  # probability that the mask's outermost pixels are not believed
    lost: tuple[float, float] = (0.0, 0.1)  # share of the pixels that tell nothing, in specks


@dataclass(frozen=True, eq=False)
class TrainingPicture:
    """As a row of `PictureSet`."""

    rgb: Float[np.ndarray, "s s 3"]
    distance: Float[np.ndarray, "s s"]
    unknown: Bool[np.ndarray, "s s"]
    T_view_camera: Float[np.ndarray, "4 4"]
    tan_half_fov: float
    pose_sigma: Float[np.ndarray, "5"]
    yaw: float
    pose: Float[np.ndarray, "4"]  # x, y, log-scale, z in units of `pose_sigma`


class Pictured(Protocol):
    """What a picture is taken of."""

    @property
    def half_extent(self) -> float:
        """m per cube unit."""
        ...

    @property
    def colours(self) -> Colours:
        """Of its surface."""
        ...


class Caster(Protocol):
    """Where rays meet it."""

    def cast(self, origins: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Of unit directions from one place (cube units)."""
        ...


def draw_plain(
    rng: np.random.Generator,
    thing: Pictured,
    views: int,
    size: int,
    draws: PlainDraws | None = None,
    caster: Caster | None = None,
) -> list[TrainingPicture]:
    """So many views of an object, from any side; none of those in which it covers no pixel.

    Its mesh meets the rays, if `caster` does not.
    """
    draws = draws or PlainDraws()
    if caster is None:
        assert isinstance(thing, LearntObject), "what has no mesh needs a caster"
        caster = RayCaster([(thing.vertices, thing.faces)])
    pictures = (_view(rng, thing, caster, size, draws) for _ in range(views))
    return [picture for picture in pictures if picture is not None]


def _view(
    rng: np.random.Generator, thing: Pictured, caster: Caster, size: int, draws: PlainDraws
) -> TrainingPicture | None:
    yaw, sigma, drawn = _pose(rng, thing.half_extent, draws)
    x, y, log_scale, z = drawn * sigma[[0, 1, 2, 4]]
    pose = Pose(*(on_device(a) for a in (yaw, x, y, log_scale, z)))
    elevation = np.deg2rad(rng.uniform(*draws.elevation))
    away = max(rng.uniform(*draws.distance_m) / thing.half_extent * np.exp(log_scale), draws.nearest)
    T = look_at(away * np.array([np.cos(elevation), 0.0, np.sin(elevation)]), np.zeros(3))
    tan_half = ENCODER_RADIUS / away
    origin, direction = pinhole_rays(T, 0.5 * size / tan_half, size)
    start = np.asarray(pose.to_object(on_device(origin[0])))
    towards = np.asarray(pose.to_object_direction(on_device(direction)))
    met = caster.cast(start, towards)
    hit = np.isfinite(met.distance)
    if not hit.any():
        return None
    points = start + met.distance[hit, None] * towards[hit]
    rgb = np.tile(rng.uniform(0.1, 0.95, 3), (size * size, 1)) + rng.normal(0.0, 0.05, (size * size, 1))  # the table
    rgb[hit] = thing.colours(points, met.normal[hit]) * rng.uniform(0.7, 1.2)
    bias = sigma[3] * rng.standard_normal()
    noise = rng.uniform(*draws.noise)
    distance = np.zeros(size * size)
    distance[hit] = met.distance[hit] * np.exp(log_scale) + bias + noise * rng.standard_normal(hit.sum())
    mask = hit.reshape(size, size)
    unknown = rng.random((size, size)) < rng.uniform(*draws.lost)
    if rng.random() < draws.rim:
        unknown |= mask & ~ndimage.binary_erosion(mask, border_value=1)
    return TrainingPicture(
        rgb=np.clip(rgb, 0.0, 1.0).reshape(size, size, 3),
        distance=np.where(unknown, 0.0, distance.reshape(size, size)),
        unknown=unknown,
        T_view_camera=T,
        tan_half_fov=tan_half,
        pose_sigma=sigma,
        yaw=yaw,
        pose=drawn,
    )


def _pose(
    rng: np.random.Generator, half_extent: float, draws: PlainDraws
) -> tuple[float, Float[np.ndarray, "5"], Float[np.ndarray, "4"]]:
    """Yaw, the pose's widths (`Observation.pose_sigma`), and x, y, log-scale and z in units of these."""
    widths = draws.observe
    extra = rng.uniform(*draws.extra_sigma) * (rng.random() < draws.unsure)
    xy, scale = widths.xy_sigma + extra, widths.log_scale_sigma + extra
    sigma = np.array([xy, xy, scale, widths.range_offset_sigma / half_extent, widths.plane_sigma / half_extent])
    return rng.uniform(-np.pi, np.pi), sigma, rng.standard_normal(4)
