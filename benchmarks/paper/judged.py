"""What an answer to one picture is worth: its pictures from the given and from held-out places, and hidden space."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from benchmarks.measures.metrics import hidden_ece, hidden_nll, psnr, scored_voxels
from benchmarks.paper.conditioned import GRID, SIZE, Conditioned, rays_of
from benchmarks.paper.methods import Found
from probnerf.inference import without_sizes
from probnerf.likelihood.position import split_position
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.rendering.occupancy import coarsen, solid
from probnerf.sampling.populations import thin
from probnerf.shapes import opacity_grids
from probnerf.types import Rays

DRAWS = 8  # whose pictures are made, as the paper has chains
LATTICE = foam.Lattice(32, 1.1)


@dataclass(frozen=True, eq=False)
class Judged:
    """One answer's figures and pictures."""

    values: dict[str, float]
    given: Float[np.ndarray, "S s s 3"]
    held_out: Float[np.ndarray, "S v s s 3"]
    chain: np.ndarray  # [S], of each picture


@partial(jax.jit, static_argnames="lattice")
def _pictures(
    model: ProbNeRF, likelihood: Likelihood, positions: Array, rays: Rays, lattice: foam.Lattice
) -> Float[Array, "s n 3"]:
    def one(position: Array) -> Array:
        weights, _ = split_position(model, likelihood, position, jnp.zeros(5))
        made = foam.render_picture(model.field, weights, rays, lattice)
        return made.colour + (1.0 - made.opacity)[:, None]

    return jax.lax.map(one, positions)


def pictures(
    model: ProbNeRF, likelihood: Likelihood, positions: Float[Array, "S d"], T_object_camera: Float[np.ndarray, "v 4 4"]
) -> Float[np.ndarray, "S v s s 3"]:
    """Of each position from each camera, on white, [0, 1]."""
    origins, directions = (np.concatenate(a) for a in zip(*map(rays_of, T_object_camera), strict=True))
    rays = Rays(jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32))
    made = np.asarray(_pictures(model, without_sizes(likelihood), positions, rays, LATTICE), np.float64)
    return np.clip(made, 0.0, 1.0).reshape(len(positions), len(T_object_camera), SIZE, SIZE, 3)


def shapes(model: ProbNeRF, likelihood: Likelihood, positions: Float[Array, "S d"]) -> Bool[np.ndarray, "S g g g"]:
    """The solid of each position."""
    region = jnp.ones((2 * GRID,) * 3, bool)
    grids = opacity_grids(model, without_sizes(likelihood), positions, jnp.zeros(5), region)
    return coarsen(solid(np.asarray(grids)), GRID)


def judge(view: Conditioned, model: ProbNeRF, found: Found, rate: Float[np.ndarray, "g g g"]) -> Judged:
    """Psnr in dB, each a mean over draws and of their mean picture; the standard deviation of held-out pixels between
    draws (root of the mean variance); `hidden_nll` and `hidden_ece` of voxels that the picture does not show, whose
    base rate `rate` lies in (0.02, 0.98).
    """
    chosen, weights, chain = thin(found.posterior, DRAWS)
    positions = found.posterior.positions[jnp.asarray(chosen)]
    weights = weights / weights.sum()
    given = pictures(model, found.likelihood, positions, view.T_object_camera)[:, 0]
    held = pictures(model, found.likelihood, positions, view.held_out.T_object_camera)
    p = np.tensordot(weights, shapes(model, found.likelihood, positions), 1)
    scored = scored_voxels(~view.hidden, rate)
    values = {
        **picture_values(view, given, held, weights),
        "hidden_nll": hidden_nll(p, rate, view.solid, scored),
        "hidden_ece": hidden_ece(p, view.solid, scored),
    }
    return Judged(values, given, held, chain)


def picture_values(
    view: Conditioned,
    given: Float[np.ndarray, "S s s 3"],
    held_out: Float[np.ndarray, "S v s s 3"],
    weights: Float[np.ndarray, "S"] | None = None,
) -> dict[str, float]:
    """What `judge` says of pictures alone; the draws weigh the same unless `weights` (of sum 1) says otherwise."""
    weights = np.full(len(given), 1.0 / len(given)) if weights is None else weights
    true_given, true_held = view.given.rgb[0] / 255.0, view.held_out.rgb / 255.0
    known = np.broadcast_to(view.known[..., None], true_given.shape)
    mean = np.tensordot(weights, held_out, 1)
    return {
        "psnr_given": float(weights @ [psnr(picture[known], true_given[known]) for picture in given]),
        "psnr_heldout": float(weights @ [psnr(picture, true_held) for picture in held_out]),
        "psnr_heldout_of_mean": psnr(mean, true_held),
        "pixel_sd": float(np.sqrt(np.mean(np.tensordot(weights, (held_out - mean) ** 2, 1)))),
    }
