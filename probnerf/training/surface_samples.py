"""Solid samples: points in and around procedural objects, with their true occupancy and colour.

The decoder learns from them first. They cost about a hundredth of a picture's rays, need no picture, and cover all
sides of an object.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from probnerf.objects.tabletop import TabletopObject, colour, sample_objects, signed_distance
from probnerf.types import BASE_Z

PER_OBJECT = 256  # surface points kept of each object
_HANDLE_SHARE = 4  # one in this many is drawn around the handle, which fills a hundredth of the cube
_NEAR = (0.008, 0.12)  # cube units; range of the log-uniform scale of the samples' normal offsets from the surface
_BEHIND = 0.04  # cube units; a lattice of 32 can have a face this far behind a surface, so it needs colours there

Data = Array | np.ndarray


class Solids(eqx.Module):
    """Objects with points on their surfaces, including hidden sides. All arrays have a leading object axis."""

    objects: TabletopObject
    point: Data  # f32 [n, k, 3], cube units
    normal: Data  # f32 [n, k, 3]
    rgb: Data  # f32 [n, k, 3], lit colour in [0, 1]
    valid: Data  # bool [n, k]: the search converged to the surface

    def __getitem__(self, rows: np.ndarray | slice) -> "Solids":
        return jax.tree.map(lambda a: a[rows], self)


def draw_solids(seeds: np.ndarray, progress: Callable[[int, int], None] | None = None) -> Solids:
    """Surface points of the objects of `seeds`. They depend only on each seed."""
    parts, block = [], 512
    for start in range(0, len(seeds), block):
        chosen = seeds[start : start + block]
        padded = np.resize(chosen, block)  # one compiled size
        drawn = _surface(sample_objects([int(s) for s in padded]), jnp.asarray(padded))
        parts.append(jax.tree.map(np.asarray, drawn)[: len(chosen)])
        if progress is not None:
            progress(min(start + block, len(seeds)), len(seeds))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


@jax.jit
def _surface(objects: TabletopObject, seeds: Array) -> Solids:
    def one(obj: TabletopObject, seed: Array) -> Solids:
        """One object's samples."""
        k0, k1 = jax.random.split(jax.random.key(seed))
        base = jnp.array([0.0, 0.0, BASE_Z])
        shift = base + jnp.append(obj.shift, 0.0)
        low, high = ((corner - base) * obj.scale + shift for corner in (obj.lower, obj.upper))
        start = jax.random.uniform(k0, (PER_OBJECT, 3), minval=low - 0.05, maxval=high + 0.05)
        handle = PER_OBJECT // _HANDLE_SHARE
        around = (_handle_points(obj, k1, handle) - base) * obj.scale + shift
        point = start.at[:handle].set(jnp.where(obj.has_handle, around, start[:handle]))

        def descend(_: int, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
            return point - signed_distance(obj, point)[:, None] * _normal(obj, point)

        point = jax.lax.fori_loop(0, 4, descend, point)  # four steps suffice except where parts overlap
        normal = _normal(obj, point)
        rgb = colour(obj, point, normal)
        finite = jnp.all(jnp.isfinite(point + normal + rgb), axis=-1)
        valid = finite & (jnp.abs(signed_distance(obj, point)) < 2e-3)
        point, normal, rgb = (jnp.where(finite[:, None], a, 0.0) for a in (point, normal, rgb))
        return Solids(obj, point, normal, rgb, valid)

    return jax.vmap(one)(objects, seeds)


def _handle_points(obj: TabletopObject, key: PRNGKeyArray, count: int) -> Float[Array, "n 3"]:
    """Canonical points within about 0.1 of the handle's centre line, which lies in the plane y = 0."""
    k0, k1 = jax.random.split(key)
    last = obj.tube.shape[0] - 1
    u = last * jax.random.uniform(k0, (count,))
    i = jnp.minimum(u.astype(jnp.int32), last - 1)
    line = obj.tube[i] + (u - i)[:, None] * (obj.tube[i + 1] - obj.tube[i])
    line = jnp.stack([line[:, 0], jnp.zeros(count), line[:, 1]], axis=-1)
    return line + 0.1 * jax.random.normal(k1, line.shape)


def _normal(obj: TabletopObject, points: Float[Array, "n 3"], step: float = 2e-3) -> Float[Array, "n 3"]:
    """Normalised gradient of the signed distance. By differences, since its square roots have none on the surface."""
    axes = step * jnp.eye(3)
    ahead, behind = jax.vmap(lambda offset: signed_distance(obj, points + offset))(
        jnp.concatenate([axes, -axes])
    ).reshape(2, 3, -1)
    return _unit((ahead - behind).T)


def _unit(v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return v / jnp.maximum(jnp.linalg.norm(v, axis=-1, keepdims=True), 1e-6)


def _pick(a: Data, index: Array) -> Array:
    return jnp.take_along_axis(a, index.reshape(*index.shape, *([1] * (a.ndim - 2))), axis=1)


def shape_samples(batch: Solids, key: PRNGKeyArray, count: int) -> tuple[Float[Array, "b n 3"], Bool[Array, "b n"]]:
    """Points, and whether each is inside. Three quarters are near the surface, the rest anywhere in the cube."""
    k0, k1, k2, k3 = jax.random.split(key, 4)
    b, near = batch.point.shape[0], 3 * count // 4
    index = jax.random.randint(k0, (b, near), 0, batch.point.shape[1])
    width = jnp.exp(jax.random.uniform(k1, (b, near, 1), minval=np.log(_NEAR[0]), maxval=np.log(_NEAR[1])))
    around = _pick(batch.point, index) + width * jax.random.normal(k2, (b, near, 3))
    anywhere = jax.random.uniform(k3, (b, count - near, 3), minval=-1.0, maxval=1.0)
    points = jnp.concatenate([around, anywhere], axis=1)
    return points, jax.vmap(signed_distance)(batch.objects, points) <= 0.0


def colour_samples(
    batch: Solids, key: PRNGKeyArray, count: int
) -> tuple[Float[Array, "b n 3"], Float[Array, "b n 3"], Float[Array, "b n 3"], Bool[Array, "b n"]]:
    """Points slightly behind the surface, possible viewing directions, colours, and which samples are valid."""
    k0, k1, k2 = jax.random.split(key, 3)
    index = jax.random.randint(k0, (batch.point.shape[0], count), 0, batch.point.shape[1])
    normal = _pick(batch.normal, index)
    points = _pick(batch.point, index) - _BEHIND * jax.random.uniform(k1, (*index.shape, 1)) * normal
    view = _unit(jax.random.normal(k2, normal.shape))
    view = jnp.where(jnp.sum(view * normal, axis=-1, keepdims=True) > 0.0, -view, view)
    return points, view, _pick(batch.rgb, index), _pick(batch.valid, index)
