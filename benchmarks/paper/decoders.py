"""What the hypernetwork saves: pixels a second of its small field, and of fields told the latent at each point.

All are timed in turn in one run, so that only their ratio counts. Cost depends on sizes, not on what was learnt.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from benchmarks.harness.intervals import interval, mean_rows
from benchmarks.harness.machine import median_seconds
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table, ranged
from benchmarks.paper.conditioned import SIZE, rays_of
from benchmarks.paper.experiment import Run
from benchmarks.paper.judged import LATTICE
from benchmarks.paper.rival_answers import TrainedRival
from benchmarks.rivals.layers import parameters
from benchmarks.rivals.registry import RIVALS
from probnerf.prior.networks import ProbNeRF
from probnerf.rendering import foam
from probnerf.types import Rays

COST = "cost of a picture"
DECODER = ": decoder"  # after a method's name, which has other settings elsewhere
REPEATS = 2
BOX = (-0.7, -0.4, -0.8, 0.7, 0.4, 0.0)
NAMED = {"nerf_vae": "NeRF-VAE", "functa": "Functa"}  # the latent enters at each point
FUNCTA_PUBLISHED = 2 * 15 * 512 * 512  # operations of a point: 15 layers of 512 (the paper's section 2.1)


def measure(run: Run, rivals: Sequence[TrainedRival]) -> None:
    """One row a decoder and repeat: pixels a second of a 64 x 64 picture, decoding z~ or the like once included."""
    model, T = run.prior.model, run.family.cameras(0, 1)
    origins, directions = (jnp.asarray(a, jnp.float32) for a in rays_of(T[0]))
    rays = Rays(jnp.broadcast_to(origins, directions.shape), directions)
    shown = {"ProbNeRF": (lambda z: _own(model, z, rays), jnp.zeros(model.latent))}
    weights: dict[str, Line] = {}  # of trained rivals
    points = {"ProbNeRF": (SIZE * SIZE * LATTICE.crossings, own_operations(model))}
    for name, label in NAMED.items():
        entry = RIVALS[name]
        config = entry.config(box=BOX, tan_half_fov=0.5)
        models = {f"{label}, own sizes": entry.model(config, jax.random.key(0))}
        models |= {f"{label}, as trained": r.model for r in rivals if r.name == name}
        weights |= {f"{label}, as trained": {"weights": r.digest} for r in rivals if r.name == name}
        for title, rival in models.items():
            shown[title] = _rendering(rival, jnp.asarray(T, jnp.float32))
            points[title] = (SIZE * SIZE * rival.config.samples, point_operations(name, rival))
    condition = f"{run.family.name}, {COST}"
    for repeat in range(run.count):
        wanted = {name: run.missing(f"{name}{DECODER}", weights.get(name, {}), condition, repeat) for name in shown}
        if all(line is None for line in wanted.values()):
            continue
        seconds = median_seconds(shown, 1 if run.quick else REPEATS)
        for name, line in wanted.items():
            if line is None:
                continue
            evaluations, operations = points[name]
            speed = round(SIZE * SIZE / seconds[name], 1)
            kept = {"pixels_per_s": speed, "ratio": round(seconds[name] / seconds["ProbNeRF"], 4)}
            run.results.add({**line, **kept, "points": evaluations, "operations": operations})
        say(f"{condition}, {repeat}: " + ", ".join(f"{name} {SIZE * SIZE / s:.0f} px/s" for name, s in seconds.items()))


def _own(model: ProbNeRF, z: Array, rays: Rays) -> Array:
    return _own_jitted(model, z, rays)


@jax.jit
def _own_jitted(model: ProbNeRF, z: Array, rays: Rays) -> Array:
    made = foam.render_picture(model.field, model.decode(z), rays, LATTICE)
    return made.colour + (1.0 - made.opacity)[:, None]


def _rendering(rival: Any, T: Array) -> tuple[Callable[[Array], Array], Array]:
    jitted = jax.jit(lambda model, z: model.render(z, T, SIZE))
    return lambda z: jitted(rival, z), jnp.zeros(rival.config.latent)


def own_operations(model: ProbNeRF) -> int:
    """Multiplications and additions of one point: two for each of the field's weights."""
    return 2 * int(model.field.size)


def point_operations(name: str, rival: Any) -> int:
    """The same of a rival's field; what depends on the latent alone is counted out, as it is done once."""
    if name == "functa":
        return 2 * parameters(rival.siren)
    blocks = sum(parameters(block) - parameters(block.condition) for block in rival.blocks)
    return 2 * (parameters(rival.enter) + blocks + parameters(rival.leave))


def tables(lines: Sequence[Line], rows: list[Row]) -> list[Table]:
    """One."""
    own = [line for line in lines if line["condition"].endswith(COST)]
    cells = []
    for name in dict.fromkeys(line["method"] for line in own):
        mine = [line for line in own if line["method"] == name]
        rows += mean_rows("paper", name, COST, "pixels_per_s", [x["pixels_per_s"] for x in mine], "1/s")
        rows += mean_rows("paper", name, COST, "ratio", [x["ratio"] for x in mine], "")
        speed = np.mean([x["pixels_per_s"] for x in mine])
        each = f"{mine[0]['points'] / SIZE**2:.0f}", f"{mine[0]['operations']:,}"
        shown = name.removesuffix(DECODER)
        cells.append([shown, str(len(mine)), f"{speed:,.0f}", ranged(interval([x["ratio"] for x in mine]), 2), *each])
    if cells:
        cells.append(["Functa, published", "", "", "", "", f"{FUNCTA_PUBLISHED:,} (counted)"])
    header = ("decoder", "n", "pixels a second", "time, ProbNeRF's = 1", "points a pixel", "operations a point")
    return [Table(f"{COST}, 64 x 64", header, cells)] if cells else []
