"""Train a rival for a given time: `python -m benchmarks.rivals.train --model functa --data FILE --out FOLDER`.

It writes FOLDER/NAME.safetensors (every 30 s, too), NAME.history.jsonl and NAME.png. The time includes reading and
compiling; examining what was learnt takes some seconds more.
"""

import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from benchmarks.harness.command import command
from benchmarks.harness.machine import machine, revision
from benchmarks.rivals.health import examine, write_png
from benchmarks.rivals.model import save_rival
from benchmarks.rivals.picture_set import PictureSet, load_pictures
from benchmarks.rivals.recipe import Metrics, Phase, State
from benchmarks.rivals.registry import RIVALS, Entry, Sizes
from benchmarks.rivals.volume import Box, Pictures, frames_and_box

DISPATCH = 1.0  # s that steps run without returning to Python
REPORT = 4.0  # s between rows of the history
CHECKPOINT = 30.0  # s between files of the weights
HALVED = 16  # px; sides of pictures are multiples of it for encoders that halve them four times
HELD_OUT = 0.02  # of the objects: the last ones, examined and never trained on


@dataclass(frozen=True)
class Options:
    """Train a rival."""

    model: str
    """Its name."""
    data: Path
    """Pictures, as `benchmarks.rivals.pictures` writes them."""
    out: Path
    """Folder of the files that are written."""
    seconds: float = 170.0
    """Of training, with reading the pictures and compiling."""
    seed: int = 0
    """Of weights and batches."""
    sizes: Sizes = "own"
    """small: for one CPU core; tiny: for tests."""


class Run:
    """A run's clock, its history, and its weights on disk."""

    def __init__(self, options: Options):
        self._begun = time.monotonic()
        self._options = options
        self.story: dict[str, Any] = {"seed": options.seed, "sizes": options.sizes, "data": options.data.name}
        self.story |= {"machine": machine(), "device": jax.devices()[0].device_kind, "revision": revision()}
        options.out.mkdir(parents=True, exist_ok=True)
        self._history = options.out / f"{options.model}.history.jsonl"
        self._history.write_text("")
        self._sums: defaultdict[str, float] = defaultdict(float)
        self._summed = 0
        self._reported = self._saved = 0.0
        self.steps: dict[str, int] = {}  # of each phase

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._begun

    def write(self, row: dict[str, Any]) -> None:
        """Add a row to the history, and print it."""
        line = json.dumps({"seconds": round(self.seconds, 1), **row})
        print(line, flush=True)
        with self._history.open("a") as file:
            file.write(line + "\n")

    def report(self, metrics: Metrics, steps: int, row: dict[str, Any], last: bool) -> None:
        """Add sums over some steps; a row of means follows when it is time, or at the last of a phase."""
        for name, value in metrics.items():
            self._sums[name] += float(value)
        self._summed += steps
        if last or self.seconds - self._reported > REPORT:
            means = {name: float(f"{value / self._summed:.5g}") for name, value in self._sums.items()}
            self.write({**row, **means, "steps_per_second": round(self._summed / (self.seconds - self._reported), 1)})
            self._sums.clear()
            self._summed, self._reported = 0, self.seconds

    def save(self, model: Any, finished: bool = False, **figures: float) -> None:
        """Write the weights, if the last were written some time ago, or if these are the final ones."""
        if finished or self.seconds - self._saved > CHECKPOINT:
            story = self.story | {"seconds": round(self.seconds, 1), "steps": self.steps, "finished": finished}
            name = self._options.model
            save_rival(self._options.out / f"{name}.safetensors", name, model, story | figures)
            self._saved = self.seconds


def split(given: PictureSet) -> tuple[PictureSet, PictureSet]:
    """The objects to learn, and those held out."""
    count = max(2, round(HELD_OUT * len(given.seed)))
    parts = slice(None, -count), slice(-count, None)
    names = [f.name for f in fields(given) if getattr(given, f.name).ndim]
    learnt, new = (replace(given, **{name: getattr(given, name)[part] for name in names}) for part in parts)
    return learnt, new


def on_device(given: PictureSet) -> tuple[Pictures, Box]:
    """Pictures to draw batches from, and a box about what they show."""
    frame, box = frames_and_box(given.range, given.T_object_camera, float(given.tan_half_fov))
    arrays = (given.rgb, given.T_object_camera, given.tan_half_fov, frame)
    return Pictures(*(jnp.asarray(array) for array in arrays)), box


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def advance(
    phase: Phase, state: State, pictures: Pictures, progress: Array, key: PRNGKeyArray, steps: Int[Array, ""]
) -> tuple[State, Metrics]:
    """The state after some steps, and the sums of their metrics."""

    def one(i, carry):
        state, sums = carry
        state, metrics = phase.step(state, pictures, progress, jax.random.fold_in(key, i))
        return state, jax.tree.map(lambda total, value: total + value.astype(jnp.float32), sums, metrics)

    _, shapes = jax.eval_shape(phase.step, state, pictures, progress, key)
    return jax.lax.fori_loop(0, steps, one, (state, jax.tree.map(lambda _: jnp.zeros(()), shapes)))


class Programs(NamedTuple):
    """What a phase runs, compiled."""

    prepare: Callable[[State, Pictures], State]
    advance: Callable[[State, Pictures, Array, PRNGKeyArray, Array], tuple[State, Metrics]]


def compiled(phases: Sequence[Phase], state: State, pictures: Pictures, pool: Executor) -> list[Future[Programs]]:
    """Programs of all phases, one after the other: later ones are compiled while earlier ones run."""

    def compile_phase(phase: Phase, before: State, after: State) -> Programs:
        prepare = jax.jit(phase.prepare, donate_argnums=0).lower(before, pictures).compile()
        given = (after, pictures, jnp.zeros(()), jax.random.key(0), jnp.array(1))
        return Programs(prepare, advance.lower(phase, *given).compile())

    programs, before = [], jax.eval_shape(lambda: state)
    for phase in phases:
        after = jax.eval_shape(phase.prepare, before, pictures)
        programs.append(pool.submit(compile_phase, phase, before, after))
        before = after
    return programs


def train_phase(
    phase: Phase, programs: Programs, state: State, pictures: Pictures, key: PRNGKeyArray, run: Run, end: float
) -> Iterator[State]:
    """States until the run's seconds reach `end`."""
    state = jax.block_until_ready(programs.prepare(state, pictures))
    begun, steps, count, dispatches = run.seconds, 0, 1, 0
    run.write({"phase": phase.name, "begins": True})
    while steps == 0 or run.seconds < end:
        before = run.seconds
        progress = min((before - begun) / max(end - begun, 1e-3), 1.0)
        keys = jax.random.fold_in(key, dispatches)
        state, sums = programs.advance(state, pictures, jnp.array(progress), keys, jnp.array(count))
        sums = jax.device_get(sums)  # waits for the steps
        steps, dispatches = steps + count, dispatches + 1
        run.steps[phase.name] = steps
        left = end - run.seconds
        run.report(sums, count, {"phase": phase.name, "steps": steps, "progress": round(progress, 3)}, left <= 0)
        count = max(1, min(int(count * min(DISPATCH, left) / (run.seconds - before)), 8 * count))
        yield state


def sizes_of(entry: Entry, which: Sizes, size: int) -> dict[str, Any]:
    """Sizes that differ from the config's own, for pictures of so many pixels a side."""
    own = {"size": size} if "size" in {f.name for f in fields(entry.config)} else {}  # type: ignore[arg-type]
    return entry.sizes(which) | own


def main(options: Options) -> Path:
    """Train, examine, and write; the path of the weights. Raises ValueError if there is no rival of this name."""
    if options.model not in RIVALS:
        raise ValueError(f"there is no rival '{options.model}'; choose one of {', '.join(RIVALS)}")
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # others train beside it
    entry, given = RIVALS[options.model], load_pictures(options.data)
    if given.rgb.shape[1] < 3:
        raise ValueError(f"{options.data} has {given.rgb.shape[1]} views of each object; 3 or more are examined")
    if options.model in ("pixel_nerf", "nerf_vae") and given.rgb.shape[2] % HALVED:
        raise ValueError(
            f"{options.data} has pictures of {given.rgb.shape[2]} px; {options.model} halves them four times: draw them"
            f" with --size {-(-given.rgb.shape[2] // HALVED) * HALVED}"
        )
    run = Run(options)
    learnt, new = split(given)
    objects, views, size = learnt.rgb.shape[:3]
    run.story |= {"family": str(given.family), "objects": objects, "views": views, "size": size}
    pictures, box = on_device(learnt)
    config = entry.config(box=box, tan_half_fov=float(learnt.tan_half_fov), **sizes_of(entry, options.sizes, size))
    recipe = entry.recipe(config)
    k0, *keys = jax.random.split(jax.random.key(options.seed), 1 + len(recipe.phases))
    state = recipe.start(k0)  # not compiled: that takes longer than to draw once
    with ThreadPoolExecutor(1) as pool:
        programs = compiled(recipe.phases, state, pictures, pool)
        programs[0].result()
        end, time_left = run.seconds, options.seconds - run.seconds
        for phase, program, key in zip(recipe.phases, programs, keys, strict=True):
            end += phase.share * time_left
            for reached in train_phase(phase, program.result(), state, pictures, key, run, end):
                run.save(recipe.model(reached))
            state = reached
    model = recipe.model(state)
    run.save(model, finished=True)
    figures, picture = examine(recipe.quick(model), learnt, new)
    write_png(options.out / f"{options.model}.png", picture)
    run.write(figures)
    run.save(model, finished=True, **figures)
    return options.out / f"{options.model}.safetensors"


if __name__ == "__main__":
    command(main, Options)
