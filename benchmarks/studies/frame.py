"""A real frame (YCB-Video 000002): hypotheses against the true models, with and without a given label.

The frame is read from ../shared/data/ycbv_000002 beside the checkout. Each object (1 coffee can, 11 pitcher, 3 sugar
box, 9 meat can) takes the whole path from frame to hypotheses. Without labels, an object is the segment with the
largest IoU with its label. Nothing was tuned on the pitcher, the sugar box or the meat can.

- chamfer: symmetric Chamfer distance between a hypothesis' surface (centres of exposed voxel faces) and the true
  model's points at the true pose, mm; the weighted median over hypotheses.
- p_within_one_voxel: on the true surface points at least 10 mm behind the measured depth, the mean of the largest
  p_occupied among the 27 voxels about the point.
- p_three_voxels_outside: mean p_occupied three voxels outside those points along their normals (from 12 neighbours,
  away from the model's centre). Only points above the plane, at least 10 mm behind the measured depth, and at least
  two voxels from every true surface point count.
- log_score: half the mean -log p_occupied over hidden surface points (as above) plus half the mean -log(1 -
  p_occupied) over unseen free points. These are uniform in the model's box enlarged by 6 cm, above the plane, at least
  10 mm behind the measured depth, outside every model's box by 5 mm, and 15 mm from any true surface. Probabilities
  are clipped at 0.001.
- seconds: from the frame in memory to the hypotheses, with programs compiled before (`segment` finds all objects at
  once).
"""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from benchmarks.harness.progress import say
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorTableOptions, Summary
from benchmarks.harness.tables import Table, gated
from benchmarks.measures.metrics import hidden_log_score, symmetric_chamfer
from benchmarks.rivals.quick import warm_up
from perception.answers.hypotheses import Hypotheses, surface_points
from perception.answers.query import query
from perception.answers.regions import Points
from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.observation.segmentation import Segment, segment
from perception.observation.support_plane import heights
from perception.sources.frame import Frame
from perception.sources.frame_folder import read_frame_folder
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.types import BASE_Z

DATA = Path(__file__).resolve().parent.parent.parent.parent / "shared" / "data" / "ycbv_000002"
OBJECTS = {1: "coffee can", 11: "pitcher", 3: "sugar box", 9: "meat can"}
# A published tabletop mapper (V-PRISM, arXiv 2403.08106), run on this frame with true masks on two cores, 2 s in all.
VPRISM = {1: 0.80, 11: 1.23, 3: 0.44, 9: 0.15}
VPRISM_SECONDS = 2.0
CHAMFER_MM = {1: 10.0, 11: 15.0}  # what it must show; and on the same objects
P_SURFACE, P_OUTSIDE = 0.5, 0.1
BEHIND = 0.010  # m behind the measured depth counts as hidden
SAMPLES = 40_000  # uniform points that free ones are taken from


@dataclass(frozen=True, eq=False)
class TrueObject:
    """A model at its true pose, metres."""

    points: Float[np.ndarray, "n 3"]  # surface, in the model's own frame
    T_camera_object: Float[np.ndarray, "4 4"]

    @property
    def in_camera(self) -> Float[np.ndarray, "n 3"]:
        return self.points @ self.T_camera_object[:3, :3].T + self.T_camera_object[:3, 3]

    def box_holds(self, camera_points: Float[np.ndarray, "m 3"], margin: float) -> Bool[np.ndarray, "m"]:
        """Which points (camera frame) lie in the model's box enlarged by `margin` on every side."""
        own = (camera_points - self.T_camera_object[:3, 3]) @ self.T_camera_object[:3, :3]
        low, high = self.points.min(axis=0) - margin, self.points.max(axis=0) + margin
        return np.all((own >= low) & (own <= high), axis=1)


@dataclass(frozen=True, eq=False)
class Judged:
    """One object of the frame, answered and measured."""

    id: int
    labelled: bool
    found: Estimate
    points: Float[np.ndarray, "n 3"]  # the true surface in the cube
    values: dict[str, float]

    @property
    def condition(self) -> str:
        return f"object {self.id} ({OBJECTS[self.id]}), label {'given' if self.labelled else 'not given'}"


def read_truth(folder: Path) -> dict[int, TrueObject]:
    """Models and true poses of a frame folder, by label."""
    meta = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
    result = {}
    for entry in meta["objects"]:
        T = np.eye(4)
        T[:3] = entry["T_camera_object"]
        result[int(entry["label"])] = TrueObject(np.loadtxt(folder / "models" / f"{entry['name']}.xyz"), T)
    return result


def is_hidden(frame: Frame, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which points (camera frame, m) lie at least 10 mm behind the measured depth; false without a measurement."""
    px = np.round(frame.camera.project(points))
    size = np.array([frame.camera.width, frame.camera.height])
    inside = np.asarray(((px >= 0) & (px < size)).all(axis=1))
    u, v = np.where(inside[:, None], px, 0).astype(int).T
    assert frame.depth is not None
    with np.errstate(invalid="ignore"):
        return inside & (points[:, 2] >= frame.depth[v, u] + BEHIND)


def outward_normals(points: Float[np.ndarray, "n 3"], neighbours: int = 12) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a surface's points from their neighbours' plane, turned away from the points' middle."""
    near = points[cKDTree(points).query(points, neighbours)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return normals * np.where(np.einsum("ni,ni->n", normals, points - middle) < 0, -1.0, 1.0)[:, None]


def free_points(
    frame: Frame, plane: Float[np.ndarray, "4"], truth: dict[int, TrueObject], object_id: int, seed: int = 0
) -> Float[np.ndarray, "n 3"]:
    """Unseen free points of an object's surroundings (camera frame, m), as the log score defines them."""
    own = truth[object_id]
    rng = np.random.default_rng([seed, object_id, 37])
    low, high = own.points.min(axis=0) - 0.06, own.points.max(axis=0) + 0.06
    points = rng.uniform(low, high, (SAMPLES, 3)) @ own.T_camera_object[:3, :3].T + own.T_camera_object[:3, 3]
    keep = (heights(points, plane) > 0) & is_hidden(frame, points)
    for other in truth.values():
        keep &= ~other.box_holds(points, 0.005)
    keep &= cKDTree(np.concatenate([other.in_camera for other in truth.values()])).query(points)[0] >= 0.015
    return points[keep]


def measure(
    h: Hypotheses, frame: Frame, plane: Float[np.ndarray, "4"], truth: dict[int, TrueObject], object_id: int
) -> dict[str, float]:
    """Every measure of one object's hypotheses but the time."""
    surface = truth[object_id].in_camera
    own = h.object_frame.to_cube(surface) * h.object_frame.half_extent  # metres in the object frame
    distance = np.array([symmetric_chamfer(surface_points(h, i), own) for i in range(len(h.weights))])
    hidden = is_hidden(frame, surface)
    width = 2.0 * h.object_frame.half_extent / h.grid
    outside = surface[hidden] + 3.0 * width * outward_normals(surface)[hidden]
    clear = cKDTree(np.concatenate([t.in_camera for t in truth.values()])).query(outside)[0] >= 2.0 * width
    outside = outside[clear & (heights(outside, plane) > 0) & is_hidden(frame, outside)]
    index = h.voxels("camera", *surface[hidden].T)
    about = np.where(index >= 0, maximum_filter(h.p_occupied, 3).ravel()[index], 0.0)
    free = free_points(frame, plane, truth, object_id)
    return {
        "chamfer": 1000.0 * float(np.quantile(distance, 0.5, weights=h.weights, method="inverted_cdf")),
        "p_within_one_voxel": float(about.mean()),
        "p_three_voxels_outside": float(np.mean(_p_occupied(h, outside))),
        "log_score": hidden_log_score(_p_occupied(h, surface[hidden]), _p_occupied(h, free)),
    }


def _p_occupied(h: Hypotheses, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """What `farside query --points` answers about points in the camera frame."""
    return np.array(query([h], Points(points), "camera", now_ns=h.stamp_ns).p_occupied)


def _matching(segments: Sequence[Segment], mask: Bool[np.ndarray, "h w"]) -> Segment | None:
    """The segment of largest IoU with a mask; None where none overlaps it by a quarter."""
    overlap = [float((s.mask & mask).sum() / (s.mask | mask).sum()) for s in segments]
    best = int(np.argmax(overlap)) if overlap else -1
    return segments[best] if best >= 0 and overlap[best] >= 0.25 else None


@dataclass(frozen=True)
class Options(PriorTableOptions):
    """A real table (YCB-Video 000002): hypotheses against the true models, label given and not."""

    data: Path = DATA
    """The frame's folder."""
    budget_s: float = 60.0
    """Seconds that an object may take."""
    stages: int = 0
    """Stages that the sampler may take instead of the budget (0: the budget holds)."""


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    data = options.data
    if not (data / "models").is_dir():
        raise FileNotFoundError(f"{data}: no frame with true models there; give its folder with --data")
    loaded, frame, truth = load_prior(options.prior), read_frame_folder(data), read_truth(data)
    judged: list[Judged] = []
    config, sizes = ControllerConfig(), set[tuple[int, ...]]()
    for labelled in (True, False):
        begun = time.monotonic()
        given = frame if labelled else replace(frame, label=None)
        segments = segment(given)
        shared = time.monotonic() - begun
        for object_id in list(OBJECTS)[: 1 if options.quick else None]:
            assert frame.label is not None
            chosen = _matching(segments, frame.label == object_id)
            if chosen is None:
                say(f"object {object_id} ({OBJECTS[object_id]}): not found without its label")
                continue
            warm_up(given, chosen, loaded, config, sizes)
            answered = _judge(given, chosen, loaded, config, truth, object_id, labelled, shared, options)
            judged.append(answered)
    return Summary(_rows(judged), [_table(judged)], lambda: _draw(judged))


def _judge(
    frame: Frame,
    chosen: Segment,
    prior: Prior,
    config: ControllerConfig,
    truth: dict[int, TrueObject],
    object_id: int,
    labelled: bool,
    shared_s: float,
    options: Options,
) -> Judged:
    found = estimate(
        frame,
        chosen,
        prior,
        config,
        seed=options.seed,
        budget_s=None if options.stages else options.budget_s,
        stages=options.stages or None,
    )
    h = found.hypotheses
    values = measure(h, frame, chosen.plane, truth, object_id)
    values |= {"seconds": found.seconds + shared_s, "out_of_model": float(h.out_of_model)}
    judged = Judged(object_id, labelled, found, h.object_frame.to_cube(truth[object_id].in_camera), values)
    say(f"{judged.condition}: {', '.join(f'{k} {v:.3g}' for k, v in values.items())} ({h.result})")
    return judged


def _rows(judged: Sequence[Judged]) -> list[Row]:
    units = {"chamfer": "mm", "log_score": "nats", "seconds": "s"}
    rows = [
        Row("frame", "tempered_smc", j.condition, metric, value, units.get(metric, ""), len(j.found.hypotheses.weights))
        for j in judged
        for metric, value in j.values.items()
    ]
    for object_id in {j.id: None for j in judged}:
        condition = f"object {object_id} ({OBJECTS[object_id]}), label given"
        method = "published mapper on this frame (V-PRISM, arXiv 2403.08106)"
        rows.append(Row("frame", method, condition, "log_score", VPRISM[object_id], "nats", 1))
        rows.append(Row("frame", method, condition, "seconds", VPRISM_SECONDS, "s", 1))
    return rows


def _table(judged: Sequence[Judged]) -> Table:
    """Gates are of the coffee can and the pitcher."""
    lines = []
    for j in judged:
        v, bound = j.values, CHAMFER_MM.get(j.id)
        texts = [
            f"{v['chamfer']:.1f}" + (f" (<= {bound:g})" if bound else ""),
            f"{v['p_within_one_voxel']:.2f}",
            f"{v['p_three_voxels_outside']:.3f}",
            f"{v['log_score']:.3f} ({VPRISM[j.id]:.2f})",
        ]
        if bound is not None:
            texts = [
                gated(texts[0], v["chamfer"], most=bound),
                gated(texts[1], v["p_within_one_voxel"], least=P_SURFACE),
                gated(texts[2], v["p_three_voxels_outside"], most=P_OUTSIDE),
                gated(texts[3], v["log_score"], most=VPRISM[j.id]),
            ]
        lines.append([j.condition, *texts, f"{v['seconds']:.0f}", j.found.hypotheses.result])
    header = (
        "object", "Chamfer distance, mm", f"p at the surface, gate >= {P_SURFACE:g}",
        f"p three voxels outside, gate <= {P_OUTSIDE:g}", "log score (the mapper's, the gate)", "s", "stopped",
    )  # fmt: skip
    title = "YCB-Video 000002; the mapper is V-PRISM (arXiv 2403.08106), run on this frame with true masks"
    return Table(title, header, lines)


def _draw(judged: Sequence[Judged]) -> Figure:
    """Two sections of each object, upright towards the camera and level: p_occupied, shapes' outlines, true points."""
    figure = Figure(figsize=(14, 3.6 * max(1, -(-len(judged) // 2))), layout="constrained", dpi=110)
    axes = figure.subplots(max(1, -(-len(judged) // 2)), 4, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for i, j in enumerate(judged):
        h, middle = j.found.hypotheses, 0.5 * (j.points.min(axis=0) + j.points.max(axis=0))
        upright, level = axes[i // 2, 2 * (i % 2) : 2 * (i % 2) + 2]
        for ax, cut, across, up in ((upright, 1, 0, 2), (level, 2, 1, 0)):
            at = int(np.clip((middle[cut] + 1.0) * 0.5 * h.grid, 0, h.grid - 1))
            plane = np.take(h.p_occupied, at, axis=cut)
            image = plane.T if across < up else plane
            ax.imshow(image, origin="lower", extent=(-1, 1, -1, 1), cmap="magma", vmin=0, vmax=1)
            for k in np.argsort(-h.weights)[:6]:
                shape = np.take(h.solid[k], at, axis=cut)
                if shape.any():
                    ax.contour(
                        shape.T if across < up else shape, [0.5], extent=(-1, 1, -1, 1), colors="w", linewidths=0.4
                    )
            slab = np.abs(j.points[:, cut] - middle[cut]) < 0.06
            ax.plot(j.points[slab, across], j.points[slab, up], ".", color="tab:cyan", markersize=2)
            ax.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
        upright.axhline(BASE_Z, color="0.6", linewidth=0.8)
        upright.set_title(f"{j.condition}\nChamfer {j.values['chamfer']:.1f} mm", fontsize=9)
        level.set_title(f"level (camera at the top)\nlog score {j.values['log_score']:.2f}", fontsize=9)
    figure.suptitle(
        "p_occupied in two sections (upright: camera on the right), six hypotheses in white, true surface in cyan"
    )
    return figure
