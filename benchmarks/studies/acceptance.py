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

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from benchmarks.harness.intervals import mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table
from benchmarks.measures.renderer_acceptance import ITERATIONS, RENDERERS, acceptance
from probnerf.geometry import look_at, pinhole_rays
from probnerf.prior.checkpoint import load_prior
from probnerf.types import Rays

STEPS = tuple(float(f"{s:.3g}") for s in np.geomspace(0.0005, 0.5, 8))
NEAR, FAR = SPAN = (2.2, 5.8)  # along the rays of a camera four units from the cube's middle


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
                each = acceptance(key, model, seen, z_tilde, jnp.float32(step), name, iterations, SPAN)
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
