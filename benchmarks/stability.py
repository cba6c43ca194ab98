"""Where answers stop meaning what they say: one thing made worse at a time, until the method fails.

The same views throughout: objects of the test seeds as they come, from a random camera (`farside bench calibration`).
Sensor and calibration are spoilt by growing amounts, or the model is given too little, and everything else is left as
it ships. At every amount, over the views: hidden_nll of what is truly unseen; flagged: share of answers that say
`out_of_model`, or that perception refuses in words; falsely_free: of random unseen boxes given p_free > 0.95, the share
that is occupied. An exception other than a refusal, or a number that is none, counts as broken: there must be none.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy import ndimage

from benchmarks.calibration import any_view
from benchmarks.rows import Row
from benchmarks.scene import GRID, VesselPicture, base_rate, vessel_view
from benchmarks.score import BOXES, Answer, random_boxes, score
from benchmarks.summary import interval, say, table
from perception.controller import ControllerConfig, estimate
from perception.query import CAUTION
from perception.source import Frame
from probnerf.families.tabletop import TEST_SEEDS
from probnerf.metrics import falsely_free, paired_interval, scored_voxels
from probnerf.occupancy import coarsen
from probnerf.store import Prior, load_prior

FIRST = 6000  # of the test seeds: none of the calibration's objects


def intrinsics(frame: Frame, amount: float) -> Frame:
    """Focal length too long by a share."""
    K = frame.camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.0 + amount
    return replace(frame, camera=replace(frame.camera, K=K))


def depth_scale(frame: Frame, amount: float) -> Frame:
    """All depths too long by a share."""
    assert frame.depth is not None
    return replace(frame, depth=frame.depth * np.float32(1.0 + amount))


def depth_noise(frame: Frame, amount: float) -> Frame:
    """Independent errors of this standard deviation, m, that nobody states."""
    assert frame.depth is not None
    noise = np.random.default_rng(1).normal(0.0, amount, frame.depth.shape)
    return replace(frame, depth=(frame.depth + noise).astype(np.float32))


def holes(frame: Frame, amount: float) -> Frame:
    """No depth in patches that cover a share of the picture."""
    assert frame.depth is not None
    patches = ndimage.gaussian_filter(np.random.default_rng(2).normal(size=frame.depth.shape), 8.0)
    lost = patches > np.quantile(patches, 1.0 - amount) if amount > 0 else np.zeros(patches.shape, bool)
    return replace(frame, depth=np.where(lost, np.nan, frame.depth).astype(np.float32))


def flying(frame: Frame, amount: float) -> Frame:
    """Pixels so far (px) from the object's outline float between it and what is behind."""
    assert frame.depth is not None and frame.label is not None
    mask, width = frame.label == 1, round(amount)
    if not width:
        return frame
    band = ndimage.binary_dilation(mask, iterations=width) & ~ndimage.binary_erosion(mask, iterations=width)
    far, near = (
        f(np.nan_to_num(frame.depth, nan=1.0), 2 * width + 3) for f in (ndimage.maximum_filter, ndimage.minimum_filter)
    )
    mixed = near + np.random.default_rng(3).random(mask.shape) * (far - near)
    return replace(frame, depth=np.where(band, mixed, frame.depth).astype(np.float32))


def mask_shift(frame: Frame, amount: float) -> Frame:
    """The label map beside the object by so many px."""
    assert frame.label is not None
    return replace(frame, label=np.roll(frame.label, round(amount), axis=1))


def plane_tilt(frame: Frame, amount: float) -> Frame:
    """The table's depths turned about the picture's axis by so many degrees, the object's left as they are."""
    assert frame.depth is not None and frame.label is not None
    v = (np.arange(frame.depth.shape[0]) - frame.camera.K[1, 2]) / frame.camera.K[1, 1]
    slope = 1.0 + np.tan(np.deg2rad(amount)) * v[:, None]
    return replace(frame, depth=np.where(frame.label == 1, frame.depth, frame.depth * slope).astype(np.float32))


def occlusion(frame: Frame, amount: float) -> Frame:
    """Something near hides the left share of the object's pixels."""
    assert frame.depth is not None and frame.label is not None
    columns = np.flatnonzero((frame.label == 1).any(axis=0))
    before = np.cumsum((frame.label == 1).sum(axis=0)) <= amount * np.count_nonzero(frame.label == 1)
    band = np.zeros(frame.label.shape, bool)
    band[:, max(columns[0] - 20, 0) : columns[0] + int(before[columns[0] :].sum())] = amount > 0
    near = 0.7 * np.nanmin(frame.depth[frame.label == 1])
    rgb = np.where(band[..., None], np.uint8(90), frame.rgb)
    return replace(
        frame,
        rgb=rgb,
        depth=np.where(band, near, frame.depth).astype(np.float32),
        label=np.where(band, 2, frame.label).astype(np.int32),
    )


def noise_frame(frame: Frame, amount: float) -> Frame:
    """So large a share of the object's depths, drawn anew from all over its box: no shape at all at 1."""
    assert frame.depth is not None and frame.label is not None
    rng, mask = np.random.default_rng(4), frame.label == 1
    low, high = np.nanquantile(frame.depth[mask], (0.01, 0.99))
    drawn = rng.uniform(low, high + 0.05, mask.shape)
    lost = mask & (rng.random(mask.shape) < amount)
    rgb = np.where(lost[..., None], rng.integers(0, 256, frame.rgb.shape), frame.rgb).astype(np.uint8)
    return replace(frame, rgb=rgb, depth=np.where(lost, drawn, frame.depth).astype(np.float32))


@dataclass(frozen=True)
class Axis:
    """One thing that is made worse: by a fault of the frame, or by another configuration."""

    name: str
    amounts: tuple[float, ...]  # the first is how it ships
    fault: Callable[[Frame, float], Frame] | None = None
    configured: Callable[[ControllerConfig, float], ControllerConfig] | None = field(default=None, compare=False)
    harms: bool = True  # the last amount is expected to be worse than the first, or flagged


def _infer(name: str) -> Callable[[ControllerConfig, float], ControllerConfig]:
    def configured(config: ControllerConfig, amount: float) -> ControllerConfig:
        value: Any = type(getattr(config.infer, name))(getattr(config.infer, name) * amount)
        return replace(config, infer=replace(config.infer, **{name: value}))

    return configured


def _particles(config: ControllerConfig, amount: float) -> ControllerConfig:
    smc = config.infer.smc
    smc = replace(
        smc, particles=max(2, int(smc.particles * amount)), start_particles=max(2, int(smc.start_particles * amount))
    )
    return replace(config, infer=replace(config.infer, smc=smc))


def _rays(config: ControllerConfig, amount: float) -> ControllerConfig:
    o = config.observe
    colour, free, occluder = (max(1, int(n * amount)) for n in (o.colour_rays, o.free_rays, o.occluder_rays))
    return replace(config, observe=replace(o, colour_rays=colour, free_rays=free, occluder_rays=occluder))


AXES = (
    Axis("focal length, share", (0.0, 0.02, 0.05, 0.1, 0.2), intrinsics),
    Axis("depth scale, share", (0.0, 0.02, 0.05, 0.1, 0.2), depth_scale),
    Axis("depth noise, m", (0.0, 0.003, 0.01, 0.03), depth_noise),
    Axis("depth holes, share", (0.0, 0.3, 0.6, 0.9), holes, harms=False),
    Axis("flying pixels, px", (0.0, 2.0, 4.0, 8.0), flying),
    Axis("mask beside, px", (0.0, 3.0, 10.0, 30.0), mask_shift),
    Axis("plane tilted, degrees", (0.0, 1.0, 3.0, 10.0), plane_tilt),
    Axis("occluded, share", (0.0, 0.3, 0.6, 0.8, 0.95), occlusion),
    Axis("noise instead of shape, share", (0.0, 0.1, 0.3, 1.0), noise_frame),
    Axis("wall_sigma, times", (1.0, 0.3, 0.1), configured=_infer("wall_sigma")),
    Axis("wall_sigma too large, times", (1.0, 3.0, 10.0), configured=_infer("wall_sigma")),
    Axis("lattice, times", (1.0, 0.5, 0.25), configured=_infer("lattice")),
    Axis("pixels, times", (1.0, 0.5, 0.25, 0.125), configured=_rays),
    Axis("particles, times", (1.0, 0.33, 0.1, 0.05), configured=_particles),
)


@dataclass(frozen=True, eq=False)
class Seen:
    """One view's answer at one amount; without `values` perception refused it."""

    values: dict[str, float] | None
    flagged: bool
    broken: str = ""  # the exception, or which number was none
    p_free: Float[np.ndarray, "boxes"] = field(default_factory=lambda: np.zeros(0))
    occupied: Float[np.ndarray, "boxes"] = field(default_factory=lambda: np.zeros(0))


def look(
    picture: VesselPicture, axis: Axis, amount: float, prior: Prior, rate: Float[np.ndarray, "32 32 32"], seed: int
) -> Seen:
    """One view with one thing made worse by `amount`."""
    config = ControllerConfig()
    if axis.configured is not None:
        config = axis.configured(config, amount)
    fault = axis.fault
    try:
        view = vessel_view(picture, fault=None if fault is None else lambda frame: fault(frame, amount))
        found = estimate(view.frame, view.segment, prior, config, seed=seed, stages=240)
    except ValueError:  # a refusal, in words
        return Seen(None, True)
    except Exception as error:  # what must not be
        return Seen(None, False, f"{type(error).__name__}: {error}")
    h = found.hypotheses
    rng = np.random.default_rng([seed, view.seed, 31])
    scored = scored_voxels(view.seen, rate)
    if not scored.any():  # the cube is elsewhere
        return Seen(None, h.out_of_model)
    p = h.p_occupied
    answer = Answer(coarsen(h.solid, GRID), h.weights, found.seconds)
    if h.out_of_model:  # what a query answers: half the weight on "all that is unseen is occupied"
        seen = h.seen.reshape(GRID, 2, GRID, 2, GRID, 2)
        hidden = np.asarray(np.logical_not(seen.all(axis=(1, 3, 5))))
        shapes = np.concatenate([answer.shapes, hidden[np.newaxis]])
        answer = Answer(shapes, np.append((1 - CAUTION) * h.weights, CAUTION), found.seconds)
    judged = score(view, answer, rate, random_boxes(scored, BOXES, rng), rng)
    broken = "" if np.isfinite(p).all() and np.isfinite(judged.values["hidden_nll"]) else "not finite"
    return Seen(judged.values, h.out_of_model, broken, judged.p_free, judged.occupied)


def main(
    out: Path, quick: bool = False, prior: Path | None = None, n: int = 8, axes: str = "", seed: int = 0
) -> list[Row]:
    """What one fault at a time, or too small a model, does to answers about unseen space.

    Args:
        prior: weights to use; the shipped ones by default
        n: views
        axes: only those whose name begins with one of these, separated by semicolons
        seed: of the sampler
    """
    n = min(n, 1) if quick else n
    wanted = tuple(a.strip() for a in (axes or ("occluded" if quick else "")).split(";") if a.strip())
    chosen = [a for a in AXES if not wanted or a.name.startswith(wanted)]
    if not chosen:
        raise ValueError(f"no axis begins with {axes!r}; there are: {'; '.join(a.name for a in AXES)}")
    loaded, rate = load_prior(prior), base_rate(128 if quick else 1024)
    pictures: list[VesselPicture] = []
    for number in TEST_SEEDS[FIRST:]:
        if len(pictures) == n:
            break
        picture = any_view(number)
        try:
            vessel_view(picture)
            pictures.append(picture)
        except ValueError:  # refused without any fault
            continue
    shipped = [look(p, chosen[0], chosen[0].amounts[0], loaded, rate, seed) for p in pictures]
    found: dict[str, list[list[Seen]]] = {}
    for axis in chosen:
        found[axis.name] = [shipped]
        for amount in axis.amounts[1:]:
            found[axis.name].append([look(p, axis, amount, loaded, rate, seed) for p in pictures])
            say(f"{axis.name} {amount:g}: " + _line(found[axis.name][-1]))
    _draw(chosen, found, out / "stability.png")
    return _rows(chosen, found)


def _nll(seen: Sequence[Seen]) -> Float[np.ndarray, "n"]:
    return np.array([np.nan if s.values is None else s.values["hidden_nll"] for s in seen], np.float64)


def _falsely_free(seen: Sequence[Seen]) -> float:
    return falsely_free(np.concatenate([s.p_free for s in seen]), np.concatenate([s.occupied for s in seen]))


def _line(seen: Sequence[Seen]) -> str:
    flagged, broken = np.mean([s.flagged for s in seen]), [s.broken for s in seen if s.broken]
    return f"{interval(_nll(seen)).mean:.3f} nats, flagged {flagged:.2f}" + "".join(f"; BROKEN: {b}" for b in broken)


def _rows(axes: Sequence[Axis], found: dict[str, list[list[Seen]]]) -> list[Row]:
    rows, lines = [], []
    for axis in axes:
        first = found[axis.name][0]
        for amount, seen in zip(axis.amounts, found[axis.name], strict=True):
            gap = paired_interval(_nll(seen), _nll(first))
            values = {
                "hidden_nll": interval(_nll(seen)).mean,
                "hidden_nll_above_shipped": gap.mean,
                "flagged": float(np.mean([s.flagged for s in seen])),
                "falsely_free": _falsely_free(seen),
                "broken": float(np.mean([bool(s.broken) for s in seen])),
            }
            units = {"hidden_nll": "nats", "hidden_nll_above_shipped": "nats"}
            rows += [
                Row("stability", axis.name, f"{amount:g}", k, v, units.get(k, ""), len(seen)) for k, v in values.items()
            ]
            lines.append([axis.name, f"{amount:g}", *(f"{v:.3f}" for v in values.values())])
    table("One thing made worse", ("axis", "amount", "hidden_nll", "above", "flagged", "falsely_free", "broken"), lines)
    return rows


def _draw(axes: Sequence[Axis], found: dict[str, list[list[Seen]]], path: Path) -> None:
    columns = min(4, len(axes))
    figure = Figure(figsize=(4.0 * columns, 3.0 * -(-len(axes) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(axes) // columns), columns, squeeze=False)
    for ax in grid.ravel()[len(axes) :]:
        ax.set_axis_off()
    for ax, axis in zip(grid.ravel(), axes, strict=False):
        x = np.arange(len(axis.amounts))
        nll = np.array([_nll(seen) for seen in found[axis.name]])
        ax.plot(x, nll, color="0.8", linewidth=0.8)
        ax.plot(
            x,
            [np.nanmean(row) if np.isfinite(row).any() else np.nan for row in nll],
            "o-",
            color="tab:blue",
            label="hidden_nll, nats",
        )
        ax.plot(
            x,
            [np.mean([s.flagged for s in seen]) for seen in found[axis.name]],
            "s--",
            color="tab:red",
            label="flagged, share",
            ms=4,
        )
        ax.plot(
            x,
            [_falsely_free(seen) for seen in found[axis.name]],
            "^:",
            color="tab:orange",
            label="falsely free, share",
            ms=4,
        )
        ax.set_xticks(x, [f"{a:g}" for a in axis.amounts])
        ax.set(title=axis.name, ylim=(0, 1.6))
        ax.title.set_fontsize(9)
    grid[0, 0].legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
