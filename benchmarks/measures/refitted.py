"""How well a prior can hold a mesh: z~ is fitted to the true solid, and the solid that it decodes to is compared.

This asks the decoder alone, not the camera: 600 Adam steps on samples of the occupancy (as training draws them) plus
the log prior, from the shape that recognition tells where it is kept beside the prior, else from the best of a few
random starts. Truth and reconstruction are walls of 64^3 voxels (a voxel of which a
corner is in the solid) through the same operator (`occupancy.solid`).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage

from benchmarks.measures.metrics import iou, recall
from probnerf.likelihood.settings import Likelihood
from probnerf.objects.mesh import MeshObject
from probnerf.prior.networks import ProbNeRF, Recognition
from probnerf.rendering import foam
from probnerf.rendering.occupancy import solid
from probnerf.sampling.ascent import ascend
from probnerf.settings import AdamConfig
from probnerf.shapes import opacity_grids
from probnerf.training.mesh_shapes import sample_mesh
from probnerf.training.shape_set import batch_of
from probnerf.types import BODY_EXTENT

GRID = 64
THIN = 0.01  # m: parts below this are told apart
LEAST_THIN = 30  # voxels of them without which an object has none
_STARTS, _STEPS, _POINTS, _COUNTED = 4, 600, 1024, 10_000.0


@dataclass(frozen=True, eq=False)
class Refitted:
    """One object's figures."""

    name: str
    source: str
    iou: float
    thin: float  # share of the voxels of parts below 1 cm that are recalled; NaN without such parts
    solid: Bool[np.ndarray, "G G G"]
    true_solid: Bool[np.ndarray, "G G G"]


def refit(
    model: ProbNeRF, source: str, thing: MeshObject, seed: int, recognition: Recognition | None = None
) -> Refitted:
    """Fit and judge one object."""
    shapes = sample_mesh(thing, seed, paints=1)
    rng = np.random.default_rng([seed, 19])
    drawn = [batch_of(shapes, rng, np.zeros(1, int), _POINTS, 1) for _ in range(_STEPS)]
    batches = tuple(jnp.asarray(np.concatenate([getattr(b, name) for b in drawn])) for name in ("points", "inside"))
    starts, rate = jnp.asarray(0.5 * rng.standard_normal((_STARTS, model.latent)), jnp.float32), 0.05
    if recognition is not None:
        z = recognition(batch_of(shapes, rng, np.zeros(1, int), 4, 1).description[0])[0]
        starts, rate = model.flow.inverse(z)[0][None], 0.02
    q, values = ascend(_log_posterior, model, starts, AdamConfig(_STEPS, rate, 0.002), batches)
    best = q[np.argmax(np.asarray(values[-20:]).mean(axis=0))]
    likelihood = Likelihood(lattice=foam.Lattice(32, 1.1), sample_pose=False)
    grids = opacity_grids(model, likelihood, best[None], jnp.zeros(5), jnp.ones((GRID,) * 3, bool))
    occupied, true = solid(np.asarray(grids)[0]), solid(walls(thing).astype(np.float32))
    thin = thin_parts(true, thing.half_extent)
    share = recall(occupied, thin) if thin.sum() >= LEAST_THIN else float("nan")
    return Refitted(thing.name, source, float(iou(occupied, true)), share, occupied, true)


def _log_posterior(model: ProbNeRF, batch: tuple[Array, Array], z_tilde: Float[Array, "p k"]) -> Float[Array, "p"]:
    points, inside = batch

    def one(z: Float[Array, "k"]) -> Float[Array, ""]:
        tau = model.field.density(model.decode(z), points) * foam.window(points) / 32
        probability = jnp.where(inside, -jnp.expm1(-tau), jnp.exp(-tau))
        return _COUNTED * jnp.mean(jnp.log(0.002 + 0.996 * probability)) - 0.5 * jnp.sum(z * z)

    return jax.vmap(one)(z_tilde)


def walls(thing: MeshObject) -> Bool[np.ndarray, "G G G"]:
    """Voxels of which a corner is in the solid."""
    axis = np.linspace(-1.0, 1.0, GRID + 1)
    corners = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    near = np.all(np.abs(corners) <= 0.5 * BODY_EXTENT + 0.2, axis=-1)
    near[..., : np.searchsorted(axis, -0.85)] = False
    inside = np.zeros(near.shape, bool)
    inside[near] = thing.signed_distance(corners[near]) <= 0.0
    return ndimage.maximum_filter(inside, 2)[1:, 1:, 1:]


def thin_parts(occupied: Bool[np.ndarray, "G G G"], half_extent: float) -> Bool[np.ndarray, "G G G"]:
    """Voxels of parts thinner than THIN: what an opening with a ball of that diameter removes, less rounded edges."""
    voxel = half_extent * 2.0 / GRID
    core = ndimage.distance_transform_edt(occupied) * voxel > 0.5 * THIN
    if not core.any():
        return occupied
    return occupied & (ndimage.distance_transform_edt(~core) * voxel > 0.5 * THIN + 1.5 * voxel)
