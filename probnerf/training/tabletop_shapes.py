"""Shapes of the tabletop family to learn from: its exact distances and colours, as a `ShapeSet`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.objects.tabletop import TabletopObject, colour, description, sample_objects, signed_distance
from probnerf.objects.tabletop_sampler import CARTON
from probnerf.training.shape_set import (
    ANYWHERE,
    CLIP,
    GRID,
    NEAR,
    OFFSET,
    PAINT_NUMBERS,
    SURFACE,
    ShapeSet,
    as_units,
    centres,
    in_cube,
    joined,
    nearest,
)
from probnerf.types import BASE_Z, KINDS

_HANDLE_SHARE = 4  # one in this many is drawn around the handle, which fills a hundredth of the cube


def tabletop_shapes(seeds: np.ndarray, progress: Callable[[int, int], None] | None = None) -> ShapeSet:
    """The objects of `seeds`. Each depends only on its own."""
    parts, block = [], min(256, 1 << (len(seeds) - 1).bit_length())
    for start in range(0, len(seeds), block):
        chosen = seeds[start : start + block]
        padded = np.resize(chosen, block)  # few compiled sizes
        objects = sample_objects([int(s) for s in padded])
        parts.append(_shapes(objects, padded)[: len(chosen)])
        if progress is not None:
            progress(min(start + block, len(seeds)), len(seeds))
    return joined(parts)


def _shapes(objects: TabletopObject, seeds: np.ndarray) -> ShapeSet:
    surface, normal, rgb, valid = (np.asarray(a) for a in _surface(objects, jnp.asarray(seeds)))
    rng = [np.random.default_rng([int(s), 41]) for s in seeds]
    width = np.stack([np.exp(r.uniform(np.log(OFFSET[0]), np.log(OFFSET[1]), (NEAR, 1))) for r in rng])
    near = surface[:, SURFACE:] + width * np.stack([r.standard_normal((NEAR, 3)) for r in rng])
    points = as_units(np.concatenate([near, np.stack([r.uniform(-1.0, 1.0, (ANYWHERE, 3)) for r in rng])], axis=1))
    grid = np.broadcast_to(centres(GRID).astype(np.float32), (len(seeds), GRID**3, 3))
    distance = np.asarray(_distances(objects, np.concatenate([grid, in_cube(points)], axis=1)))
    known = np.asarray(jax.vmap(description)(objects))
    carton = np.asarray(objects.kind) == CARTON
    kind = np.where(carton, KINDS.index("box"), KINDS.index("vessel")).astype(np.uint8)
    appearance = np.concatenate([np.zeros((len(seeds), PAINT_NUMBERS)), known], axis=1)
    return ShapeSet(
        distance=np.clip(distance[:, : GRID**3], -CLIP, CLIP).astype(np.float16),
        points=points,
        inside=distance[:, GRID**3 :] <= 0.0,
        surface=as_units(surface[:, :SURFACE]),
        normal=np.round(127.0 * normal[:, :SURFACE]).astype(np.int8),
        valid=valid[:, :SURFACE],
        anchor=np.stack([nearest(s) for s in surface[:, :SURFACE]]),
        rgb=np.round(255.0 * rgb[:, None, :SURFACE]).astype(np.uint8),
        appearance=appearance[:, None].astype(np.float16),
        kind=kind,
    )


_distances = jax.jit(jax.vmap(signed_distance))


@jax.jit
def _surface(objects: TabletopObject, seeds: Array) -> tuple[Array, Array, Array, Array]:
    """Points, normals, colours and whether the search converged, SURFACE + NEAR of each object."""
    count = SURFACE + NEAR

    def one(obj: TabletopObject, seed: Array) -> tuple[Array, Array, Array, Array]:
        k0, k1, k2 = jax.random.split(jax.random.key(seed), 3)
        base = jnp.array([0.0, 0.0, BASE_Z])
        shift = base + jnp.append(obj.shift, 0.0)
        low, high = ((corner - base) * obj.scale + shift for corner in (obj.lower, obj.upper))
        start = jax.random.uniform(k0, (count, 3), minval=low - 0.05, maxval=high + 0.05)
        handle = jax.random.uniform(k2, (count, 1)) < 1.0 / _HANDLE_SHARE
        around = (_handle_points(obj, k1, count) - base) * obj.scale + shift
        point = jnp.where(obj.has_handle & handle, around, start)

        def descend(_: int, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
            return point - signed_distance(obj, point)[:, None] * _normal(obj, point)

        point = jax.lax.fori_loop(0, 4, descend, point)  # four steps suffice except where parts overlap
        normal = _normal(obj, point)
        rgb = colour(obj, point, normal)
        finite = jnp.all(jnp.isfinite(point + normal + rgb), axis=-1)
        valid = finite & (jnp.abs(signed_distance(obj, point)) < 2e-3)
        point, normal, rgb = (jnp.where(finite[:, None], a, 0.0) for a in (point, normal, rgb))
        return point, normal, rgb, valid

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
    gradient = (ahead - behind).T
    return gradient / jnp.maximum(jnp.linalg.norm(gradient, axis=-1, keepdims=True), 1e-6)
