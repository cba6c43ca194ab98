"""Seeded answers of two revisions on one machine: `write` them before a change, `check` them after it.

    python -m benchmarks.golden write        # before the change
    python -m benchmarks.golden check        # after it: every array of every answer must be the same, bit for bit
    python -m benchmarks.golden check --views 20   # after a change of rounding: p_occupied within its Monte Carlo error

No time limit enters, so an answer is a function of the code, the prior and the seed. Processors round differently: the
answers of another machine are no reference.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from perception.answers.hypotheses import Hypotheses
from perception.answers.hypotheses_file import load, save
from perception.inference.controller import estimate
from perception.inference.settings import ControllerConfig
from perception.inference.tracker import Tracker
from perception.observation.segmentation import segment
from perception.simulation.sample_recording import CAMERA, SCENE, SENSOR
from perception.simulation.sensor_faults import sense
from perception.simulation.simulated_camera import PlacedObject, TableScene, place_camera, render
from perception.sources.frame import Frame
from perception.sources.open_source import open_source
from probnerf.prior.checkpoint import Prior, load_prior

FIRST_VALIDATION_SEED = 1_003_500  # objects of the family that no prior was trained on and no figure is scored on


@dataclass(frozen=True)
class Golden:
    """Write or check seeded answers."""

    action: tyro.conf.Positional[str]
    """write or check."""
    folder: Path = Path("out/golden")
    """Where the answers lie."""
    views: int = 0
    """Also so many single validation objects, compared by p_occupied alone."""


def frame_from(position: tuple[float, float, float], scene: TableScene = SCENE) -> Frame:
    """A simulated frame with depth, true labels and the camera's pose; the camera looks at the scene's middle."""
    T_world_camera = place_camera(position, (0.0, 0.01, 0.03))
    return sense(render(scene, CAMERA, T_world_camera), CAMERA, T_world_camera, seed=0, config=SENSOR)


def shipped(prior: Prior) -> Iterator[tuple[str, Hypotheses]]:
    """Both objects of the recording that ships with the project, to convergence."""
    frame = next(iter(open_source(None)))
    for found in segment(frame):
        yield f"shipped_{found.id}", estimate(frame, found, prior, seed=0).hypotheses


def annealed(prior: Prior) -> Iterator[tuple[str, Hypotheses]]:
    """The paper's sampler, cut after a few iterations."""
    frame, config = next(iter(open_source(None))), ControllerConfig()
    config = replace(config, infer=replace(config.infer, method="annealed_hmc"))
    yield "annealed_hmc", estimate(frame, segment(frame)[0], prior, config, seed=1, stages=3).hypotheses


def colour_only(prior: Prior) -> Iterator[tuple[str, Hypotheses]]:
    """Without depth, on the plane that the camera's pose gives."""
    frame = replace(frame_from((0.46, 0.0, 0.29)), depth=None)
    yield "colour_only", estimate(frame, segment(frame, 2)[0], prior, seed=2, stages=6).hypotheses


def two_views(prior: Prior) -> Iterator[tuple[str, Hypotheses]]:
    """One object seen from the front and then from the side, by the tracker."""
    tracker = Tracker(prior, seed=3)
    for i, position in enumerate([(0.46, 0.0, 0.29), (0.05, 0.46, 0.29)]):
        frame = frame_from(position)
        yield f"view_{i}", tracker.update(frame, segment(frame, 1)[0], stages=4).hypotheses


def validation(prior: Prior, count: int) -> Iterator[tuple[str, Hypotheses]]:
    """Single objects of the family from one side each."""
    for i in range(count):
        rng = np.random.default_rng([FIRST_VALIDATION_SEED, i])
        angle, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 0.5)
        placed = PlacedObject(FIRST_VALIDATION_SEED + i, 0.0, 0.0, float(rng.uniform(0, 2 * np.pi)))
        frame = frame_from((0.55 * np.cos(angle), 0.55 * np.sin(angle), height), TableScene((placed,)))
        try:
            found = segment(frame, 1)[0]
        except ValueError as error:
            print(f"validation_{i}: {error}", file=sys.stderr)
            continue
        yield f"validation_{i}", estimate(frame, found, prior, seed=i, stages=12).hypotheses


CASES: tuple[Callable[[Prior], Iterator[tuple[str, Hypotheses]]], ...] = (shipped, annealed, colour_only, two_views)


def differences(old: Path, new: Path) -> list[str]:
    """What of two hypotheses files is not the same: arrays bit for bit, header fields that both have."""
    found = []
    with np.load(old) as a, np.load(new) as b:
        for name in sorted({*a.files, *b.files} - {"header"}):
            if name not in a.files or name not in b.files:
                found.append(f"{name} is in one file only")
            elif a[name].dtype != b[name].dtype or not np.array_equal(a[name], b[name], equal_nan=name == "pose"):
                found.append(f"{name} differs")
        headers = [json.loads(bytes(f["header"])) for f in (a, b)]
    flat = [{**h, **h.get("diagnostics", {})} for h in headers]
    for name in sorted((flat[0].keys() & flat[1].keys()) - {"diagnostics", "format"}):
        x, y = flat[0][name], flat[1][name]
        if x != y and not (x != x and y != y):  # NaN is the same as NaN
            found.append(f"{name}: {x} was, {y} is")
    return found


def shift(old: Hypotheses, new: Hypotheses) -> tuple[float, float]:
    """|difference| of the mean p_occupied in unseen space above the plane, and the standard error of that."""
    hidden = old.unseen & new.unseen
    moved = abs(float(old.p_occupied[hidden].mean() - new.p_occupied[hidden].mean()))
    return moved, float(np.hypot(old.monte_carlo_error, new.monte_carlo_error))


def main(options: Golden) -> int:
    """0 where all is the same (or written)."""
    prior, failed = load_prior(), 0
    scratch = options.folder if options.action == "write" else options.folder / "new"
    moved = []
    for case in (*CASES, lambda p: validation(p, options.views)):
        begun = time.monotonic()
        for name, answer in case(prior):
            save(scratch / f"{name}.npz", answer)
            seconds, begun = time.monotonic() - begun, time.monotonic()
            if options.action == "write":
                print(f"{name}: written ({seconds:.0f} s)", flush=True)
            elif name.startswith("validation"):
                by, error = shift(load(options.folder / f"{name}.npz"), answer)
                moved.append((by, error))
                print(f"{name}: p_occupied moved by {by:.4f}, its Monte Carlo error is {error:.4f}", flush=True)
            else:
                found = differences(options.folder / f"{name}.npz", scratch / f"{name}.npz")
                failed += bool(found)
                print(f"{name}: {'; '.join(found) or 'the same'} ({seconds:.0f} s)", flush=True)
    if moved:
        by, error = (float(np.sqrt(np.mean(np.square(column)))) for column in zip(*moved, strict=True))
        failed += by > error
        print(f"{len(moved)} validation views: rms move {by:.4f}, rms Monte Carlo error {error:.4f}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Golden)))
