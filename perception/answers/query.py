"""Queries about a region of space, answered from hypotheses only, also offline from a saved file.

Answers are joint: "is the whole region free" is evaluated for each hypothesis and then averaged, never multiplied over
voxels. Several objects are one scene: given the frame their posteriors are independent, so a scene's hypothesis is one
of each, and the probability that a region is free of all is the product over *objects* of their joint probabilities.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates

from perception.answers.hypotheses import FrameName, Hypotheses, binary_entropy
from perception.answers.regions import Cells, Points, Region, Swept
from probnerf.rendering.occupancy import voxel_index
from probnerf.types import BASE_Z

Verdict = Literal["free", "occupied", "unsure", "unseen"]

# Weight of "all that was not seen is occupied" beside the hypotheses of an object that its prior cannot explain.
CAUTION = 0.5
MAX_SAMPLES = 200_000  # lattice of a box that the unseen and outside fractions are counted on
SWEPT_SAMPLES = 20_000  # the same of swept boxes, each of which is compared with all before it
THINNEST = 1e-9  # m; an edge below counts as this long, as a product of such may be 0
SLAB = 1_000_000  # samples of a box that are in memory at a time
JOINT_DRAWS = 4096  # of the scene's volume, where there are several objects


@dataclass(frozen=True)
class QueryResult:
    """The answer about a region. Space outside every object's cube counts as free here: read `outside_fraction` too.

    Where all of the region lies there nothing was inferred, and `p_free` and what belongs to it are NaN.
    """

    p_free: float  # probability that no occupied voxel lies in the region
    p_free_se: float  # its Monte Carlo standard error
    p_free_few: float  # p_free by the rule of succession: what so few hypotheses can support
    volume_m3: dict[
        str, float
    ]  # occupied volume in the region: quantiles q05, q50, q95 (points: of the voxels they hit)
    unseen_fraction: float  # share of the region inside some object's cube that no pixel has seen
    outside_fraction: float  # share of the region outside every object's cube, or in the table: unobserved
    entropy_nats: float  # mean over the region's voxels of the binary entropy of p_occupied; 0 where it has no voxels
    effective_hypotheses: float  # distinct weighted hypotheses behind the answer; of several objects, the fewest
    age_s: float  # since the (oldest) frame's stamp
    # by object id: which of its hypotheses (rows of its file) have something in the region, where some have: those
    # disagree with the rest
    blocked_by: dict[int, list[int]] = field(default_factory=dict)
    # of each point, between voxels' centres, and so not 1 - p_free of the voxel that holds it; None for a box
    p_occupied: list[float] | None = None
    p_occupied_few: list[float] | None = None  # the same by the rule of succession, in unseen space

    def verdict(self, risk: float = 0.05) -> Verdict:
        """Free or occupied where the hypotheses' chance of being wrong is at most `risk` in (0, 0.5), else unsure.

        Unseen is a region that nobody looked at: all of it outside of the objects' cubes, or in the table.

        The chance accounts for the number of hypotheses: for one object, n effective ones that all agree leave
        1 / (n + 2) (the rule of succession), so for a smaller risk the verdict is always unsure. A region that extends
        outside every object's cube, or into the table, is never free: that space was not observed. `farside bench
        calibration` measures how often verdicts on real unseen space are wrong. Raises ValueError for another risk.
        """
        if not 0.0 < risk < 0.5:
            raise ValueError(f"risk is {risk:g}; give the chance of being wrong that you accept, above 0 and below 0.5")
        if self.outside_fraction == 1.0:
            return "unseen"
        if 1.0 - self.p_free_few <= risk:
            return "free" if self.outside_fraction == 0.0 else "unsure"
        return "occupied" if self.p_free_few <= risk else "unsure"

    def as_dict(self) -> dict[str, float | dict[str, float] | dict[int, list[int]] | list[float] | None]:
        """The fields by name, ready for JSON: None for NaN, without those of points where there are none."""
        return {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in vars(self).items()
            if value is not None
        }


def query(scene: Sequence[Hypotheses], region: Region, frame: FrameName, now_ns: int | None = None) -> QueryResult:
    """Answer a question about `region`, given in metres in `frame`, jointly over all objects of the scene.

    Raises ValueError for an empty scene, objects of different frames, a frame that is unknown, or not recorded
    ("world"), or ambiguous ("object" with several objects).
    """
    check_one_frame(scene)
    if frame == "object" and len(scene) > 1:
        raise ValueError(
            f"the object frame is ambiguous with {len(scene)} objects: ask in the frame camera or world, or one object"
        )
    touched = []  # objects that have voxels in the region
    p_free, p_free_se, p_free_few, volumes, entropies = [], [], [], [], []
    blocked_by: dict[int, list[int]] = {}
    met = False  # it has a voxel above the table
    for h in scene:
        index, volume = _region_voxels(h, region, frame)
        if not len(index):
            continue
        met = met or bool(_above(index, h).any())
        occupied = h.solid.reshape(len(h.weights), -1).take(index, axis=1)
        blocked = np.asarray(occupied.any(axis=1))
        if blocked.any():
            blocked_by[h.object_id] = np.flatnonzero(blocked).tolist()
        free, se = h.estimate(~blocked)
        weights, filled = h.weights, np.array([volume[row].sum() for row in occupied])
        if h.out_of_model:
            hidden = h.unseen.ravel()[index]
            free, se = (1 - CAUTION) * free + CAUTION * (not hidden.any()), (1 - CAUTION) * se
            weights, filled = np.append((1 - CAUTION) * weights, CAUTION), np.append(filled, volume[hidden].sum())
        touched.append(h)
        p_free.append(float(free))
        p_free_se.append(float(se))
        p_free_few.append(float(_succession(free, h)))
        volumes.append((filled, weights))
        entropies.append(binary_entropy(marginal(h)[index]))
    # Errors of a product of independent factors: sum over objects of (se_o times the other factors)^2.
    others = [np.prod(p_free[:o] + p_free[o + 1 :]) for o in range(len(p_free))]
    unseen, outside = _fractions(scene, region, frame)
    if met:  # of a region so large that no sample fell into a cube
        outside = min(outside, float(np.nextafter(1.0, 0.0)))
    points = region if isinstance(region, Points) else None
    known = math.nan if outside == 1.0 else 1.0
    return QueryResult(
        p_free=known * float(np.prod(p_free)),
        p_free_se=known * float(np.linalg.norm(np.multiply(p_free_se, others))),
        p_free_few=known * float(np.prod(p_free_few)),
        volume_m3=_volume_quantiles(volumes),
        unseen_fraction=unseen,
        outside_fraction=outside,
        entropy_nats=float(np.mean(np.concatenate(entropies))) if entropies else 0.0,
        effective_hypotheses=min(h.effective_hypotheses for h in touched or scene),
        age_s=((time.time_ns() if now_ns is None else now_ns) - min(h.stamp_ns for h in scene)) * 1e-9,
        blocked_by=blocked_by,
        p_occupied=None if points is None else _p_occupied(scene, points, frame),
        p_occupied_few=None if points is None else _p_occupied(scene, points, frame, few=True),
    )


def check_one_frame(scene: Sequence[Hypotheses]) -> None:
    """Raises ValueError for an empty scene, and for objects that were seen in different frames."""
    if not scene:
        raise ValueError("the scene holds no objects; give at least one object's hypotheses")
    first = scene[0]
    for h in scene[1:]:
        if (h.stamp_ns, h.frame_id) != (first.stamp_ns, first.frame_id):
            raise ValueError(
                f"objects {first.object_id} and {h.object_id} are from different frames ('{first.frame_id}' at "
                f"{first.stamp_ns} ns, '{h.frame_id}' at {h.stamp_ns} ns): ask each file alone, or remove the stale one"
            )


def marginal(h: Hypotheses) -> Float[np.ndarray, "V"]:
    """p_occupied of each of the G^3 voxels, cautious where the object is out of model."""
    p = h.p_occupied.ravel()
    return (1 - CAUTION) * p + CAUTION * h.unseen.ravel() if h.out_of_model else p


def _succession(p: Float[np.ndarray, "..."] | np.floating, h: Hypotheses) -> Float[np.ndarray, "..."]:
    """(n p + 1) / (n + 2) of n effective hypotheses; one population counts as one."""
    n = 1.0 if h.alone else h.effective_hypotheses
    return (n * np.asarray(p) + 1.0) / (n + 2.0)


def _region_voxels(
    h: Hypotheses, region: Region, frame: FrameName
) -> tuple[Int[np.ndarray, "U"], Float[np.ndarray, "U"]]:
    """Flat indices of the object's voxels in the region, and the volume (m^3) of each that lies in it.

    A box, cut to the cube, is sampled on a lattice half a voxel wide or finer, at least one sample per axis, so that a
    thin box still finds its voxels. Points select the voxels that contain them. Of swept boxes, each eighth of a voxel
    counts if its centre lies in one. Cells wider than half a voxel are split first.
    """
    hits = np.zeros(h.grid**3, int)
    if isinstance(region, Points | Cells):
        points = region.points if isinstance(region, Points) else _finer(region, 0.5 * h.voxel_m)
        hits += _count(h.voxels(frame, *points.T), h)
        index = np.flatnonzero(hits)
        if isinstance(region, Points):
            return index, np.full(len(index), h.voxel_m**3)
        return index, hits[index] * (region.width**3 * len(region.centres) / len(points))
    T = np.linalg.inv(h.T_object_from(frame))
    if isinstance(region, Swept):
        filled = _filled(h, region, np.linalg.inv(T) @ region.T_frame_box)
        index = np.flatnonzero(filled)
        return index, filled[index] * (0.5 * h.voxel_m) ** 3
    corners = h.object_frame.half_extent * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = corners @ T[:3, :3].T + T[:3, 3]
    low, high = np.maximum(region.low, corners.min(axis=0)), np.minimum(region.high, corners.max(axis=0))
    if not np.all(low < high):
        return np.zeros(0, int), np.zeros(0)
    counts = np.ceil((high - low) / (0.5 * h.voxel_m) * (1 - 1e-9)).astype(int)  # rounding adds no sample
    x, y, z = _lattice(low, high, counts)
    step = max(1, SLAB // (counts[1] * counts[2]))
    for start in range(0, len(x), step):
        hits += _count(h.voxels(frame, x[start : start + step], y, z), h)
    index = np.flatnonzero(hits)
    return index, hits[index] * np.prod((high - low) / counts)


def _filled(h: Hypotheses, region: Swept, T_object_box: Float[np.ndarray, "N 4 4"]) -> Int[np.ndarray, "V"]:
    """How many eighths of each voxel lie in the union of boxes."""
    boxes, n = Swept(T_object_box, region.size), 2 * h.grid
    width = 0.5 * h.voxel_m
    centres = (np.arange(n) + 0.5) * width - h.object_frame.half_extent
    inside = np.zeros((n, n, n), bool)
    for k, (T, size) in enumerate(zip(T_object_box, region.size, strict=True)):
        reach = np.abs(T[:3, :3]) @ (0.5 * np.maximum(size, h.voxel_m))
        x, y, z = (
            slice(*np.searchsorted(centres, [middle - r, middle + r]))
            for middle, r in zip(T[:3, 3], reach, strict=True)
        )
        own = boxes.holds(k, centres[x, None, None], centres[y, None], centres[z], thicker=h.voxel_m)
        inside[x, y, z] |= own
    return inside.reshape(h.grid, 2, h.grid, 2, h.grid, 2).sum(axis=(1, 3, 5)).ravel()


def _finer(region: Cells, width: float) -> Float[np.ndarray, "n 3"]:
    """Centres of the cells, each cut into as many equal ones as make them `width` wide at most."""
    parts = int(np.ceil(region.width / width * (1 - 1e-9)))
    steps = ((np.arange(parts) + 0.5) / parts - 0.5) * region.width
    offsets = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return (region.centres[:, None] + offsets).reshape(-1, 3)


def _count(index: Int[np.ndarray, "..."], h: Hypotheses) -> Int[np.ndarray, "V"]:
    return np.bincount(index[index >= 0], minlength=h.grid**3)


def _lattice(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], counts: Int[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "nx 1 1"], Float[np.ndarray, "ny 1"], Float[np.ndarray, "nz"]]:
    """Cell centres of a regular lattice of `counts` cells over a box, as three axes that broadcast."""
    x, y, z = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, counts, strict=True))
    return x[:, None, None], y[:, None], z


def _fractions(scene: Sequence[Hypotheses], region: Region, frame: FrameName) -> tuple[float, float]:
    """Shares of the region that are (inside some cube but not seen, outside every cube or inside the table)."""
    share = np.ones(())
    if isinstance(region, Points | Cells):
        x, y, z = region.points.T if isinstance(region, Points) else region.centres.T
    elif isinstance(region, Swept):
        (x, y, z), share = _sampled(region, 0.5 * min(h.voxel_m for h in scene))
    else:
        low, high = np.array(region.low), np.array(region.high)
        counts = (high - low) / (0.5 * min(h.voxel_m for h in scene)) * (1 - 1e-9)
        while np.prod(np.ceil(counts)) > MAX_SAMPLES:
            counts *= 0.97
        x, y, z = _lattice(low, high, np.ceil(counts).astype(int))
    inside = seen = np.zeros((), bool)
    for h in scene:
        index = h.voxels(frame, x, y, z)
        above = (index >= 0) & _above(index, h)
        inside = inside | above
        seen = seen | (above & h.seen.ravel()[index])
    share = np.broadcast_to(share, np.shape(inside))
    return float(np.average(inside & ~seen, weights=share)), float(np.average(~inside, weights=share))


def _above(index: Int[np.ndarray, "..."], h: Hypotheses) -> Bool[np.ndarray, "..."]:
    """Which voxels, by flat index, lie above the table, whose height may err by a voxel."""
    return (index % h.grid + 1.5) * 2.0 / h.grid - 1.0 >= BASE_Z


def _sampled(region: Swept, width: float) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, "n"]]:
    """Points of the union of boxes, at most `SWEPT_SAMPLES` in all, and the volume that each represents."""
    points, shares = [], []
    for k, (T, size) in enumerate(zip(region.T_frame_box, region.size, strict=True)):
        counts = size / width
        while np.prod(np.ceil(counts)) > max(1, SWEPT_SAMPLES // len(region.size)):
            counts *= 0.9
        counts = np.maximum(np.ceil(counts), 1).astype(int)
        own = np.stack(np.broadcast_arrays(*_lattice(-0.5 * size, 0.5 * size, counts))).reshape(3, -1)
        own = T[:3, :3] @ own + T[:3, 3:]
        for earlier in range(k):  # what two boxes share counts once
            own = own[:, ~region.holds(earlier, *own)]
        points.append(own)
        shares.append(np.full(own.shape[1], np.prod(np.maximum(size, THINNEST) / counts)))
    return np.concatenate(points, axis=1), np.concatenate(shares)


def _p_occupied(scene: Sequence[Hypotheses], region: Points, frame: FrameName, few: bool = False) -> list[float]:
    """1 - prod over objects of (1 - p) at each point; with `few`, p of unseen points by the rule of succession."""
    free = np.ones(len(region.points))
    for h in scene:
        free *= 1.0 - _at_points(h, region.points, frame, few)
    return (1.0 - free).tolist()


def _at_points(h: Hypotheses, points: Float[np.ndarray, "n 3"], frame: FrameName, few: bool) -> Float[np.ndarray, "n"]:
    """One object's p at points; 0 outside its cube.

    Seen space is told voxel by voxel. In unseen space p is linear between the centres of voxels, for a shape's wall is
    known no better than to a voxel; so where a shape ends at the table, it falls within the half voxel above.
    """
    cube = h.to_cube(frame, *points.T)
    index = voxel_index(cube, h.grid)
    inside = index >= 0
    unseen = inside & h.unseen.ravel()[index]
    p = np.where(inside, h.p_occupied.ravel()[index], 0.0)
    places = (cube[unseen] + 1.0) * (0.5 * h.grid) - 0.5  # in voxels, 0 at the first one's centre
    p[unseen] = np.clip(map_coordinates(h.p_occupied, places.T, order=1, mode="nearest"), 0.0, 1.0)
    if h.out_of_model:
        p = (1 - CAUTION) * p + CAUTION * unseen
    return np.where(unseen, _succession(p, h), p) if few else p


def _volume_quantiles(objects: list[tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S"]]]) -> dict[str, float]:
    """q05, q50, q95 of the summed volume, m^3, of objects given as (volumes, weights).

    One object: the weighted quantiles (the least volume v with P(V <= v) >= q). Several: `JOINT_DRAWS` scenes, each
    object's draws at even quantiles of its own law and in an order shuffled with a fixed seed.
    """
    total, weights = np.zeros(1), np.ones(1)
    rng = np.random.default_rng(0)
    for volumes, own in objects:
        if len(objects) == 1:
            total, weights = volumes, own
        else:
            levels = rng.permutation((np.arange(JOINT_DRAWS) + 0.5) / JOINT_DRAWS)
            total = total + _quantile(volumes, own, levels)
            weights = np.full(JOINT_DRAWS, 1.0 / JOINT_DRAWS)
    q05, q50, q95 = _quantile(total, weights, np.array([0.05, 0.5, 0.95])).tolist()
    return {"q05": q05, "q50": q50, "q95": q95}


def _quantile(
    values: Float[np.ndarray, "S"], weights: Float[np.ndarray, "S"], levels: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    # tolerate rounding where a level is met exactly
    return np.quantile(values, levels - 1e-9, weights=weights, method="inverted_cdf")
