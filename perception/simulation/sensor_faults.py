"""A depth camera's faults, added to a faultless picture: noise, holes, flying pixels, quantised depth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32
from scipy import ndimage
from scipy.special import ndtr

from calibration.camera import Camera
from perception.simulation.depth_faults import (
    cavity_depth,
    fatten_edges,
    fill_cavities,
    in_cavity,
    luminance,
    mirror_angle,
    smoothed,
    stereo_shadow,
)
from perception.simulation.simulated_camera import _SUB, FaultlessImage, TableScene, render
from perception.sources.frame import Frame


@dataclass(frozen=True)
class SensorConfig:
    """Faults of an active stereo camera. z is the depth of a pixel in metres. From `bias` on all are off by default."""

    noise: float = 0.001  # m: the standard deviation of depth is noise + noise_z2 z^2
    noise_z2: float = 0.002  # 1/m
    noise_width: float = 0.6  # px: neighbours' noise is alike this far
    quantum: float = 0.001  # m: depth comes in whole steps
    max_range: float = 4.0  # m: nothing beyond
    baseline: float = 0.05  # m to the second eye or projector, which is right (< 0: left): what it does not see is lost
    grazing: float = 80.0  # degrees between ray and normal beyond which depth begins to fail
    edge: float = 0.01  # m of depth within a pixel that make it a mixed one
    flying: float = 0.3  # share of the mixed pixels that report a depth in between; the others report none
    blobs: float = 3e-5  # holes per pixel
    blob_radius: float = 2.0  # px, median
    colour_noise: float = 0.006  # of [0, 1]
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # depth is too long by b0 + b1 z + b2 z^2: m, 1, 1/m
    fattening: int = 0  # px that foreground depth spreads over what is behind it
    dark: float = 0.0  # of [0, 1]: brightness below which depth begins to fail; black has none
    shiny: float = 0.0  # degrees about the mirror direction within which glare on glossy things blinds the sensor
    cavity: float = 0.0  # share that a white cavity's inside is moved towards its opening by multi-path
    cavity_lost: float = 0.0  # share of a white cavity's inside without depth
    rim_lost: float = 0.0  # share without depth of the pixels within `rim` px of a step in depth
    rim: int = 2  # px
    registration: tuple[float, float] = (0.0, 0.0)  # px (right, down) that colour and label lie beside depth
    smoothing: float = 0.0  # px: width of the sensor's own spatial filter, which keeps edges
    patch: float = 1.5  # px: size of the patches in which dark, shiny, concave and rim pixels fail


def simulate(
    scene: TableScene,
    camera: Camera,
    T_world_camera: Float[np.ndarray, "4 4"],
    seed: int,
    config: SensorConfig | None = None,
    stamp_ns: int = 0,
) -> Frame:
    """One frame of a scene with the sensor's faults and the true label map. It depends on its arguments alone."""
    return sense(render(scene, camera, T_world_camera), camera, T_world_camera, seed, config, stamp_ns)


def sense(
    picture: FaultlessImage,
    camera: Camera,
    T_world_camera: Float[np.ndarray, "4 4"] | None,
    seed: int,
    config: SensorConfig | None = None,
    stamp_ns: int = 0,
) -> Frame:
    """A faultless picture as a frame of a faulty sensor."""
    config = config or SensorConfig()
    rng = np.random.default_rng([seed, 5])
    shape = picture.depth.shape
    lost = stereo_shadow(picture.depth, camera.K[0, 0], config.baseline)
    deep = cavity_depth(picture) if config.cavity or config.cavity_lost else np.zeros(shape)
    lost |= _blind(picture, deep, camera, np.random.default_rng([seed, 13]), config)
    if config.cavity:
        picture = fill_cavities(picture, deep, config.cavity)
    if config.fattening:
        picture = fatten_edges(picture, config.fattening, config.edge)
    with np.errstate(invalid="ignore"):
        spread = picture.farthest - picture.nearest  # m; NaN where there is nothing at all
    # Mixed pixels: in between, or nothing.
    mixed = ~(spread < config.edge)
    between = picture.nearest + rng.random(shape) * np.where(np.isfinite(spread), spread, 0.0)
    z = np.where(mixed, between, picture.depth)
    lost |= mixed & (rng.random(shape) > config.flying)
    # Grazing: neighbouring rays, z / (2 f) apart across the view, differ in depth by tan(angle) times that.
    slope = np.where(mixed, 0.0, spread) / (z / camera.K[0, 0] / _SUB)
    lost |= rng.random(shape) < np.clip(slope / np.tan(np.deg2rad(config.grazing)) - 1.0, 0.0, 1.0)
    lost |= _blobs(rng, shape, config)
    with np.errstate(invalid="ignore"):  # where there is nothing, z is infinite, and lost below
        z = z + (config.noise + config.noise_z2 * z**2) * _noise(rng, shape, config.noise_width)
        if any(config.bias):
            z = z + np.polynomial.polynomial.polyval(z, config.bias)
    if config.smoothing:
        z = smoothed(z, lost, config.smoothing)
    z = np.rint(z / config.quantum) * config.quantum
    lost |= ~(z > 0) | (z > config.max_range)
    gain = 1.0 + 0.01 * rng.standard_normal()
    colour, label = _registered(picture, config.registration)
    rgb = gain * colour + config.colour_noise * rng.standard_normal((*shape, 3))
    return Frame(
        stamp_ns=stamp_ns,
        frame_id="camera_color_optical_frame",
        rgb=np.rint(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8),
        depth=np.where(lost, np.nan, z).astype(np.float32),
        label=label,
        camera=camera,
        T_world_camera=T_world_camera,
    )


def _blind(
    picture: FaultlessImage,
    deep: Float[np.ndarray, "h w"],
    camera: Camera,
    rng: np.random.Generator,
    config: SensorConfig,
) -> Bool[np.ndarray, "h w"]:
    """Pixels without depth because of what they look at: dark, shiny, inside a bright cavity, at a rim."""
    shape = picture.depth.shape
    fails = np.zeros(shape)  # probability
    if config.dark:
        fails = np.maximum(fails, np.clip(1.0 - luminance(picture) / config.dark, 0.0, 1.0))
    if config.shiny:
        gloss = picture.label > 0 if picture.gloss is None else picture.gloss
        glare = np.clip(2.0 - 2.0 * mirror_angle(picture.depth, camera, config.baseline) / config.shiny, 0.0, 1.0)
        fails = np.maximum(fails, gloss * np.nan_to_num(glare))
    if config.cavity_lost:
        fails = np.maximum(fails, config.cavity_lost * in_cavity(picture, deep))
    if config.rim_lost:
        with np.errstate(invalid="ignore"):
            steps = ~(picture.farthest - picture.nearest < config.edge)
        band = ndimage.binary_dilation(steps, np.ones((3, 3), bool), iterations=config.rim) if config.rim else steps
        fails = np.maximum(fails, config.rim_lost * band)
    return ndtr(_noise(rng, shape, config.patch)) < fails if fails.any() else np.zeros(shape, bool)


def _registered(
    picture: FaultlessImage, shift: tuple[float, float]
) -> tuple[Float[np.ndarray, "h w 3"], Int32[np.ndarray, "h w"]]:
    """Colour and label, moved by `shift` px (right, down) under depth."""
    if not any(shift):
        return picture.rgb, picture.label
    right, down = shift
    return (
        ndimage.shift(picture.rgb, (down, right, 0), order=1, mode="nearest"),
        ndimage.shift(picture.label, (down, right), order=0, mode="nearest"),
    )


def _noise(rng: np.random.Generator, shape: tuple[int, ...], width: float) -> Float[np.ndarray, "h w"]:
    """Gaussian noise of unit variance, smoothed over `width` pixels."""
    impulse = np.zeros((33, 33))
    impulse[16, 16] = 1.0
    gain = np.linalg.norm(ndimage.gaussian_filter(impulse, width))
    return ndimage.gaussian_filter(rng.standard_normal(shape), width) / gain


def _blobs(rng: np.random.Generator, shape: tuple[int, ...], config: SensorConfig) -> Bool[np.ndarray, "h w"]:
    """Round holes at random."""
    lost = np.zeros(shape, bool)
    for _ in range(rng.poisson(config.blobs * lost.size)):
        row, column = rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
        radius = config.blob_radius * np.exp(0.5 * rng.standard_normal())
        low = np.maximum(np.array([row, column]) - radius, 0).astype(int)
        high = np.minimum(np.array([row, column]) + radius + 1, shape).astype(int)
        window = np.s_[low[0] : high[0], low[1] : high[1]]
        y, x = np.mgrid[window]
        lost[window] |= (y - row) ** 2 + (x - column) ** 2 < radius**2
    return lost
