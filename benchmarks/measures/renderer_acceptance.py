"""Acceptance of HMC by renderer: pictures by the foam and by quadrature along the ray, and chains that explain them.

A picture is rendered from a position that is drawn from the prior, so that the position is a draw of the posterior.
Eight chains begin there. What counts is the Metropolis acceptance of their last iteration (the paper's section 4.2).
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.sampling.hmc import Target, hmc_step
from probnerf.types import Rays

CUBES = 32
SIGMA = 0.1  # of a pixel's colour
CHAINS, LEAPFROG, ITERATIONS = 8, 10, 20
DELTA_SCALE = 0.025  # sqrt(alpha)
FOAM, QUADRATURE, IMPORTANCE = "foam", "quadrature", "quadrature, importance samples"
SAMPLES = 96  # a ray; the foam's rays cross 50 to 100 faces

Span = tuple[float, float]  # where rays enter and leave what is rendered, cube units from the camera
Colours = Callable[[ProbNeRF, Float[Array, "d"], Rays, Span], Float[Array, "n 3"]]


def _on_white(weight: Float[Array, "n m"], colour: Float[Array, "n m 3"]) -> Float[Array, "n 3"]:
    return jnp.einsum("nm,nmc->nc", weight, colour) + (1.0 - jnp.sum(weight, axis=-1, keepdims=True))


def foam_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays, span: Span) -> Float[Array, "n 3"]:
    """Composited at the faces of the lattice."""
    shown = foam.render(model.field, weights, rays, foam.Lattice(CUBES))
    return shown.colour + (1.0 - shown.opacity[:, None])


def integrated(
    model: ProbNeRF, weights: Float[Array, "d"], rays: Rays, t: Float[Array, "n m"], span: Span
) -> tuple[Float[Array, "n m"], Float[Array, "n m 3"]]:
    """Weights w_i = T_i (1 - exp(-sigma_i step_i)) and colours at sorted places along the rays (NeRF's eq. 3).

    A face of the foam stands for the density between two faces, which a ray meets about every 2 / (1.5 CUBES).
    """
    points = rays.origin[:, None] + t[..., None] * rays.direction[:, None]
    sigma = model.field.density(weights, points) * foam.window(points)
    colour = model.field.colour(weights, points, jnp.broadcast_to(rays.direction[:, None], points.shape), sigma)
    step = jnp.diff(t, axis=-1, append=t[:, -1:] + (span[1] - span[0]) / t.shape[-1])
    tau = 0.75 * sigma * step
    before = jnp.cumsum(tau, axis=-1) - tau
    return jnp.exp(-before) * -jnp.expm1(-tau), colour


def quadrature_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays, span: Span) -> Float[Array, "n 3"]:
    """The integral along the ray in even steps."""
    t = span[0] + (jnp.arange(SAMPLES) + 0.5) * (span[1] - span[0]) / SAMPLES
    return _on_white(*integrated(model, weights, rays, jnp.broadcast_to(t, (rays.origin.shape[0], SAMPLES)), span))


def importance_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays, span: Span) -> Float[Array, "n 3"]:
    """Even steps, and as many samples at the even quantiles of the weight that these found."""
    half = SAMPLES // 2
    edges = jnp.linspace(*span, half + 1)
    middle = jnp.broadcast_to(0.5 * (edges[1:] + edges[:-1]), (rays.origin.shape[0], half))
    coarse, _ = integrated(model, weights, rays, middle, span)
    mass = jnp.cumsum(jax.lax.stop_gradient(coarse) + 1e-5, axis=-1)
    mass = jnp.concatenate([jnp.zeros_like(mass[:, :1]), mass / mass[:, -1:]], axis=-1)
    quantiles = (jnp.arange(half) + 0.5) / half
    fine = jax.vmap(lambda m: jnp.interp(quantiles, m, edges))(mass)
    t = jnp.sort(jnp.concatenate([middle, fine], axis=-1), axis=-1)
    return _on_white(*integrated(model, weights, rays, t, span))


RENDERERS: dict[str, Colours] = {FOAM: foam_colours, QUADRATURE: quadrature_colours, IMPORTANCE: importance_colours}


def weights_at(model: ProbNeRF, position: Float[Array, "p"]) -> Float[Array, "d"]:
    """Of a position [z~] or [z~ | delta]."""
    weights = model.decode(position[: model.latent])
    return weights if len(position) == model.latent else weights + DELTA_SCALE * position[model.latent :]


def log_likelihood(colours: Colours, span: Span, args: tuple, positions: Float[Array, "p k"]) -> Float[Array, "p"]:
    """Gaussian errors of every pixel's colour; `args` are model, rays and the picture."""
    model, rays, picture = args

    def one(position: Float[Array, "k"]) -> Float[Array, ""]:
        return -0.5 * jnp.sum(((colours(model, weights_at(model, position), rays, span) - picture) / SIGMA) ** 2)

    return jax.lax.map(one, positions)


@partial(jax.jit, static_argnames=("name", "iterations", "span"))
def acceptance(
    key: Array,
    model: ProbNeRF,
    rays: Rays,
    position: Float[Array, "k"],
    step: Array,
    name: str,
    iterations: int,
    span: Span,
) -> Float[Array, "chains"]:
    """Of each chain's last iteration, begun at the position ([z~] or [z~ | delta]) that was rendered."""
    colours = RENDERERS[name]
    noise, key = jax.random.split(key)
    picture = colours(model, weights_at(model, position), rays, span)
    picture = picture + SIGMA * jax.random.normal(noise, picture.shape)
    target = Target(partial(log_likelihood, colours, span), (model, rays, picture), jnp.ones(()))

    def iterate(state, key):
        state, info = hmc_step(key, state, target, step, LEAPFROG)
        return state, info.acceptance

    start = target.evaluate(jnp.broadcast_to(position, (CHAINS, position.size)))
    return jax.lax.scan(iterate, start, jax.random.split(key, iterations))[1][-1]
