"""Where answers stop meaning what they say: one thing made worse at a time, until the method fails.

The same views throughout: objects of the test seeds as they come, from a random camera (`farside bench calibration`).
Sensor and calibration are spoilt by growing amounts, or the model is given too little, and everything else is left as
it ships. At every amount: hidden_nll of what is truly unseen, over the views that were answered; flagged: share of
answers that say `out_of_model`, or that perception refuses in words; called_free: how many random unseen boxes are
given p_free > 0.95; falsely_free: the share of those that is occupied. An exception other than a refusal, or a number
that is none, counts as broken: there must be none.

Answers are appended to a file as they come, and what is there is not made again.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import interval, paired_interval
from benchmarks.harness.progress import say, table
from benchmarks.harness.results import FOLDER, Line, append_line, digest, key, read_lines, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.measures.metrics import falsely_free, scored_voxels
from benchmarks.measures.scores import BOXES, as_queried, random_boxes, score
from benchmarks.scenes.conditions import faultless_pictures
from benchmarks.scenes.faults import AXES, Axis
from benchmarks.scenes.vessels import VesselPicture, base_rate, vessel_view
from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker, Update
from probnerf.prior.checkpoint import Prior, load_prior

RESULTS = FOLDER / "stability.jsonl"
SHIPS = "as it ships"
STAGES = 240  # at most, an answer


@dataclass(frozen=True)
class Seen:
    """One view's answer at one amount."""

    hidden_nll: float | None  # None: perception refused, or broke
    flagged: bool
    refused: str = ""  # why, in perception's words
    broken: str = ""  # the exception, or which number was none
    p_free: tuple[float, ...] = ()  # of each box
    occupied: tuple[bool, ...] = ()  # truly


def look(
    picture: VesselPicture, axis: Axis, amount: float, prior: Prior, rate: Float[np.ndarray, "32 32 32"], seed: int
) -> Seen:
    """One view with one thing made worse by `amount`."""
    config = ControllerConfig()
    if axis.configured is not None:
        config = axis.configured(config, amount)
    fault = axis.fault
    found: Estimate | Update
    try:
        view = vessel_view(picture, fault=None if fault is None else lambda frame: fault(frame, amount))
        if axis.repeated:
            tracker = Tracker(prior, config, seed=seed)
            found = [tracker.update(view.frame, view.segment, stages=STAGES) for _ in range(round(amount))][-1]
        else:
            found = estimate(view.frame, view.segment, prior, config, seed=seed, stages=STAGES)
    except Exception as error:
        if type(error) is ValueError:  # in words, which the file keeps; NumPy's own are of a class of their own, mostly
            return Seen(None, True, refused=str(error))
        return Seen(None, False, broken=f"{type(error).__name__}: {error}")  # what must not be
    h = found.hypotheses
    refuse_cut(h.result)
    rng = np.random.default_rng([seed, view.seed, 31])
    scored = scored_voxels(view.seen, rate)
    if not scored.any():  # the cube is elsewhere
        return Seen(None, h.out_of_model)
    p = h.p_occupied
    judged = score(view, as_queried(h, found.seconds), rate, random_boxes(scored, BOXES, rng), rng)
    nll = judged.values["hidden_nll"]
    if not (np.isfinite(p).all() and np.isfinite(nll)):
        return Seen(None, h.out_of_model, broken="not finite")
    return Seen(nll, h.out_of_model, p_free=tuple(judged.p_free.tolist()), occupied=tuple(judged.occupied.tolist()))


def main(
    out: Path,
    quick: bool = False,
    prior: Path | None = None,
    n: int = 8,
    axes: str = "",
    seeds: int = 2,
    results: Path = RESULTS,
    only_chart: bool = False,
) -> list[Row]:
    """What one fault at a time, or too small a model, does to answers about unseen space.

    Args:
        prior: weights to use; the shipped ones by default
        n: views
        axes: only those whose name begins with one of these, separated by semicolons
        seeds: of the sampler, for each view
        results: file that answers are appended to, and read from
        only_chart: draw what the file holds
    """
    if quick:
        n, seeds, axes = 1, 1, axes or "occluded"
        results = out / "stability.jsonl" if results == RESULTS else results
    wanted = tuple(a.strip() for a in axes.split(";") if a.strip())
    chosen = [a for a in AXES if not wanted or a.name.startswith(wanted)]
    if not chosen:
        raise ValueError(f"no axis begins with {axes!r}; there are: {'; '.join(a.name for a in AXES)}")
    loaded, rate = load_prior(prior), base_rate(128 if quick else 1024)
    settings = {"digest": digest(asdict(ControllerConfig()), quick)}
    lines = read_lines(results)
    kept = [line["settings"] for line in lines if line["prior"] == loaded.hash]
    if only_chart and kept:  # the newest ones, which may be of other settings than today's
        settings = kept[-1]
    same = {"prior": loaded.hash, "method": "tempered_smc", "settings": settings}
    done = {key(line): line for line in lines}

    def answered(picture: VesselPicture, axis: Axis, amount: float, seed: int) -> Seen | None:
        """From the file, or made and kept there; None where it may only be read."""
        ships = amount == axis.amounts[0]
        condition = SHIPS if ships else f"{axis.name} {amount:g}"
        line: Line = {**same, "condition": condition, "object": picture.placed.seed, "seed": seed}
        if key(line) not in done:
            if only_chart:
                return None
            line |= {"seen": asdict(look(picture, axis, amount, loaded, rate, seed))}
            append_line(results, line)
            done[key(line)] = line
        seen = done[key(line)]["seen"]
        return Seen(**{**seen, "p_free": tuple(seen["p_free"]), "occupied": tuple(seen["occupied"])})

    views = faultless_pictures(n)
    asked = [(seed, p) for seed in range(seeds) for p in views]
    found: dict[str, list[list[Seen]]] = {}  # of each amount, seed by seed
    for axis in chosen:
        made = []
        for amount in axis.amounts:
            made.append([s for seed, p in asked if (s := answered(p, axis, amount, seed)) is not None])
            if made[-1]:
                say(f"{axis.name} {amount:g}: " + _line(made[-1]))
        if all(len(seen) == len(asked) for seen in made):
            found[axis.name] = made
    if not found:
        raise ValueError(f"{results} has not every amount of any of these axes for {n} views; leave --only-chart")
    shown = [axis for axis in chosen if axis.name in found]
    _draw(shown, found, n, out / "stability.png")
    return _rows(shown, found, n)


def _nll(seen: Sequence[Seen]) -> Float[np.ndarray, "seeds_n"]:
    return np.array([np.nan if s.hidden_nll is None else s.hidden_nll for s in seen], np.float64)


def _by_view(seen: Sequence[Seen], n: int) -> Float[np.ndarray, "n"]:
    """Means over seeds; NaN where a view was never answered."""
    answered = np.ma.masked_invalid(_nll(seen).reshape(-1, n))
    return np.ma.filled(answered.mean(axis=0), np.nan)


def _between_seeds(seen: Sequence[Seen], n: int) -> float:
    """Standard deviation of a view's score over seeds, root mean square over views."""
    nll = np.ma.masked_invalid(_nll(seen).reshape(-1, n))
    return float(np.ma.filled(np.sqrt(nll.var(axis=0, ddof=1).mean()), np.nan))


def _falsely_free(seen: Sequence[Seen]) -> float:
    p_free, occupied = (
        np.concatenate([np.asarray(a) for a in of]) for of in zip(*((s.p_free, s.occupied) for s in seen), strict=True)
    )
    return falsely_free(p_free, occupied.astype(bool))


def _line(seen: Sequence[Seen]) -> str:
    flagged, broken = np.mean([s.flagged for s in seen]), [s.broken for s in seen if s.broken]
    return f"{interval(_nll(seen)).mean:.3f} nats, flagged {flagged:.2f}" + "".join(f"; BROKEN: {b}" for b in broken)


def _rows(axes: Sequence[Axis], found: dict[str, list[list[Seen]]], n: int) -> list[Row]:
    rows, lines = [], []
    for axis in axes:
        first = found[axis.name][0]
        for amount, seen in zip(axis.amounts, found[axis.name], strict=True):
            gap = paired_interval(_by_view(seen, n), _by_view(first, n))
            values = {
                "hidden_nll": interval(_by_view(seen, n)).mean,
                "hidden_nll_above_shipped": gap.mean,
                "hidden_nll_above_shipped_q025": gap.low,
                "hidden_nll_above_shipped_q975": gap.high,
                "flagged": float(np.mean([s.flagged for s in seen])),
                "falsely_free": _falsely_free(seen),
                "called_free": float(sum(p > 0.95 for s in seen for p in s.p_free)),
                "broken": float(np.mean([bool(s.broken) for s in seen])),
            }
            if len(seen) > n:
                values["between_seeds"] = _between_seeds(seen, n)
            nats = {k for k in values if k.startswith("hidden_nll") or k == "between_seeds"}
            rows += [
                Row(
                    "stability", axis.name, f"{amount:g}", k, v, "nats" * (k in nats), gap.n if k in nats else len(seen)
                )
                for k, v in values.items()
            ]
            lines.append([axis.name, f"{amount:g}", *(f"{v:.3f}" for v in values.values())])
    short = (
        name.replace("hidden_nll_above_shipped_", "").replace("hidden_nll_above_shipped", "above") for name in values
    )
    table("One thing made worse (above: how it ships, paired over views)", ("axis", "amount", *short), lines)
    return rows


def _draw(axes: Sequence[Axis], found: dict[str, list[list[Seen]]], n: int, path: Path) -> None:
    columns = min(4, len(axes))
    figure = Figure(figsize=(4.0 * columns, 3.0 * -(-len(axes) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(axes) // columns), columns, squeeze=False)
    for ax in grid.ravel()[len(axes) :]:
        ax.set_axis_off()
    for ax, axis in zip(grid.ravel(), axes, strict=False):
        x = np.arange(len(axis.amounts))
        nll = np.array([_by_view(seen, n) for seen in found[axis.name]])
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
