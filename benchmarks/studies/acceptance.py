"""Acceptance of HMC against its step size, by renderer: the foam's exact pictures, and quadrature along the ray.

As in the paper's figure (sections 2.5 and 4.2): z~ is drawn from the prior and one picture of its shape is rendered,
so z~ is a draw of the posterior given that picture. Eight chains start from it. After 20 iterations of 10 leapfrog
steps at one step size, the figure is the mean Metropolis acceptance of the last iteration. The pose is known; pixel
colours are on white with Gaussian errors of 0.1; there is no range. Each renderer explains a picture that it rendered
itself:

- foam: compositing at the crossings of the lattice's faces (`probnerf.rendering.foam`)
- quadrature: the same number of even steps between the ends of the ray in the cube, with piecewise constant density
- quadrature, importance samples: half of the samples are placed where the other half has weight (NeRF's fine pass). As
  there, no gradient passes through their places.

All three use the shipped prior, which was trained through the foam. The paper trained one prior for each.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table
from probnerf.geometry import look_at, pinhole_rays
from probnerf.prior.checkpoint import load_prior
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.sampling.hmc import Target, hmc_step
from probnerf.types import Rays

CUBES = 32
SIGMA = 0.1  # of a pixel's colour
CHAINS, LEAPFROG, ITERATIONS = 8, 10, 20
STEPS = tuple(float(f"{s:.3g}") for s in np.geomspace(0.0005, 0.5, 8))
NEAR, FAR = 2.2, 5.8  # along the rays of a camera four units from the cube's middle
FOAM, QUADRATURE, IMPORTANCE = "foam", "quadrature", "quadrature, importance samples"
SAMPLES = 96  # a ray; the foam's rays cross 50 to 100 faces

Colours = Callable[[ProbNeRF, Float[Array, "d"], Rays], Float[Array, "n 3"]]


def _on_white(weight: Float[Array, "n m"], colour: Float[Array, "n m 3"]) -> Float[Array, "n 3"]:
    return jnp.einsum("nm,nmc->nc", weight, colour) + (1.0 - jnp.sum(weight, axis=-1, keepdims=True))


def foam_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays) -> Float[Array, "n 3"]:
    """Composited at the faces of the lattice."""
    shown = foam.render(model.field, weights, rays, foam.Lattice(CUBES))
    return shown.colour + (1.0 - shown.opacity[:, None])


def _integrated(
    model: ProbNeRF, weights: Float[Array, "d"], rays: Rays, t: Float[Array, "n m"]
) -> tuple[Float[Array, "n m"], Float[Array, "n m 3"]]:
    """Weights w_i = T_i (1 - exp(-sigma_i step_i)) and colours at sorted places along the rays (NeRF's eq. 3).

    A face of the foam stands for the density between two faces, which a ray meets about every 2 / (1.5 CUBES).
    """
    points = rays.origin[:, None] + t[..., None] * rays.direction[:, None]
    sigma = model.field.density(weights, points) * foam.window(points)
    colour = model.field.colour(weights, points, jnp.broadcast_to(rays.direction[:, None], points.shape), sigma)
    step = jnp.diff(t, axis=-1, append=t[:, -1:] + (FAR - NEAR) / t.shape[-1])
    tau = 0.75 * sigma * step
    before = jnp.cumsum(tau, axis=-1) - tau
    return jnp.exp(-before) * -jnp.expm1(-tau), colour


def quadrature_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays) -> Float[Array, "n 3"]:
    """The integral along the ray in even steps."""
    t = NEAR + (jnp.arange(SAMPLES) + 0.5) * (FAR - NEAR) / SAMPLES
    return _on_white(*_integrated(model, weights, rays, jnp.broadcast_to(t, (rays.origin.shape[0], SAMPLES))))


def importance_colours(model: ProbNeRF, weights: Float[Array, "d"], rays: Rays) -> Float[Array, "n 3"]:
    """Even steps, and as many samples at the even quantiles of the weight that these found."""
    half = SAMPLES // 2
    edges = jnp.linspace(NEAR, FAR, half + 1)
    middle = jnp.broadcast_to(0.5 * (edges[1:] + edges[:-1]), (rays.origin.shape[0], half))
    coarse, _ = _integrated(model, weights, rays, middle)
    mass = jnp.cumsum(jax.lax.stop_gradient(coarse) + 1e-5, axis=-1)
    mass = jnp.concatenate([jnp.zeros_like(mass[:, :1]), mass / mass[:, -1:]], axis=-1)
    quantiles = (jnp.arange(half) + 0.5) / half
    fine = jax.vmap(lambda m: jnp.interp(quantiles, m, edges))(mass)
    return _on_white(*_integrated(model, weights, rays, jnp.sort(jnp.concatenate([middle, fine], axis=-1), axis=-1)))


RENDERERS: dict[str, Colours] = {FOAM: foam_colours, QUADRATURE: quadrature_colours, IMPORTANCE: importance_colours}


def log_likelihood(colours: Colours, args: tuple, positions: Float[Array, "p k"]) -> Float[Array, "p"]:
    """Gaussian errors of every pixel's colour; `args` are model, rays and the picture."""
    model, rays, picture = args

    def one(z_tilde: Float[Array, "k"]) -> Float[Array, ""]:
        return -0.5 * jnp.sum(((colours(model, model.decode(z_tilde), rays) - picture) / SIGMA) ** 2)

    return jax.lax.map(one, positions)


@partial(jax.jit, static_argnames=("name", "iterations"))
def acceptance(
    key: Array, model: ProbNeRF, rays: Rays, z_tilde: Float[Array, "k"], step: Array, name: str, iterations: int
) -> Float[Array, "chains"]:
    """Of each chain's last iteration, begun at the shape that was rendered."""
    colours = RENDERERS[name]
    noise, key = jax.random.split(key)
    picture = colours(model, model.decode(z_tilde), rays)
    picture = picture + SIGMA * jax.random.normal(noise, picture.shape)
    target = Target(partial(log_likelihood, colours), (model, rays, picture), jnp.ones(()))

    def iterate(state, key):
        state, info = hmc_step(key, state, target, step, LEAPFROG)
        return state, info.acceptance

    start = target.evaluate(jnp.broadcast_to(z_tilde, (CHAINS, z_tilde.size)))
    return jax.lax.scan(iterate, start, jax.random.split(key, iterations))[1][-1]


def view_rays(seed: int, count: int) -> Rays:
    """Random pixels of a picture of the cube, from a random side."""
    rng = np.random.default_rng([seed, 83])
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(15.0, 60.0))
    side = (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation))
    origin, direction = pinhole_rays(look_at(4.0 * np.array(side), np.zeros(3)), 0.5 * 64 * 4.0 / 1.1, 64)
    chosen = rng.choice(len(direction), count, replace=False)
    origin = np.broadcast_to(origin, direction.shape)
    return Rays(jnp.asarray(origin[chosen], jnp.float32), jnp.asarray(direction[chosen], jnp.float32))


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """Acceptance of HMC against its step, with the foam and with quadrature."""

    n: int = 3
    """Shapes, each drawn from the prior and seen once."""
    rays: int = 96
    """Pixels of its picture."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    n, rays, iterations, steps = (
        (1, 32, 3, STEPS[::4]) if options.quick else (options.n, options.rays, ITERATIONS, STEPS)
    )
    model, seed = load_prior(options.prior).model, options.seed
    found: dict[str, np.ndarray] = {}
    for name in RENDERERS:
        found[name] = np.zeros((n, len(steps)))
        for k in range(n):
            key = jax.random.key(1000 * seed + k)
            z_tilde = jax.random.normal(jax.random.fold_in(key, 1), (model.latent,))
            seen = view_rays(1000 * seed + k, rays)
            for j, step in enumerate(steps):
                each = acceptance(key, model, seen, z_tilde, jnp.float32(step), name, iterations)
                found[name][k, j] = float(np.mean(np.asarray(each)))
        say(f"{name}: " + ", ".join(f"{s:g} {a:.2f}" for s, a in zip(steps, found[name].mean(axis=0), strict=True)))
    rows = []
    for name, values in found.items():
        for step, column in zip(steps, values.T, strict=True):
            rows += mean_rows("acceptance", name, f"step {step:g}", "acceptance", column, "")
    cells = [[name, *(f"{mean:.2f}" for mean in values.mean(axis=0))] for name, values in found.items()]
    table = Table("Acceptance by step", ("renderer", *(f"{step:.2g}" for step in steps)), cells)
    return Summary(rows, [table], lambda: _draw(found, steps))


def _draw(found: dict[str, np.ndarray], steps: tuple[float, ...]) -> Figure:
    figure = Figure(figsize=(6, 4.4), layout="constrained")
    ax = figure.subplots()
    for name, values in found.items():
        (line,) = ax.semilogx(steps, values.mean(axis=0), "o-", label=name, ms=4)
        ax.fill_between(steps, values.min(axis=0), values.max(axis=0), color=line.get_color(), alpha=0.15)
    ax.set(xlabel="step", ylabel="acceptance", ylim=(0, 1.02), title="HMC from the true shape (bands: all shapes)")
    ax.legend(fontsize=9)
    return figure
