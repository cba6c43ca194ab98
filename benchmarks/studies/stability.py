"""Where answers stop being reliable: one thing made worse at a time, until the method fails.

The same views throughout: objects of the test seeds from a random camera, as in `farside bench calibration`. Sensor
and calibration get faults of growing size, or the model gets less than it needs; everything else stays as shipped. For
each amount:

- hidden_nll: of what is truly unseen, over the views that were answered.
- flagged: share of answers with `out_of_model`, or that perception refuses with a message.
- falsely free: of the random unseen boxes with p_free > 0.95, the share that is occupied, and their number.
- broken: share of answers that ended with another exception or hold a number that is not finite. It must be 0.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from benchmarks.harness.intervals import Figures, gap_rows, interval
from benchmarks.harness.progress import say
from benchmarks.harness.results import Line, Results, digest, newest, objects_of, refuse_cut
from benchmarks.harness.rows import Row
from benchmarks.harness.study import PriorOptions, Summary, results_of, resumed
from benchmarks.harness.tables import Table, between, gated
from benchmarks.measures.metrics import falsely_free, scored_voxels
from benchmarks.measures.scores import BOXES, as_queried, random_boxes, score
from benchmarks.scenes.conditions import faultless_pictures
from benchmarks.scenes.faults import AXES, Axis
from benchmarks.scenes.vessels import VesselPicture, base_rate, vessel_view
from perception.inference.controller import Estimate, estimate
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker, Update
from probnerf.prior.checkpoint import Prior, load_prior

SHIPS = "as it ships"
METHOD = "tempered_smc"
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


@dataclass(frozen=True)
class Options(PriorOptions):
    """What one fault at a time, or too small a model, does to answers about unseen space."""

    n: int = 8
    """Views."""
    axes: str = ""
    """Only those whose name begins with one of these, separated by semicolons."""
    seeds: int = 2
    """Of the sampler, for each view: seed, seed + 1, ..."""

    @property
    def chosen(self) -> list[Axis]:
        """The axes that are asked for. Raises ValueError where there is none."""
        wanted = tuple(a.strip() for a in self.axes.split(";") if a.strip())
        chosen = [a for a in AXES if not wanted or a.name.startswith(wanted)]
        if not chosen:
            raise ValueError(f"no axis begins with {self.axes!r}; there are: {'; '.join(a.name for a in AXES)}")
        return chosen


def main(options: Options) -> Summary:
    """Measure what the file lacks, and sum up what it has."""
    if options.quick:
        options = replace(options, n=1, seeds=1, axes=options.axes or "occluded")
    _ = options.chosen  # a mistyped name is refused before anything is loaded
    prior, results = load_prior(options.prior), results_of("stability", options)
    return resumed(
        results,
        options,
        lambda: _measure(options, prior, results),
        lambda: summary(newest(results.lines, prior.identity), options),
    )


def _condition(axis: Axis, amount: float) -> str:
    return SHIPS if amount == axis.amounts[0] else f"{axis.name} {amount:g}"


def _measure(options: Options, prior: Prior, results: Results) -> None:
    settings = {"digest": digest(asdict(ControllerConfig()), options.quick)}
    same = {"prior": prior.identity, "method": METHOD, "settings": settings}
    rate, views = base_rate(128 if options.quick else 1024), faultless_pictures(options.n)
    for axis in options.chosen:
        for amount in axis.amounts:
            for seed in range(options.seed, options.seed + options.seeds):
                for picture in views:
                    own = {"condition": _condition(axis, amount), "object": picture.placed.seed, "seed": seed}
                    if {**same, **own} not in results:
                        seen = look(picture, axis, amount, prior, rate, seed)
                        results.add({**same, **own, **asdict(seen)})
                        say(f"{axis.name} {amount:g}, {picture.placed.seed}: {_line(seen)}")


def _line(seen: Seen) -> str:
    nll = "no answer" if seen.hidden_nll is None else f"{seen.hidden_nll:.3f} nats"
    return f"{nll}{', flagged' * seen.flagged}" + f"; BROKEN: {seen.broken}" * bool(seen.broken)


def _seen(line: Line) -> Seen:
    values = {f.name: line[f.name] for f in fields(Seen)}
    return Seen(**{**values, "p_free": tuple(values["p_free"]), "occupied": tuple(map(bool, values["occupied"]))})


def summary(lines: list[Line], options: Options) -> Summary | None:
    """Figures of the axes of which every amount was answered for the first `n` views; None where there is none.

    Of those seeds that have rows.
    """
    known = {line["seed"] for line in lines}
    seeds = [seed for seed in range(options.seed, options.seed + options.seeds) if seed in known]
    views = objects_of([line for line in lines if line["condition"] == SHIPS])[: options.n]
    by = {(line["condition"], line["object"], line["seed"]): _seen(line) for line in lines}
    pairs = [(view, seed) for seed in seeds for view in views]
    found: dict[str, list[list[Seen]]] = {}  # of each amount, seed by seed
    for axis in options.chosen:
        keys = [[(_condition(axis, amount), *each) for each in pairs] for amount in axis.amounts]
        if len(views) == options.n and all(k in by for amount in keys for k in amount):
            found[axis.name] = [[by[k] for k in amount] for amount in keys]
    if not found:
        return None
    axes = [axis for axis in options.chosen if axis.name in found]
    rows = _rows(axes, found, options.n)
    return Summary(rows, _tables(axes, Figures(rows)), lambda: _draw(axes, found, options.n))


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


def _rows(axes: Sequence[Axis], found: dict[str, list[list[Seen]]], n: int) -> list[Row]:
    rows = []
    for axis in axes:
        first = found[axis.name][0]
        for amount, seen in zip(axis.amounts, found[axis.name], strict=True):
            of = (axis.name, f"{amount:g}")
            nll, shipped = _by_view(seen, n), _by_view(first, n)
            gaps = gap_rows("stability", *of, "hidden_nll_above_shipped", nll, shipped)
            mean = interval(nll).mean
            rows += [Row("stability", *of, "hidden_nll", mean, "nats", gaps[0].n), *gaps]
            shares = {
                "flagged": float(np.mean([s.flagged for s in seen])),
                "falsely_free": _falsely_free(seen),
                "called_free": float(sum(p > 0.95 for s in seen for p in s.p_free)),
                "broken": float(np.mean([bool(s.broken) for s in seen])),
            }
            rows += [Row("stability", *of, k, v, "", len(seen)) for k, v in shares.items()]
            if len(seen) > n:
                rows.append(Row("stability", *of, "between_seeds", _between_seeds(seen, n), "nats", gaps[0].n))
    return rows


def _tables(axes: Sequence[Axis], of: Figures) -> list[Table]:
    lines = []
    for axis in axes:
        for amount in axis.amounts:
            c, m = f"{amount:g}", axis.name
            gap, broken = of.interval(c, m, "hidden_nll_above_shipped"), of(c, m, "broken")
            above = f"{gap.mean:+.3f} ({between(gap, sign='+')})" if amount != axis.amounts[0] else ""
            lines.append([
                axis.name, c, f"{of(c, m, 'hidden_nll'):.3f}", above, f"{of(c, m, 'flagged'):.2f}",
                f"{of(c, m, 'falsely_free'):.3f} of {of(c, m, 'called_free'):.0f}",
                f"{of(c, m, 'between_seeds'):.3f}" if (c, m, "between_seeds") in of else "",
                gated(f"{broken:.3f}", broken, most=0.0),
            ])  # fmt: skip
    header = (
        "axis", "amount", "hidden_nll, nats", "above as it ships, paired over views", "flagged",
        "occupied, of boxes called free", "between seeds, nats", "broken, gate 0",
    )  # fmt: skip
    return [Table(f"One thing made worse: {len(axes)} axes", header, lines)]


def _draw(axes: Sequence[Axis], found: dict[str, list[list[Seen]]], n: int) -> Figure:
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
    return figure
