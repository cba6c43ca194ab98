"""Training with all data on the accelerator: batches are drawn there, and many steps are one call.

An accelerator takes a step in a few milliseconds. Drawing its batch on the host, and asking for it, takes longer. What
is drawn has the same law as what `shape_set.draw_shapes` and `picture_set.changed` draw on the host.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from probnerf.likelihood.settings import Likelihood
from probnerf.prior.networks import RealNVP
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.training import elbo, posterior_flow
from probnerf.training.elbo import TrainState
from probnerf.training.picture_set import Examples, PictureSet
from probnerf.training.posterior_flow import PosteriorTrainState
from probnerf.training.settings import PosteriorTrainConfig, TrainConfig
from probnerf.training.shape_set import ANYWHERE, CLIP, NEAR, REACH, SURFACE, ShapeBatch, ShapeSet
from probnerf.types import BASE_Z


class DeviceShapes(eqx.Module):
    """A `ShapeSet` on the device, and how likely its objects are drawn."""

    distance: Array
    points: Array
    inside: Array
    surface: Array
    normal: Array
    valid: Array
    anchor: Array
    rgb: Array
    appearance: Array
    cumulative: Float[Array, "n"]  # of the objects' probabilities


def shapes_on_device(sets: Sequence[tuple[ShapeSet, float]]) -> DeviceShapes:
    """All sets, each with its share of a batch. Fewer paints than another set has are repeated."""
    paints = max(each.rgb.shape[1] for each, _ in sets)

    def joined(name: str) -> Array:
        arrays = [getattr(each, name) for each, _ in sets]
        if name in ("rgb", "appearance"):
            arrays = [a[:, np.arange(paints) % a.shape[1]] for a in arrays]
        return jnp.asarray(np.concatenate(arrays))

    total = sum(share for _, share in sets)
    each = np.concatenate([np.full(len(one), share / total / len(one)) for one, share in sets])
    names = [name for name in DeviceShapes.__annotations__ if name != "cumulative"]
    arrays = {name: joined(name) for name in names}
    return DeviceShapes(**arrays, cumulative=jnp.asarray(np.cumsum(each), jnp.float32))


def drawn_shapes(shapes: DeviceShapes, key: PRNGKeyArray, size: int, points: int, colours: int) -> ShapeBatch:
    """A batch, as `shape_set.draw_shapes` draws it."""
    k0, k1, k2, k3, k4 = jax.random.split(key, 5)
    near, last = 3 * points // 4, len(shapes.cumulative) - 1
    rows = jnp.minimum(jnp.searchsorted(shapes.cumulative, jax.random.uniform(k0, (size,))), last)
    paint = jax.random.randint(k1, (size,), 0, shapes.rgb.shape[1])
    at, each = rows[:, None], jnp.arange(size)[:, None]
    close = jax.random.randint(k2, (size, near), 0, NEAR)
    point = jnp.concatenate([close, jax.random.randint(k3, (size, points - near), NEAR, NEAR + ANYWHERE)], axis=1)
    spot = jax.random.randint(k4, (size, colours), 0, SURFACE)
    rgb = shapes.rgb[rows, paint].astype(jnp.float32) / 255.0
    return ShapeBatch(
        distance=shapes.distance[rows].astype(jnp.float32) / CLIP,
        anchor_rgb=2.0 * rgb[each, shapes.anchor[rows]].reshape(size, -1) - 1.0,
        appearance=shapes.appearance[rows, paint].astype(jnp.float32),
        points=shapes.points[at, point].astype(jnp.float32) * (REACH / 32767.0),
        inside=shapes.inside[at, point],
        surface=shapes.surface[at, spot].astype(jnp.float32) * (REACH / 32767.0),
        normal=shapes.normal[at, spot].astype(jnp.float32) / 127.0,
        rgb=rgb[each, spot],
        valid=shapes.valid[at, spot],
    )


@eqx.filter_jit(donate="all-except-first")
def train_solids(
    fixed: tuple[Likelihood, TrainConfig, DeviceShapes, int], state: TrainState
) -> tuple[TrainState, dict[str, Float[Array, "count"]]]:
    """`count` (the last of `fixed`) steps of the solid phase, and their figures."""
    likelihood, config, shapes, count = fixed

    def step(state: TrainState, _: None) -> tuple[TrainState, dict[str, Array]]:
        key = jax.random.fold_in(jax.random.key(config.seed + 1), state.step)
        solids = drawn_shapes(shapes, key, config.batch, config.points, config.colours)
        return elbo.updated((likelihood, config), state, solids, None)

    return jax.lax.scan(step, state, None, length=count)


class DevicePictures(eqx.Module):
    """A `PictureSet` on the device."""

    rgb: Array
    distance: Array
    unknown: Array
    T_view_camera: Array
    tan_half_fov: Array
    pose_sigma: Array
    yaw: Array
    pose: Array
    mean: Array
    sd: Array
    kind: Array


def pictures_on_device(pictures: PictureSet, rows: np.ndarray) -> DevicePictures:
    """These rows of the set."""
    fields: dict[str, Any] = {
        name: jnp.asarray(getattr(pictures, name)[rows]) for name in DevicePictures.__annotations__
    }
    return DevicePictures(**fields)


def changed_pictures(
    pictures: DevicePictures, rows: Int[Array, "b"], key: PRNGKeyArray, config: PosteriorTrainConfig
) -> Examples:
    """These rows, some of them without depth, at a known pose or behind an occluder, as `picture_set.changed` does."""
    count = len(rows)
    k0, k1, k2 = jax.random.split(key, 3)
    distance = pictures.distance[rows].astype(jnp.float32)
    unknown = pictures.unknown[rows] != 0
    T, sigma = pictures.T_view_camera[rows], pictures.pose_sigma[rows]
    yaw, pose = pictures.yaw[rows], pictures.pose[rows]
    limits = jnp.array([[config.without_depth], [config.known_pose], [config.occluded]])
    flat, known, behind = jax.random.uniform(k0, (3, count)) < limits
    share = jax.random.uniform(k1, (count,), maxval=config.most_hidden) * behind
    unknown |= occluders(k2, (distance != 0.0) & ~unknown, share)
    T_known, scale = _at_known_pose(T, yaw, pose, sigma)
    distance = jnp.where(known[:, None, None] & (distance > 0), distance * scale[:, None, None], distance)
    distance = jnp.where(flat[:, None, None] & (distance > 0), -1.0, distance)
    return Examples(
        picture=EncoderPicture(
            pictures.rgb[rows],
            distance,
            unknown,
            jnp.where(known[:, None, None], T_known, T),
            pictures.tan_half_fov[rows],
        ),
        pose_sigma=sigma,
        known=known.astype(jnp.float32),
        yaw=jnp.where(known, 0.0, yaw),
        pose=jnp.where(known[:, None], 0.0, pose[:, :3]),
        mean=pictures.mean[rows],
        sd=pictures.sd[rows],
        kind=pictures.kind[rows].astype(jnp.int32),
    )


def occluders(key: PRNGKeyArray, seen: Bool[Array, "b s s"], share: Float[Array, "b"]) -> Bool[Array, "b s s"]:
    """Masks that hide so much of the object in `seen`, as `picture_set.occluders` makes them."""
    count, size = seen.shape[:2]
    pixels = jnp.round(share * jnp.sum(seen, axis=(1, 2))).astype(jnp.int32)
    k0, k1, k2, k3 = jax.random.split(key, 4)
    axis = (jnp.arange(size) + 0.5) / (0.5 * size) - 1.0
    grid = jnp.stack(jnp.meshgrid(axis, axis, indexing="xy"), axis=-1).reshape(-1, 2)
    angle, turn = jax.random.uniform(k0, (2, count), maxval=2.0 * jnp.pi)
    far = jnp.exp(jax.random.uniform(k1, (count,), minval=np.log(0.2), maxval=np.log(10.0)))
    stretch = jnp.exp(0.5 * jax.random.normal(k2, (count,)))
    box = jax.random.uniform(k3, (count,)) < 0.5
    centre = far[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
    c, s = jnp.cos(turn), jnp.sin(turn)
    x, y = jnp.moveaxis(grid - centre[:, None], -1, 0)
    along = jnp.abs(c[:, None] * x + s[:, None] * y)
    across = jnp.abs(stretch[:, None] * (c[:, None] * y - s[:, None] * x))
    reach = jnp.where(box[:, None], jnp.maximum(along, across), jnp.hypot(along, across))
    order = jnp.sort(jnp.where(seen.reshape(count, -1), reach, jnp.inf), axis=1)
    limit = jnp.take_along_axis(order, jnp.maximum(pixels - 1, 0)[:, None], axis=1)
    return ((reach <= limit) & (pixels > 0)[:, None]).reshape(seen.shape)


def _at_known_pose(T: Array, yaw: Array, pose: Array, sigma: Array) -> tuple[Array, Array]:
    """Camera poses in the canonical object frame, and the factor of all distances (`Pose.to_object`)."""
    x, y, log_scale, z = (pose * sigma[:, jnp.array([0, 1, 2, 4])]).T
    scale = jnp.exp(-log_scale)
    c, s, nought, one = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw), jnp.ones_like(yaw)
    rows = [jnp.stack(row, axis=-1) for row in ((c, s, nought), (-s, c, nought), (nought, nought, one))]
    rotation = jnp.stack(rows, axis=1)
    base = jnp.array([0.0, 0.0, BASE_Z])
    place = T[:, :3, 3] - base - jnp.stack([x, y, z], axis=1)
    at = scale[:, None] * jnp.einsum("bij,bj->bi", rotation, place) + base
    known = jnp.concatenate([rotation @ T[:, :3, :3], at[..., None]], axis=-1)
    return jnp.concatenate([known, T[:, 3:]], axis=1), scale


@eqx.filter_jit(donate="all-except-first")
def train_pictures(
    fixed: tuple[PosteriorTrainConfig, RealNVP | None, DevicePictures, int], state: PosteriorTrainState
) -> tuple[PosteriorTrainState, dict[str, Float[Array, "count"]]]:
    """`count` (the last of `fixed`) steps of a posterior network, and their figures."""
    config, prior, pictures, count = fixed

    def step(state: PosteriorTrainState, _: None) -> tuple[PosteriorTrainState, dict[str, Array]]:
        k0, k1 = jax.random.split(jax.random.fold_in(jax.random.key(config.seed + 1), state.step))
        rows = jax.random.randint(k0, (config.batch,), 0, len(pictures.yaw))
        return posterior_flow.updated((config, prior), state, changed_pictures(pictures, rows, k1, config))

    return jax.lax.scan(step, state, None, length=count)
