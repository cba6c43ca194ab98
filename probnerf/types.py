"""The arrays that flow through `probnerf`. Everything here lives in the unit cube of the *view frame*.

View frame: gravity-aligned (z up), origin at the cube's centre, +x pointing horizontally from the object to the camera,
one unit = `half_extent` metres of the ObjectFrame. The support plane is z = BASE_Z. Metres stop at `perception`.
"""

from collections.abc import Sequence
from enum import StrEnum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, DTypeLike

# Height of the support plane in the cube, in the view frame and in the canonical object frame alike.
BASE_Z = -0.75
BODY_EXTENT = 1.4  # the larger of an object's longest horizontal side and its height, without handle and spout

KINDS = ("vessel", "box", "other")  # of things; vessel: any container from bowl to bottle, with or without a lid

# Entries of a position vector that tell the pose: a, b (yaw = atan2(b, a)), x, y, log-scale, range offset, z.
POSE_SIZE = 7


def on_device(values: ArrayLike, dtype: DTypeLike = np.float32) -> Array:
    """NumPy's array of these, on the device. `jnp.asarray` may compile a program for it, and a new process many."""
    return jax.device_put(np.asarray(values, dtype))


class Rays(eqx.Module):
    """Camera rays in the view frame, in cube units."""

    origin: Float[Array, "n 3"]
    direction: Float[Array, "n 3"]  # unit vectors


class Observation(eqx.Module):
    """What N pixels of one view say about one object (view frame, cube units).

    Rays `[0, colour_count)` may be OBJECT pixels and carry colour; later ones never do: the colour network skips them.
    A padding ray has status UNKNOWN and limit 0: it says nothing.

    Arrays other than `pose_sigma` may carry a leading axis (`stacked`): several choices of N pixels of the same view.
    """

    rays: Rays
    status: Int[Array, "n"]  # UNKNOWN, OBJECT or FREE (probnerf.pixel_status)
    rgb: Float[Array, "n 3"]  # in [0, 1]
    rgb_valid: Bool[Array, "n"]
    range: Float[Array, "n"]  # measured distance along the ray; only read where range_valid (OBJECT pixels)
    range_sigma: Float[Array, "n"]  # standard deviation of `range`
    range_valid: Bool[Array, "n"]
    limit: Float[
        Array, "n"
    ]  # FREE and UNKNOWN: the ray was seen to be empty of the object up to here (0: says nothing)
    pose_sigma: Float[
        Array, "5"
    ]  # prior standard deviations: x, y (cube units), log-scale, range offset and z (cube units)
    colour_count: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.colour_count > self.status.shape[-1]:
            raise ValueError(f"colour_count {self.colour_count} exceeds the {self.status.shape[-1]} rays")

    @property
    def choices(self) -> int:
        """How many choices of pixels it holds."""
        return self.status.shape[0] if self.status.ndim > 1 else 1

    def chosen(self, index: ArrayLike | Int[Array, "..."]) -> "Observation":
        """One choice of pixels, by its number, or several by theirs. Requires a leading axis."""
        per_ray = {name: jax.tree.map(lambda a: a[index], getattr(self, name)) for name in _PER_RAY}
        return Observation(**per_ray, pose_sigma=self.pose_sigma, colour_count=self.colour_count)


_PER_RAY = ("rays", "status", "rgb", "rgb_valid", "range", "range_sigma", "range_valid", "limit")


def joined(observations: Sequence[Observation]) -> Observation:
    """Several views of one object in one cube as one observation: their rays, and the first one's `pose_sigma`."""

    def rows(o: Observation, part: slice) -> dict[str, Any]:
        return {name: jax.tree.map(lambda a: np.asarray(a)[part], getattr(o, name)) for name in _PER_RAY}

    parts = [rows(o, slice(None, o.colour_count)) for o in observations]
    parts += [rows(o, slice(o.colour_count, None)) for o in observations]
    whole = jax.device_put(jax.tree.map(lambda *a: np.concatenate(a), *parts))
    count = sum(o.colour_count for o in observations)
    return Observation(**whole, pose_sigma=observations[0].pose_sigma, colour_count=count)


def stacked(observations: Sequence[Observation]) -> Observation:
    """Several choices of one view's pixels, of equal numbers of rays, along a leading axis."""
    first = observations[0]
    every = {name: [getattr(o, name) for o in observations] for name in _PER_RAY}
    whole = {name: jax.tree.map(lambda *a: np.stack([np.asarray(x) for x in a]), *o) for name, o in every.items()}
    return Observation(**jax.device_put(whole), pose_sigma=first.pose_sigma, colour_count=first.colour_count)


class Pose(eqx.Module):
    """Where the object stands in the view frame: p_view = R_z(yaw) scale (p_object - base) + base + (x, y, z).

    `base` is (0, 0, BASE_Z), so that a larger object stays on its plane, and z is the error of the plane's height that
    perception measured. Leaves may carry leading batch axes.
    """

    yaw: Float[Array, "..."]  # radians, counter-clockwise about z
    x: Float[Array, "..."]  # cube units
    y: Float[Array, "..."]  # cube units
    log_scale: Float[Array, "..."]
    z: Float[Array, "..."]  # cube units

    def to_object(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """View-frame points in the canonical object frame (the lattice stands still, the field moves)."""
        c, s = jnp.cos(self.yaw), jnp.sin(self.yaw)
        inverse_scale = jnp.exp(-self.log_scale)
        u = points[..., 0] - self.x
        v = points[..., 1] - self.y
        w = points[..., 2] - BASE_Z - self.z
        return jnp.stack(
            [inverse_scale * (c * u + s * v), inverse_scale * (-s * u + c * v), inverse_scale * w + BASE_Z], axis=-1
        )

    def to_object_direction(self, directions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """View-frame unit directions in the canonical object frame."""
        c, s = jnp.cos(self.yaw), jnp.sin(self.yaw)
        u, v = directions[..., 0], directions[..., 1]
        return jnp.stack([c * u + s * v, -s * u + c * v, directions[..., 2] * jnp.ones_like(c)], axis=-1)


class StopReason(StrEnum):
    """Why sampling ended where it did. The values are the words of files and messages."""

    CONVERGED = "converged"  # the sampler did all that it had to do
    BUDGET = "budget"  # no time was left for a further step
    STAGES = "stages"  # as many stages as were asked for, or all of a fixed schedule
    STOPPED = "stopped"  # by the callback that hears of each stage
    INTERRUPTED = "interrupted"  # by Ctrl-C
    UNDERWAY = "underway"  # it has not ended: better samples follow

    @classmethod
    def _missing_(cls, value: object) -> "StopReason":
        raise ValueError(f"the reason why sampling stopped is {value!r}; it must be one of {', '.join(cls)}")


class Diagnostics(eqx.Module):
    """A sampler's diagnostics. Trouble is a result that travels with the posterior."""

    acceptance: Float[Array, ""]  # mean Metropolis acceptance over the last stage
    divergences: Int[Array, ""]  # trajectories whose energy error exceeded 1,000 nats or was not finite
    r_hat: Float[Array, ""]  # split R-hat of the log-likelihood over chains or weighed populations (NaN: undefined)
    ess: Float[Array, ""]  # effective sample size of the final weights
    ancestors: Int[Array, ""]  # distinct initial particles that survive
    stages: Int[Array, ""]
    point_gradients: Float[Array, ""]  # field evaluations with gradient
    beta: Float[Array, "m"]  # each population's (or chain's) inverse temperature: 1 is the posterior
    log_evidences: Float[Array, "m"]  # each population's own estimate, of the target at its beta (NaN: it has none)


class Posterior(eqx.Module):
    """Weighted samples. Positions are [z~ | a, b, x, y, log-scale, range offset, z | delta], each a priori N(0, 1)."""

    positions: Float[Array, "s d"]
    log_weights: Float[Array, "s"]  # normalised: logsumexp is 0
    log_likelihoods: Float[Array, "s"]
    log_density: Float[Array, "s"]  # of what each was drawn from, by its population's estimate (NaN: not known)
    population: Int[Array, "s"]  # independent population (or chain) of each sample: the source of Monte Carlo error
    log_evidence: Float[Array, ""]  # mean over populations, NaN for samplers that have none
    log_evidence_se: Float[Array, ""]
    diagnostics: Diagnostics
    result: StopReason = eqx.field(static=True)
