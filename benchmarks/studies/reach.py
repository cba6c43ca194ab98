"""A reaching planner in thousands of simulated scenes: collisions against detours, by what it believes of unseen space.

Objects of the test seeds from one random view each, as in `farside bench calibration`. A scene is an object and a goal
1.5 to 5 cm beside its true surface, at a random azimuth and height, that can be reached on some truly free path (the
planner of `examples/reaches.py`: 24 directions, shortest first). Four beliefs choose the path:

- farside: the joint probability over hypotheses that the swept box is free
- independent voxels: the product of (1 - p_occupied) of the same hypotheses over the box's voxels
- unknown is free: only voxels that hold a measured point are occupied
- unknown is occupied: those, and all voxels that no ray passed through

All voxels are those of 32^3 in the object's cube. collided: share of scenes whose chosen path truly meets the object.
no_way: share in which no path was free enough. detour: how much longer the path is than the shortest truly free one,
m, over the scenes in which every belief found a path without collision.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import PairedInterval
from benchmarks.harness.progress import say
from benchmarks.harness.results import refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.scenes.conditions import ANY, views
from benchmarks.scenes.vessels import GRID, VesselView
from examples.reaches import Gripper, Reach, choose, reaches
from perception.answers.hypotheses import Hypotheses
from perception.answers.query import CAUTION
from perception.answers.regions import Swept
from perception.inference.controller import estimate
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import above_plane, coarsen, voxel_centres
from probnerf.types import BASE_Z

FARSIDE, INDEPENDENT, FREE, OCCUPIED = BELIEFS = (
    "farside", "independent voxels", "unknown is free", "unknown is occupied",
)  # fmt: skip
LEAST = 0.95  # probability of being free that a way must have
SWEEP = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
COLOURS = dict(zip(BELIEFS, ("tab:blue", "tab:orange", "tab:red", "tab:green"), strict=True))


@dataclass(frozen=True, eq=False)
class Belief:
    """One view: what is there, what was measured, and the hypotheses, all on 32^3 voxels."""

    truth: Bool[np.ndarray, "32 32 32"]
    measured: Bool[np.ndarray, "32 32 32"]  # voxels that hold a measured point of the object
    unseen: Bool[np.ndarray, "32 32 32"]  # above the table, and neither passed through nor measured
    shapes: Bool[np.ndarray, "S 32 32 32"]
    weights: Float[np.ndarray, "S"]
    caution: float  # weight of "all that is unseen is occupied": not 0 where the object is out of model
    half_extent: float  # m

    def p_free(self, swept: Bool[np.ndarray, "32 32 32"]) -> dict[str, float]:
        """Of the voxels that a box sweeps, by belief."""
        inside = self.shapes[:, swept]
        hidden = bool((self.unseen & swept).any())
        free = (1 - self.caution) * (1.0 - float(self.weights @ inside.any(axis=1))) + self.caution * (not hidden)
        p = (1 - self.caution) * (self.weights @ inside) + self.caution * self.unseen[swept]
        touched = bool(self.measured[swept].any())
        return {
            FARSIDE: free,
            INDEPENDENT: float(np.prod(1.0 - p)),
            FREE: float(not touched),
            OCCUPIED: float(not touched and not hidden),
        }

    def swept(self, way: Reach) -> Bool[np.ndarray, "32 32 32"]:
        """Voxels whose centre lies in the box, which counts as one voxel thick at least."""
        centres = voxel_centres(GRID) * self.half_extent
        boxes = Swept(way.T_object_box[None], way.size[None])
        return boxes.holds(0, *np.moveaxis(centres, -1, 0), thicker=2 * self.half_extent / GRID)


def belief_of(view: VesselView, h: Hypotheses) -> Belief:
    """What the hypotheses, and the depth image alone, say of a view."""
    depth = view.frame.depth
    assert depth is not None
    v, u = np.nonzero(view.segment.mask & np.isfinite(depth) & (depth > 0))
    rays = view.frame.camera.rays(np.column_stack([u, v]))
    points = view.cube.to_cube(rays / rays[:, 2:] * depth[v, u][:, None])
    index = np.floor((points + 1.0) * 0.5 * GRID).astype(int)
    index = index[((index >= 0) & (index < GRID)).all(axis=1)]
    measured = np.zeros((GRID,) * 3, bool)
    measured[tuple(index.T)] = True
    seen = h.seen.reshape(GRID, 2, GRID, 2, GRID, 2).all(axis=(1, 3, 5))  # the whole of a coarse voxel
    return Belief(
        truth=view.solid,
        measured=measured,
        unseen=~seen & above_plane(GRID) & ~measured,
        shapes=coarsen(h.solid, GRID),
        weights=h.weights,
        caution=CAUTION if h.out_of_model else 0.0,
        half_extent=view.cube.half_extent,
    )


def goals(belief: Belief, count: int, rng: np.random.Generator, gripper: Gripper) -> Iterator[Float[np.ndarray, "3"]]:
    """Points beside the true surface, metres in the object frame."""
    half, voxel = belief.half_extent, 2 * belief.half_extent / GRID
    levels = np.flatnonzero(belief.truth.any(axis=(0, 1)))
    lowest = BASE_Z * half + 0.5 * gripper.height + voxel
    for _ in range(count):
        azimuth, level = rng.uniform(-np.pi, np.pi), int(rng.choice(levels))
        u = np.array([np.cos(azimuth), np.sin(azimuth)])
        along = np.arange(0.0, 1.0, 0.5 / GRID)
        x, y = np.minimum(((along * u[:, None] + 1.0) * 0.5 * GRID).astype(int), GRID - 1)
        inside = np.flatnonzero(belief.truth[x, y, level])
        away = half * (along[inside[-1]] if len(inside) else 0.0) + rng.uniform(0.015, 0.05)
        z = max(half * (-1.0 + (level + 0.5) * 2.0 / GRID), lowest)
        if away < gripper.around:
            yield np.array([*(away * u), z])


@dataclass(frozen=True, eq=False)
class Task:
    """One scene: the length of each way, shortest first, whether it is truly free, and what each belief says."""

    lengths: Float[np.ndarray, "ways"]
    free: Bool[np.ndarray, "ways"]
    p_free: dict[str, Float[np.ndarray, "ways"]]

    def outcome(self, belief: str, least: float) -> tuple[float, float, float]:
        """(collided, found no way, detour in metres or NaN)."""
        p_free = self.p_free[belief]
        taken = choose(range(len(p_free)), lambda way: float(p_free[way]), least)
        if taken is None:
            return 0.0, 1.0, np.nan
        hit = not self.free[taken]
        shortest = self.lengths[self.free][0]
        return float(hit), 0.0, np.nan if hit else float(self.lengths[taken] - shortest)

    @cached_property
    def solved(self) -> bool:
        """Whether every belief finds a way at `LEAST` that is truly free: where their detours can be compared."""
        return bool(np.isfinite([self.outcome(belief, LEAST)[2] for belief in BELIEFS]).all())


def tasks_of(belief: Belief, count: int, rng: np.random.Generator) -> list[Task]:
    """Those of `count` goals that can be reached."""
    gripper, found = Gripper(), []
    for goal in goals(belief, count, rng, gripper):
        ways = reaches(goal, gripper)
        masks = [belief.swept(way) for way in ways]
        free = np.array([not belief.truth[mask].any() for mask in masks])
        if free.any():
            p_free = [belief.p_free(mask) for mask in masks]
            by = {b: np.array([p[b] for p in p_free]) for b in BELIEFS}
            found.append(Task(np.array([way.length for way in ways]), free, by))
    return found


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """Collisions against detours of a reaching planner, by what it believes of unseen space."""

    n: int = 60
    """Objects."""
    each: int = 50
    """Goals beside each."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    n, each, seed = options.n, options.each, options.seed
    n, each = (min(n, 2), min(each, 10)) if options.quick else (n, each)
    loaded = load_prior(options.prior)
    by_object: list[list[Task]] = []
    for number, view in views(ANY, n, lambda _: False):
        assert view is not None
        h = estimate(view.frame, view.segment, loaded, seed=seed, stages=240).hypotheses
        refuse_cut(h.result)
        by_object.append(tasks_of(belief_of(view, h), each, np.random.default_rng([seed, number, 53])))
        collided = {b: np.mean([t.outcome(b, LEAST)[0] for t in by_object[-1]] or [0.0]) for b in BELIEFS}
        say(
            f"{len(by_object)}, object {number}, {len(by_object[-1])} scenes: collided "
            + ", ".join(f"{b} {v:.2f}" for b, v in collided.items())
        )
    rows, lines = [], []
    scenes = sum(map(len, by_object))
    for belief in BELIEFS:
        mean, low, high = _means(by_object, belief, LEAST)
        found = [PairedInterval(*ends, scenes) for ends in zip(mean, low, high, strict=True)]
        for name, i in zip(("collided", "no_way", "detour"), found, strict=True):
            for label, value in (("", i.mean), ("_q025", i.low), ("_q975", i.high)):
                unit = "m" if name == "detour" else ""
                rows.append(Row("reach", belief, f"least {LEAST:g}", name + label, float(value), unit, scenes))
        lines.append([belief, gated(ranged(found[0]), found[0].mean, most=0.05), *map(ranged, found[1:])])
    title = f"{scenes} scenes about {len(by_object)} objects, P(free) >= {LEAST:g}"
    table = Table(title, ("belief", "collided, gate <= 0.05", "no way", "detour, m"), lines)
    return Summary(rows, [table], lambda: _draw(by_object))


def _means(
    by_object: list[list[Task]], belief: str, least: float, resamples: int = 300
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over all scenes, and their 95% bootstrap interval over objects."""
    sums = []
    for tasks in by_object:
        found = np.array([t.outcome(belief, least) for t in tasks]).reshape(-1, 3)
        going = np.isfinite(found[:, 2]) & np.array([t.solved for t in tasks], bool)
        sums.append([*found[:, :2].sum(axis=0), len(found), found[going, 2].sum(), going.sum()])
    total = np.array(sums)

    def means(rows: np.ndarray) -> np.ndarray:
        s = total[rows].sum(axis=0)
        return np.array([s[0] / s[2], s[1] / s[2], s[3] / max(s[4], 1)])

    rng = np.random.default_rng(0)
    drawn = np.array([means(rng.integers(len(total), size=len(total))) for _ in range(resamples)])
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
    return means(np.arange(len(total))), low, high


def _draw(by_object: list[list[Task]]) -> Figure:
    """Collisions against what caution costs: a curve over `least` where there are probabilities, else a point."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    cost: tuple[Callable, ...] = (lambda m: m[1], lambda m: 100 * m[2])
    for ax, of, label in zip(
        figure.subplots(1, 2), cost, ("scenes in which no way was free enough", "detour, cm"), strict=True
    ):
        for belief in BELIEFS:
            levels = SWEEP if belief in (FARSIDE, INDEPENDENT) else (LEAST,)
            points = np.array([[of(m), m[0]] for m in (_means(by_object, belief, least, 1)[0] for least in levels)])
            ax.plot(*points.T, "o-", color=COLOURS[belief], label=belief, ms=4)
            if len(levels) > 1:
                at = SWEEP.index(LEAST)
                ax.plot(*points[at], "o", color=COLOURS[belief], ms=9, mfc="none")
        ax.set(xlabel=label, ylabel="scenes in which it collided", ylim=(0, None))
    ax.legend(fontsize=9)
    figure.suptitle(f"{sum(map(len, by_object))} reaches beside {len(by_object)} objects; rings: least {LEAST:g}")
    return figure
