"""The exact renderer: acceptance of HMC against its step, with the foam and with quadrature, on cars.

As in the paper's figure: a pair (z~, delta) is drawn from the prior and one picture of it is rendered; 8 chains of 10
leapfrog steps begin at the pair, and what counts is the mean acceptance of the 20th iteration. The paper trained one
prior for each renderer; here both use the same one, which was trained through the foam.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.harness.intervals import interval, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table
from benchmarks.measures.renderer_acceptance import FOAM, ITERATIONS, QUADRATURE, Span, acceptance
from benchmarks.paper.conditioned import rays_of
from benchmarks.paper.experiment import Run
from probnerf.types import Rays

RENDERERS = "acceptance by renderer"
NAMES = (FOAM, QUADRATURE)
STEPS = (0.0005, 0.002, 0.008, 0.03, 0.1)
RAYS = 32  # pixels of the picture
SPAN: Span = (0.2, 3.4)  # along the rays of a camera 1.7 from the car's middle


def measure(run: Run) -> None:
    """One row a renderer and draw of the prior."""
    model = run.prior.model
    for k in range(run.count):
        key = jax.random.fold_in(jax.random.key(run.seed), k)
        position = jax.random.normal(jax.random.fold_in(key, 1), (model.latent + model.field.size,))
        seen = _rays(run, k)
        for name in NAMES:
            settings: Line = {"rays": RAYS, "iterations": 3 if run.quick else ITERATIONS, "steps": list(STEPS)}
            line = run.missing(name, settings, f"{run.family.name}, {RENDERERS}", k)
            if line is None:
                continue
            each = [
                acceptance(key, model, seen, position, jnp.float32(step), name, settings["iterations"], SPAN)
                for step in STEPS
            ]
            means = [round(float(np.mean(np.asarray(a))), 4) for a in each]
            run.results.add({**line, "acceptance": means})
            say(f"{line['condition']}, {k}, {name}: " + ", ".join(f"{m:.2f}" for m in means))


def _rays(run: Run, k: int) -> Rays:
    origins, directions = rays_of(run.family.cameras(k, 1)[0])
    chosen = np.random.default_rng([k, 83]).choice(len(directions), RAYS, replace=False)
    origins = np.broadcast_to(origins, directions.shape)
    return Rays(jnp.asarray(origins[chosen], jnp.float32), jnp.asarray(directions[chosen], jnp.float32))


def by_step(lines: Sequence[Line], name: str) -> dict[float, list[float]]:
    """Acceptance of each draw of the prior, by step."""
    own = [x for x in lines if x["condition"].endswith(RENDERERS) and x["method"] == name]
    return (
        {step: [x["acceptance"][i] for x in own] for i, step in enumerate(own[0]["settings"]["steps"])} if own else {}
    )


def tables(lines: Sequence[Line], rows: list[Row]) -> list[Table]:
    """One."""
    cells, steps = [], list(STEPS)
    for name in NAMES:
        found = by_step(lines, name)
        if not found:
            continue
        for step, values in found.items():
            rows += mean_rows("paper", name, f"{RENDERERS}, step {step:g}", "acceptance", values, "")
        steps = list(found)
        cells.append([name, str(len(found[steps[0]])), *(f"{interval(v).mean:.2f}" for v in found.values())])
    title = f"cars, {RENDERERS}: mean of the last iteration, by step"
    return [Table(title, ("renderer", "n", *(f"{s:g}" for s in steps)), cells)] if cells else []
