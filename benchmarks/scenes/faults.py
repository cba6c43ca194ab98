"""Faults of sensor and calibration of growing size, and smaller settings of the model."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import ndimage

from perception.inference.settings import ControllerConfig
from perception.sources.frame import Frame
from probnerf.settings import TemperedSMCConfig


def intrinsics(frame: Frame, amount: float) -> Frame:
    """Focal length too long by a share."""
    K = frame.camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.0 + amount
    return replace(frame, camera=replace(frame.camera, K=K))


def depth_scale(frame: Frame, amount: float) -> Frame:
    """All depths too long by a share."""
    assert frame.depth is not None
    return replace(frame, depth=frame.depth * np.float32(1.0 + amount))


def depth_noise(frame: Frame, amount: float) -> Frame:
    """Independent errors of this standard deviation, m, that nobody states."""
    assert frame.depth is not None
    noise = np.random.default_rng(1).normal(0.0, amount, frame.depth.shape)
    return replace(frame, depth=(frame.depth + noise).astype(np.float32))


def holes(frame: Frame, amount: float) -> Frame:
    """No depth in patches that cover a share of the picture."""
    assert frame.depth is not None
    patches = ndimage.gaussian_filter(np.random.default_rng(2).normal(size=frame.depth.shape), 8.0)
    lost = patches > np.quantile(patches, 1.0 - amount) if amount > 0 else np.zeros(patches.shape, bool)
    return replace(frame, depth=np.where(lost, np.nan, frame.depth).astype(np.float32))


def flying(frame: Frame, amount: float) -> Frame:
    """Pixels so far (px) from the object's outline float between it and what is behind."""
    assert frame.depth is not None and frame.label is not None
    mask, width = frame.label == 1, round(amount)
    if not width:
        return frame
    band = ndimage.binary_dilation(mask, iterations=width) & ~ndimage.binary_erosion(mask, iterations=width)
    far, near = (
        f(np.nan_to_num(frame.depth, nan=1.0), 2 * width + 3) for f in (ndimage.maximum_filter, ndimage.minimum_filter)
    )
    mixed = near + np.random.default_rng(3).random(mask.shape) * (far - near)
    return replace(frame, depth=np.where(band, mixed, frame.depth).astype(np.float32))


def mask_shift(frame: Frame, amount: float) -> Frame:
    """The label map beside the object by so many px."""
    assert frame.label is not None
    return replace(frame, label=np.roll(frame.label, round(amount), axis=1))


def plane_tilt(frame: Frame, amount: float) -> Frame:
    """The table turned under the object by so many degrees, about a level line across the picture, in depth alone."""
    assert frame.depth is not None and frame.label is not None and frame.T_world_camera is not None
    height, width = frame.depth.shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = frame.camera.rays(np.column_stack([u.ravel(), v.ravel()]).astype(float)).reshape(height, width, 3)
    R, at = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3]
    normal = R.T @ [0.0, 0.0, 1.0]  # of the table, on which the world's z is 0, in the camera frame
    middle = np.argwhere(frame.label == 1).mean(axis=0).astype(int)
    below = rays[tuple(middle)]
    foot = below * (-at[2] / (below @ normal))  # where the ray through the object's middle meets the table
    c, s = np.cos(np.deg2rad(amount)), np.sin(np.deg2rad(amount))
    turned = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ normal
    with np.errstate(divide="ignore"):
        z, z_turned = rays[..., 2] * -at[2] / (rays @ normal), rays[..., 2] * (foot @ turned) / (rays @ turned)
    table = (np.abs(frame.depth - z) < 0.02) & (frame.label != 1) & (z_turned > 0)
    return replace(frame, depth=np.where(table, frame.depth + z_turned - z, frame.depth).astype(np.float32))


def occlusion(frame: Frame, amount: float) -> Frame:
    """Something near hides the left share of the object's pixels."""
    assert frame.depth is not None and frame.label is not None
    columns = np.flatnonzero((frame.label == 1).any(axis=0))
    before = np.cumsum((frame.label == 1).sum(axis=0)) <= amount * np.count_nonzero(frame.label == 1)
    band = np.zeros(frame.label.shape, bool)
    band[:, max(columns[0] - 20, 0) : columns[0] + int(before[columns[0] :].sum())] = amount > 0
    near = 0.7 * np.nanmin(frame.depth[frame.label == 1])
    rgb = np.where(band[..., None], np.uint8(90), frame.rgb)
    return replace(
        frame,
        rgb=rgb,
        depth=np.where(band, near, frame.depth).astype(np.float32),
        label=np.where(band, 2, frame.label).astype(np.int32),
    )


def noise_frame(frame: Frame, amount: float) -> Frame:
    """So large a share of the object's depths, drawn anew from all over its box: no shape at all at 1."""
    assert frame.depth is not None and frame.label is not None
    rng, mask = np.random.default_rng(4), frame.label == 1
    low, high = np.nanquantile(frame.depth[mask], (0.01, 0.99))
    drawn = rng.uniform(low, high + 0.05, mask.shape)
    lost = mask & (rng.random(mask.shape) < amount)
    rgb = np.where(lost[..., None], rng.integers(0, 256, frame.rgb.shape), frame.rgb).astype(np.uint8)
    return replace(frame, rgb=rgb, depth=np.where(lost, drawn, frame.depth).astype(np.float32))


def no_depth(frame: Frame, amount: float) -> Frame:
    """Colour alone, with the true mask and the camera's pose over the table, at any amount but 0."""
    return replace(frame, depth=None) if amount else frame


@dataclass(frozen=True)
class Axis:
    """One thing that is made worse: by a fault of the frame, another configuration, or pictures that add nothing."""

    name: str
    amounts: tuple[float, ...]  # the first is how it ships
    fault: Callable[[Frame, float], Frame] | None = None
    configured: Callable[[ControllerConfig, float], ControllerConfig] | None = field(default=None, compare=False)
    repeated: bool = False  # the frame comes so often, as from one tripod


def _infer(name: str) -> Callable[[ControllerConfig, float], ControllerConfig]:
    def configured(config: ControllerConfig, amount: float) -> ControllerConfig:
        value: Any = type(getattr(config.infer, name))(getattr(config.infer, name) * amount)
        return replace(config, infer=replace(config.infer, **{name: value}))

    return configured


def _pose_prior(config: ControllerConfig, amount: float) -> ControllerConfig:
    o = config.observe
    names = ("xy_sigma", "log_scale_sigma", "hidden_sigma", "side_sigma")
    return replace(config, observe=replace(o, **{name: amount * getattr(o, name) for name in names}))


def _stated(config: ControllerConfig, amount: float) -> ControllerConfig:
    return replace(config, observe=replace(config.observe, depth_scale_sigma=amount))


def _particles(config: ControllerConfig, amount: float) -> ControllerConfig:
    def fewer(smc: TemperedSMCConfig) -> TemperedSMCConfig:
        particles, start = (max(2, int(n * amount)) for n in (smc.particles, smc.start_particles))
        return replace(smc, particles=particles, start_particles=start)

    own = config.infer
    infer = replace(
        own,
        smc=fewer(own.smc),
        smc_from_prior=fewer(own.smc_from_prior),
        smc_from_network=fewer(own.smc_from_network),
    )
    return replace(config, infer=infer)


def _rays(config: ControllerConfig, amount: float) -> ControllerConfig:
    o = config.observe
    colour, free, occluder = (max(1, int(n * amount)) for n in (o.colour_rays, o.free_rays, o.occluder_rays))
    return replace(config, observe=replace(o, colour_rays=colour, free_rays=free, occluder_rays=occluder))


AXES = (
    Axis("focal length, share", (0.0, 0.02, 0.05, 0.1, 0.2), intrinsics),
    Axis("depth scale, share", (0.0, 0.02, 0.05, 0.1, 0.2), depth_scale),
    Axis("depth scale that is stated, share", (0.0, 0.02, 0.05, 0.1), depth_scale, _stated),
    Axis("depth noise, m", (0.0, 0.003, 0.01, 0.03), depth_noise),
    Axis("depth holes, share", (0.0, 0.3, 0.6, 0.9), holes),
    Axis("depth absent", (0.0, 1.0), no_depth),
    Axis("flying pixels, px", (0.0, 2.0, 4.0, 8.0), flying),
    Axis("mask beside, px", (0.0, 3.0, 10.0, 30.0), mask_shift),
    Axis("plane tilted, degrees", (0.0, 1.0, 3.0, 10.0), plane_tilt),
    Axis("occluded, share", (0.0, 0.3, 0.6, 0.8, 0.95), occlusion),
    Axis("one frame again, times", (1.0, 300.0), repeated=True),
    Axis("noise instead of shape, share", (0.0, 0.1, 0.3, 1.0), noise_frame),
    Axis("wall_sigma, times", (1.0, 0.3, 0.1), configured=_infer("wall_sigma")),
    Axis("wall_sigma too large, times", (1.0, 3.0, 10.0), configured=_infer("wall_sigma")),
    Axis("pose prior, times", (1.0, 0.3, 0.1), configured=_pose_prior),
    Axis("pose prior too wide, times", (1.0, 3.0), configured=_pose_prior),
    Axis("lattice, times", (1.0, 0.5, 0.25), configured=_infer("lattice")),
    Axis("pixels, times", (1.0, 0.5, 0.25, 0.125), configured=_rays),
    Axis("particles, times", (1.0, 0.33, 0.1, 0.05), configured=_particles),
)
