"""The foam renderer g(w, r): all density lies on the faces of a fixed lattice of cubes (paper §2.5).

Symbols: G lattice cubes per 2 units, so faces every 2/G; t_i sorted distances of a ray's crossings with the three
families of faces; sigma_i density there; s the object's scale; tau_i = s sigma_i / G the optical depth of a face;
w_i = T_i (1 - exp(-tau_i)) compositing weights; T_i = exp(-sum_{j<i} tau_j) transmittance before face i.

Crossings depend only on the observation: the lattice is fixed in the view frame, and the pose moves the field. So the
crossings are constants of the view, and all later quantities are smooth in the weights and the pose.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.fields.base import Field
from probnerf.types import BASE_Z, Pose, Rays

FAR = 1e3  # distance of padding crossings, beyond everything else


class Lattice(eqx.Module):
    """A lattice of faces. `extent` may exceed 1, because a moved object can leave the cube."""

    cubes: int = eqx.field(static=True)  # G: cubes per 2 units
    extent: float = eqx.field(static=True, default=1.0)  # the lattice covers [-extent, extent]^3
    max_crossings: int = eqx.field(static=True, default=0)  # padded crossings per ray; 0: all that a ray can have
    below: float = eqx.field(static=True, default=0.0)  # how far it extends below BASE_Z: an object may stand lower

    @property
    def planes(self) -> int:
        """Faces per axis."""
        return 2 * int(self.extent * self.cubes / 2) + 1

    @property
    def crossings(self) -> int:
        """Crossings kept per ray (the first ones; a ray through the whole lattice has at most 3 x planes)."""
        return self.max_crossings or 3 * self.planes


def crossings(rays: Rays, lattice: Lattice, shift: Float[Array, "3"] | float = 0.0) -> Float[Array, "n m"]:
    """Sorted distances at which each ray crosses a face inside the lattice; missing ones are FAR.

    `shift` moves the faces (cube units). Crossings more than `below` under the support plane are also dropped.
    """
    offsets = (jnp.arange(lattice.planes) - (lattice.planes - 1) / 2) * (2.0 / lattice.cubes)
    faces = offsets[None, :] + jnp.broadcast_to(jnp.asarray(shift), (3,))[:, None]  # [3, planes]
    # a ray parallel to a face crosses it far away
    direction = jnp.where(jnp.abs(rays.direction) < 1e-9, 1e-9, rays.direction)
    t = (faces[None] - rays.origin[:, :, None]) / direction[:, :, None]  # [n, 3, planes]
    points = rays.origin[:, None, None, :] + t[..., None] * direction[:, None, None, :]
    # a crossing lies exactly on its face: rounding must not move it off the outermost one
    points = jnp.where(jnp.eye(3, dtype=bool)[None, :, None, :], faces[None, :, :, None], points)
    low = jnp.array([-lattice.extent, -lattice.extent, BASE_Z - lattice.below]) - 1e-6
    inside = jnp.all((points >= low) & (points <= lattice.extent + 1e-6), axis=-1) & (t > 0)
    t = jnp.where(inside, t, FAR).reshape(t.shape[0], -1)
    return jnp.sort(t, axis=-1)[:, : lattice.crossings]


def count_crossings(rays: Rays, lattice: Lattice) -> int:
    """The largest number of crossings that any of these rays has (on the host, to choose a padded size)."""
    return int(jnp.max(jnp.sum(crossings(rays, lattice) < FAR, axis=-1)))


def gap_before(t: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """Distance to the previous crossing (for the first one, to the next); 0 on padding.

    If a ray ends on face i, the surface lies somewhere in this gap, because face i - 1 is still outside.
    """
    valid = t < FAR
    gap = jnp.where(valid[:, 1:], t[:, 1:] - t[:, :-1], 0.0)
    return jnp.where(valid, jnp.concatenate([gap[:, :1], gap], axis=-1), 0.0)


def window(points: Float[Array, "... 3"], margin: float = 0.1) -> Float[Array, "..."]:
    """1 in the canonical cube, smoothly 0 beyond `margin` outside (encodings repeat there); 0 below the plane."""
    beyond = jnp.max(jnp.abs(points), axis=-1) - 1.0
    below = (BASE_Z - 0.02) - points[..., 2]
    u = jnp.clip(1.0 - jnp.maximum(beyond, 5.0 * below) / margin, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


class FaceWeights(eqx.Module):
    """Compositing results per ray and crossing, as logarithms, so that empty and saturated rays keep gradients."""

    log_weight: Float[Array, "... n m"]  # log w_i (eq. of compositing); -inf-like (-1e4) on padding
    log_transmittance: Float[Array, "... n m"]  # log T after face i


def composite(sigma: Float[Array, "n m"], t: Float[Array, "n m"], opacity_per_density: Float[Array, ""]) -> FaceWeights:
    """Alpha-composite: tau_i = opacity_per_density * sigma_i, w_i = T_i (1 - exp(-tau_i)).

    `opacity_per_density` is exp(log_scale)/G: a larger object has the same walls, spread over more faces.
    """
    valid = t < FAR
    tau = jnp.where(valid, sigma * opacity_per_density, 0.0)
    total = jnp.cumsum(tau, axis=-1)
    # log(1 - exp(-tau)) is -inf at tau = 0: the floor keeps the value finite and the gradient non-zero for empty rays
    log_alpha = jnp.log(-jnp.expm1(-jnp.maximum(tau, 1e-12)))
    # shifted, not total - tau: before a very dense face, that difference would be only rounding error
    before = jnp.concatenate([jnp.zeros_like(total[..., :1]), total[..., :-1]], axis=-1)
    log_weight = jnp.where(valid, log_alpha - before, -1e4)
    return FaceWeights(log_weight=log_weight, log_transmittance=-total)


def points_on_rays(rays: Rays, t: Float[Array, "n m"]) -> Float[Array, "n m 3"]:
    """Crossing points. Padding is at the ray's first crossing or origin, so that no coordinate is very large."""
    safe = jnp.where(t < FAR, t, jnp.where(t[:, :1] < FAR, t[:, :1], 0.0))
    return rays.origin[:, None, :] + safe[..., None] * rays.direction[:, None, :]


class Render(eqx.Module):
    """The result of rendering, per ray."""

    opacity: Float[Array, "n"]  # O = sum_i w_i = 1 - T
    colour: Float[Array, "n 3"]  # sum_i w_i c_i (premultiplied, no background)
    distance: Float[Array, "n"]  # sum_i w_i t_i / O, FAR where nothing is hit
    weights: Float[Array, "n m"]
    t: Float[Array, "n m"]


def render(field: Field, weights: Float[Array, "d"], rays: Rays, lattice: Lattice, pose: Pose | None = None) -> Render:
    """Render rays of the view frame; `weights` are the field's."""
    t = crossings(rays, lattice)
    points = points_on_rays(rays, t)
    directions = jnp.broadcast_to(rays.direction[:, None, :], points.shape)
    scale = jnp.ones(())
    if pose is not None:
        points, directions = pose.to_object(points), pose.to_object_direction(directions)
        scale = jnp.exp(pose.log_scale)
    sigma = field.density(weights, points) * window(points)
    colour = field.colour(weights, points, directions, sigma)
    faces = composite(sigma, t, scale / lattice.cubes)
    w = jnp.exp(faces.log_weight)
    opacity = -jnp.expm1(faces.log_transmittance[:, -1])
    finite = jnp.where(t < FAR, t, 0.0)
    distance = jnp.where(opacity > 1e-6, jnp.sum(w * finite, axis=-1) / jnp.maximum(opacity, 1e-6), FAR)
    return Render(opacity=opacity, colour=jnp.einsum("nm,nmc->nc", w, colour), distance=distance, weights=w, t=t)


def render_picture(
    field: Field,
    weights: Float[Array, "d"],
    rays: Rays,
    lattice: Lattice,
    pose: Pose | None = None,
    chunk: int = 1024,
) -> Render:
    """`render` over many rays in chunks of constant size (the loop is a `lax.map`)."""
    n = rays.origin.shape[0]
    pad = -n % chunk
    padded = jax.tree.map(lambda a: jnp.pad(a, ((0, pad), (0, 0)), mode="edge").reshape(-1, chunk, 3), rays)
    parts = jax.lax.map(lambda r: render(field, weights, r, lattice, pose), padded)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:n], parts)
