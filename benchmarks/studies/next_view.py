"""Whether the suggested next view is worth more than another: unseen space after a second picture.

Objects of the test seeds from one random view each, as in `farside bench calibration`. The camera's place is known.
After the first answer, a second picture is taken from one of 36 places around the object at the same distance
(`ring_of_views`):

- suggested: the place with the largest expected information gain
- random: any of them
- farthest: the place whose direction is farthest from the first camera's

The answer goes on from both pictures, as `farside live` does. hidden_nll is over the voxels that the first picture did
not see, by the true geometry, with the usual smoothing.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, gap_rows, mean_rows
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, gated, ranged
from benchmarks.measures.metrics import hidden_nll, scored_voxels
from benchmarks.scenes.conditions import any_view
from benchmarks.scenes.vessels import GRID, VesselPicture, VesselView, base_rate, vessel_view
from perception.answers.hypotheses import Hypotheses
from perception.answers.next_view import rank_views, ring_of_views
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker
from perception.observation.segmentation import segment
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import TableScene, render
from probnerf.objects.tabletop import TEST_SEEDS
from probnerf.prior.checkpoint import Prior, load_prior
from probnerf.rendering.occupancy import coarsen, voxel_centres

FIRST = 8000  # among the test seeds: objects of no other measurement
NONE, SUGGESTED, RANDOM, FARTHEST = CHOICES = ("first picture alone", "suggested", "random", "farthest")
COLOURS = dict(zip(CHOICES, ("tab:gray", "tab:blue", "tab:orange", "tab:green"), strict=True))
CONDITION = "any view"
MOVED = "taken for a moved object"
STAGES = 240  # at most, a picture


def places(h: Hypotheses, rng: np.random.Generator) -> dict[str, tuple[Float[np.ndarray, "4 4"], float]]:
    """T_object_camera (m) of the second picture and its expected gain in nats, by who chooses."""
    ring = ring_of_views(h)
    ranked = rank_views([h], ring, count=len(ring))
    present = np.linalg.inv(h.object_frame.T_camera_object)[:3, 3]
    towards = ranked.T_object_camera[:, :3, 3] @ present
    chosen = {SUGGESTED: 0, RANDOM: int(rng.integers(len(ring))), FARTHEST: int(np.argmin(towards))}
    return {who: (ranked.T_object_camera[k], float(ranked.gain_nats[k])) for who, k in chosen.items()}


def second_answer(
    tracker: Tracker, view: VesselView, picture: VesselPicture, T_object_camera: Float[np.ndarray, "4 4"], seed: int
) -> tuple[Hypotheses, str]:
    """The answer from both pictures, and what the second was taken for; `tracker` stays as it is."""
    T_world_camera = picture.T_world_camera @ view.cube.T_camera_object @ T_object_camera
    scene = TableScene((picture.placed,))
    frame = sense(render(scene, picture.camera, T_world_camera), picture.camera, T_world_camera, seed)
    own = replace(tracker, _tracks=dict(tracker._tracks), _names=set(tracker._names))
    found = own.update(frame, segment(frame, 1)[0], stages=STAGES)
    refuse_cut(found.hypotheses.result)
    return found.hypotheses, found.change


def shapes_in(view: VesselView, picture: VesselPicture, h: Hypotheses) -> Bool[np.ndarray, "S 32 32 32"]:
    """The hypotheses on the voxels of the first view's cube, whatever cube they were given in (an object that is taken
    for a moved one begins anew in the second picture's).
    """
    points = view.cube.to_camera(voxel_centres(h.grid).reshape(-1, 3))
    points = points @ picture.T_world_camera[:3, :3].T + picture.T_world_camera[:3, 3]
    index = h.voxels("world", *points.T)
    shapes = h.solid.reshape(len(h.weights), -1).take(np.maximum(index, 0), axis=1) & (index >= 0)
    return coarsen(shapes.reshape(h.solid.shape), GRID)


@dataclass(frozen=True)
class Options(PriorOptions):
    """Unseen space after a second picture: from the suggested place, a random one and the farthest one."""

    n: int = 50
    """Objects."""


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=min(options.n, 2))
    prior, results = load_prior(options.prior), results_of("next_view", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity, options.seed), options),
    )


def _measure(options: Options, prior: Prior, results: Results) -> None:
    config, found = ControllerConfig(), 0
    common = {"prior": prior.identity, "seed": options.seed, "condition": CONDITION}
    common["settings"] = {"digest": digest(asdict(config), options.quick)}
    rate = base_rate(128 if options.quick else 1024, config=config.observe)
    for number in TEST_SEEDS[FIRST:]:
        if found == options.n:
            break
        if all({**common, "method": who, "object": number} in results for who in CHOICES):
            found += 1
            continue
        picture = any_view(number)
        try:
            view = vessel_view(picture)
            answered = _answered(Tracker(prior, config, seed=options.seed), picture, view, rate, options.seed)
        except ValueError as refusal:  # outside perception's range of sizes, or too few pixels in either picture
            say(f"object {number} is left out: {refusal}")
            continue
        found += 1
        for who, line in answered.items():
            results.add({**common, "method": who, "object": number, **line})
        say(f"{found}, object {number}: " + ", ".join(f"{w} {v['hidden_nll']:.3f}" for w, v in answered.items()))


def _answered(
    tracker: Tracker, picture: VesselPicture, view: VesselView, rate: Float[np.ndarray, "32 32 32"], seed: int
) -> dict[str, Line]:
    scored = scored_voxels(view.seen, rate)

    def judged(h: Hypotheses) -> float:
        p = np.tensordot(h.weights, shapes_in(view, picture, h), 1)
        return round(hidden_nll(p, rate, view.solid, scored), 5)

    first = tracker.update(view.frame, view.segment, stages=STAGES).hypotheses
    refuse_cut(first.result)
    lines: dict[str, Line] = {NONE: {"hidden_nll": judged(first), "gain": 0.0, "change": "new"}}
    for who, (T, gain) in places(first, np.random.default_rng([seed, view.seed, 61])).items():
        h, change = second_answer(tracker, view, picture, T, seed=view.seed + 1)
        lines[who] = {"hidden_nll": judged(h), "gain": round(gain, 4), "change": change}
    return lines


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the objects that every choice has a row of; None where there are none."""
    complete = set.intersection(*({line["object"] for line in lines if line["method"] == who} for who in CHOICES))
    if not complete:
        return None
    chosen = sorted((line for line in lines if line["object"] in complete), key=lambda line: line["object"])
    by = {who: np.array([line["hidden_nll"] for line in chosen if line["method"] == who]) for who in CHOICES}
    rows = []
    for who, values in by.items():
        rows += mean_rows("next_view", who, CONDITION, "hidden_nll", values, "nats")
        rows += gap_rows("next_view", who, CONDITION, "hidden_nll_above_suggested", values, by[SUGGESTED])
        moved = [line["change"] == "moved" for line in chosen if line["method"] == who]
        rows.append(Row("next_view", who, CONDITION, MOVED, float(np.mean(moved)), "", len(moved)))
    of, cells = Figures(rows), []
    for who in by:
        gap = of.interval(CONDITION, who, "hidden_nll_above_suggested")
        above = "" if who == SUGGESTED else gated(ranged(gap, sign="+"), gap.low, least=0.0)
        cells.append([who, f"{of(CONDITION, who, 'hidden_nll'):.3f}", above, f"{of(CONDITION, who, MOVED):.0%}"])
    title = f"{len(complete)} objects, nats a voxel over what the first picture did not see"
    header = ("second picture", "hidden_nll", "above the suggested place's, gate > 0", MOVED)
    return Summary(rows, [Table(title, header, cells)], lambda: _draw(by))


def _draw(by: dict[str, Float[np.ndarray, "n"]]) -> Figure:
    """Scores by who chose; each object's, against the suggested place's."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    bars, each = figure.subplots(1, 2)
    for k, (who, values) in enumerate(by.items()):
        error = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else None
        bars.bar(k, values.mean(), yerr=error, color=COLOURS[who], capsize=4)
    bars.set_xticks(range(len(by)), by, fontsize=9)
    bars.set_ylabel("hidden_nll, nats a voxel")
    bars.set_title(f"space the first picture did not see, {len(by[NONE])} objects")
    top = max(float(values.max()) for values in by.values())
    for who in (RANDOM, FARTHEST):
        each.plot(by[SUGGESTED], by[who], "o", color=COLOURS[who], ms=4, label=who)
    each.plot([0, top], [0, top], "k--", linewidth=1)
    each.set(xlabel="second picture as suggested, nats", ylabel="chosen otherwise, nats", title="each object")
    each.legend(fontsize=9)
    return figure
