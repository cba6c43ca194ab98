"""Batches of the ray phase: each step's objects, views and pixels. They depend only on (seed, step)."""

from typing import Protocol

import equinox as eqx
import numpy as np
from jaxtyping import Array
from scipy import ndimage

from probnerf.training.pictures import ViewSet


class BatchConfig(Protocol):
    """The part of the recipe that batches depend on (see TrainConfig)."""

    @property
    def seed(self) -> int: ...
    @property
    def views(self) -> int: ...
    @property
    def object_rays(self) -> int: ...
    @property
    def near_rays(self) -> int: ...
    @property
    def far_rays(self) -> int: ...


Data = Array | np.ndarray  # drawn on the host, used on the device


class Batch(eqx.Module):
    """One step's data, all arrays with a leading object axis."""

    rows: Data  # i32 [b], which objects
    rgb: Data  # u8 [b, j, s, s, 3]
    distance: Data  # f32 [b, j, s, s]
    unknown: Data  # bool [b, j, s, s]
    used: Data  # f32 [b, j]
    T_object_camera: Data  # f32 [b, j, 4, 4]
    tan_half_fov: Data  # f32 [b, j]
    origin: Data  # f32 [b, n, 3]
    direction: Data  # f32 [b, n, 3]
    ray_rgb: Data  # f32 [b, n, 3]
    ray_range: Data  # f32 [b, n], 0 for a miss, negative for an object pixel of unknown range
    ray_weight: Data  # f32 [b, n], sums to about 1; gives an unbiased mean over all pixels of all views
    turn: Data  # f32 [b, 4] yaw, x, y, log-scale of the object relative to the fixed lattice


class Strata(eqx.Module):
    """Per object: pixel indices (into views x pixels) sorted by stratum, and the end of each stratum."""

    order: np.ndarray  # i32 [N, V S S]
    object_end: np.ndarray  # i32 [N]
    near_end: np.ndarray  # i32 [N]


def strata_of(views: ViewSet) -> Strata:
    """Sort every object's pixels into object, near and far."""
    n = len(views.seeds)
    mask = views.range != 0  # negative: an object pixel of unknown range
    near = ndimage.binary_dilation(mask, np.ones((1, 1, 5, 5), bool))
    stratum = np.where(mask, 0, np.where(near, 1, 2)).astype(np.uint8).reshape(n, -1)
    order = np.argsort(stratum, axis=1, kind="stable").astype(np.int32)
    return Strata(order, (stratum == 0).sum(1).astype(np.int32), (stratum <= 1).sum(1).astype(np.int32))


def draw_batch(views: ViewSet, strata: Strata, config: BatchConfig, step: int, size: int) -> Batch:
    """The batch of one step. It depends only on (seed, step), so a resumed run repeats the same batches."""
    rng = np.random.default_rng([config.seed, step, 3])
    chosen = rng.choice(len(views.seeds), size, replace=len(views.seeds) < size)
    j, s = config.views, views.size
    view = np.stack([rng.permutation(views.rgb.shape[1])[:j] for _ in chosen])
    rows = chosen[:, None]
    unknown = _half_planes(rng, size, j, s)
    counts = rng.integers(1, j + 1, size)
    used = (np.arange(j)[None] < counts[:, None]).astype(np.float32)

    pixels = s * s * views.rgb.shape[1]
    picks, weights = [], []
    zero = np.zeros(size, np.int64)
    full = np.full(size, pixels)
    object_end, near_end = strata.object_end[chosen], strata.near_end[chosen]
    for low, high, count in (
        (zero, object_end, config.object_rays),
        (object_end, near_end, config.near_rays),
        (near_end, full, config.far_rays),
    ):
        width = np.maximum(high - low, 1)[:, None]
        at = np.minimum(low[:, None] + (rng.random((size, count)) * width).astype(np.int64), pixels - 1)
        picks.append(strata.order[rows, at])
        weights.append(np.broadcast_to((high - low)[:, None] / (pixels * count), at.shape))
    pick = np.concatenate(picks, axis=1)
    v, pixel = pick // (s * s), pick % (s * s)
    T, tangent = views.T_object_camera[rows, v], views.tan_half_fov[rows, v]
    half = 0.5 * s
    x = ((pixel % s) + 0.5 - half) / half * tangent
    y = ((pixel // s) + 0.5 - half) / half * tangent
    d = np.stack([x, y, np.ones_like(x)], -1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    turn = np.stack(
        [
            rng.uniform(-np.pi, np.pi, size),
            rng.uniform(-0.05, 0.05, size),
            rng.uniform(-0.05, 0.05, size),
            rng.uniform(np.log(0.75), np.log(1.1), size),
        ],
        axis=-1,
    )
    return Batch(
        rows=chosen.astype(np.int32),
        rgb=views.rgb[rows, view],
        distance=views.range[rows, view],
        unknown=unknown,
        used=used,
        T_object_camera=views.T_object_camera[rows, view],
        tan_half_fov=views.tan_half_fov[rows, view],
        origin=T[..., :3, 3],
        direction=np.einsum("bnij,bnj->bni", T[..., :3, :3], d).astype(np.float32),
        ray_rgb=(views.rgb.reshape(len(views.seeds), -1, 3)[rows, pick] / 255.0).astype(np.float32),
        ray_range=views.range.reshape(len(views.seeds), -1)[rows, pick],
        ray_weight=np.concatenate(weights, axis=1).astype(np.float32),
        turn=turn.astype(np.float32),
    )


def _half_planes(rng: np.random.Generator, b: int, j: int, s: int) -> np.ndarray:
    """Random occluders for the encoder: a half plane is hidden in a quarter of the views."""
    y, x = np.mgrid[:s, :s] / s - 0.5
    angle = rng.uniform(0, 2 * np.pi, (b, j, 1, 1))
    offset = rng.uniform(-0.2, 0.35, (b, j, 1, 1))
    hidden = np.cos(angle) * x + np.sin(angle) * y > offset
    return hidden & (rng.random((b, j, 1, 1)) < 0.25)
