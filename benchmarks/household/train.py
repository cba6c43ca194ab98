"""Make a household prior and its network on one accelerator, by the clock: `python -m benchmarks.household.train`.

Three stages overlap. All processes make objects, their shapes and plain pictures. Then the prior learns the shapes,
while the processes draw scenes as perception sees them. Then the network learns the pictures. Each stage ends at its
time, and learning rates follow the clock: a recipe's `steps` are nominal, more than there is time for, and before each
call the count of steps is set to the share of the time that is over. So all is compiled before the data are there.
"""

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from benchmarks.household.latents import told_pictures
from benchmarks.household.objects import BLOCK, EACH, SIZE, Job, Made, draw_scenes, make
from foundation.worker_pool import worker_pool
from perception.simulation.training_pictures import PicturePart
from probnerf.likelihood.settings import Likelihood
from probnerf.prior.checkpoint import load_prior, save_posterior_network, save_prior, save_recognition
from probnerf.prior.networks import PRESETS, ProbNeRF
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork
from probnerf.rendering import foam
from probnerf.training import elbo, posterior_flow
from probnerf.training.on_device import (
    DevicePictures,
    DeviceShapes,
    pictures_on_device,
    shapes_on_device,
    train_pictures,
    train_solids,
)
from probnerf.training.settings import PosteriorTrainConfig, TrainConfig
from probnerf.training.shape_set import ShapeSet, joined, load_shapes

S = TypeVar("S", elbo.TrainState, posterior_flow.PosteriorTrainState)
CALL = 100  # steps of a call


@dataclass(frozen=True)
class Options:
    """Train the household prior and its network against the clock."""

    meshes: Path
    """Folder of household meshes (metres)."""
    infinigen: Path | None = None
    """Folder of the objects of `probnerf/training/infinigen`."""
    out: Path = Path("runs/household")
    """Folder of the weights and histories."""
    work: Path = Path("runs/household/work")
    """Folder of shapes and pictures."""
    processes: int = 16
    """That make objects and pictures."""
    preset: str = "everyday"
    """Sizes of the prior."""
    objects_until: float = 220.0
    """Seconds from the start at which the prior begins."""
    prior_until: float = 450.0
    """Seconds at which the network begins."""
    network_until: float = 700.0
    """Seconds at which all is written."""
    counts: tuple[int, int, int, int] = (6400, 4200, 5000, 6144)
    """Objects at most: of the household generator, variants of the meshes and of Infinigen's, tabletop objects."""
    shares: tuple[float, float, float, float] = (0.36, 0.26, 0.22, 0.16)
    """Of each in a batch of the prior's."""
    pictures: int = 180_000
    """Pictures that the network is compiled for."""
    prior: TrainConfig = field(
        default_factory=lambda: TrainConfig(
            steps=200_000,
            solid_steps=200_000,
            batch=512,
            points=512,
            colours=64,
            learning_rate=1.5e-3,
            final_learning_rate=1e-5,
            warmup=3000,
            level=0.35,
            kl_warmup=10_000,
            map_batch=512,
        )
    )
    network: PosteriorTrainConfig = field(
        default_factory=lambda: PosteriorTrainConfig(steps=200_000, batch=512, warmup=3000, validation=0.03)
    )


class Clock:
    """Seconds since the start."""

    def __init__(self) -> None:
        self.start = time.monotonic()

    def __call__(self) -> float:
        return time.monotonic() - self.start


def jobs_of(options: Options) -> list[Job]:
    """All jobs, mixed so that any first part of them has all families in their shares."""
    folders = (None, options.meshes, options.infinigen, None)
    names, sizes = ("household", "meshes", "infinigen", "tabletop"), (EACH, EACH, EACH, BLOCK)
    jobs: list[tuple[float, Job]] = []
    for name, folder, count, size in zip(names, folders, options.counts, sizes, strict=True):
        if name == "infinigen" and folder is None:
            continue
        starts = range(0, count, size)
        jobs += [((k + 0.5) / len(starts), Job(name, folder, first, size)) for k, first in enumerate(starts)]
    return [job for _, job in sorted(jobs, key=lambda pair: pair[0])]


def at_step(state: S, step: int) -> S:
    """The state with its count of steps, and those of its optimiser, set."""

    def told(leaf: Any) -> Any:
        """An optimiser's counts of steps are its only integers."""
        return jnp.asarray(step, leaf.dtype) if leaf.ndim == 0 and jnp.issubdtype(leaf.dtype, jnp.integer) else leaf

    counted = jax.tree.map(told, state.optimiser)
    return eqx.tree_at(lambda s: (s.optimiser, s.step), state, (counted, jnp.asarray(step, jnp.int32)))


def by_the_clock(
    call: Callable[[S], tuple[S, dict[str, Any]]],
    state: S,
    steps: int,
    clock: Clock,
    until: float,
    history: Path,
    every: float = 10.0,
    size: int = CALL,
) -> Iterator[tuple[S, int]]:
    """Calls, of `size` steps each, until the time is over; yields the state and the true count of steps every so many
    seconds and at the end.

    Raises FloatingPointError if the loss is not finite.
    """
    begun, taken, told = clock(), 0, -1e9
    while True:
        share = (clock() - begun) / max(until - begun, 1e-6)
        if share >= 1.0:
            break
        state, figures = call(at_step(state, int(steps * share)))
        taken += size
        if clock() - told >= every:
            told = clock()
            row = {name: round(float(jnp.mean(value)), 2) for name, value in figures.items()}
            if not np.isfinite(row["loss"]):
                raise FloatingPointError(f"loss is {row['loss']} after {taken} steps")
            row |= {"step": taken, "seconds": round(told, 1), "share": round(share, 3)}
            with history.open("a") as file:
                file.write(json.dumps(row) + "\n")
            say(json.dumps(row))
            yield state, taken
    yield state, taken


def padded(sets: list[tuple[ShapeSet, float]], capacity: int) -> DeviceShapes:
    """On the device, with room for so many objects; what fills it is never drawn."""
    shapes = shapes_on_device(sets)
    count = len(shapes.cumulative)
    if count > capacity:
        raise ValueError(f"{count} objects, but room for {capacity}")
    return jax.tree.map(
        lambda a: jnp.concatenate([a, jnp.broadcast_to(a[-1:], (capacity - count, *a.shape[1:]))]), shapes
    )


def main(options: Options) -> None:
    """Make objects, prior and network."""
    clock, out, work = Clock(), options.out, options.work
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    with worker_pool(options.processes) as pool:
        making = [pool.submit(make, job, work) for job in jobs_of(options)]
        _train(options, clock, pool, making)


def _train(options: Options, clock: Clock, pool: Executor, making: list[Future]) -> None:
    out, preset = options.out, PRESETS[options.preset]
    config = options.prior
    likelihood = Likelihood(lattice=foam.Lattice(preset.lattice, 1.0, 9 * preset.lattice // 4))
    model = ProbNeRF(preset, jax.random.key(config.seed))
    state = elbo.initial_state(model, config)
    capacity = sum(options.counts) + BLOCK
    # rehearse: compile with what is there first
    first = next(done for done in _results(making, clock, 1e9) if isinstance(done, Made))
    say(f"{clock():.0f} s: first objects on {jax.devices()[0].device_kind}")
    some = padded([(load_shapes(first.shapes), 1.0)], capacity)
    dummy = jax.tree.map(jnp.copy, state)
    for _ in range(2):
        begun = clock()
        dummy, figures = train_solids((likelihood, config, some, CALL), dummy)
        float(figures["loss"][-1])
        say(f"{clock():.0f} s: rehearsed the prior, {clock() - begun:.1f} s for {CALL} steps")
    del some
    sizes = NetworkSizes(latent=preset.latent, context=320, trunk=320, hidden=320, condition=160)
    network_state = posterior_flow.initial_state(
        PosteriorNetwork(sizes, jax.random.key(options.network.seed)), options.network
    )
    blank = _blank_pictures(options.pictures, preset.latent)
    ghost = jax.tree.map(jnp.copy, network_state)
    for _ in range(2):
        begun = clock()
        ghost, figures = train_pictures((options.network, dummy.model.flow, blank, CALL), ghost)
        float(figures["loss"][-1])
        say(f"{clock():.0f} s: rehearsed the network, {clock() - begun:.1f} s for {CALL} steps")
    del blank, ghost, dummy

    made = [done for done in _results(making, clock, options.objects_until) if _told(done)]
    for job in making:
        job.cancel()
    families = ("household", "meshes", "infinigen", "tabletop")
    sets = []
    for family, share in zip(families, options.shares, strict=True):
        if chosen := [load_shapes(m.shapes) for m in made if m.family == family]:
            sets.append((joined(chosen), share))
            say(f"{clock():.0f} s: {family}, {len(sets[-1][0])} objects")
    sources = [m.things for m in made]
    rng = np.random.default_rng(1)
    scenes = [
        pool.submit(draw_scenes, n, [sources[int(i)] for i in rng.choice(len(sources), 2)], 1, options.work)
        for n in range(4000)
    ]
    shapes = padded(sets, capacity)
    story: dict[str, Any] = {
        "family": "household",
        "others": {family: sum(m.count for m in made if m.family == family) for family in families},
        "shares": dict(zip(families, options.shares, strict=True)),
        "recipe": asdict(config),
        "by_the_clock": {"seconds": max(options.prior_until - clock(), 60.0), "device": jax.devices()[0].device_kind},
        "revision": revision(),
        "gate": None,
    }
    saved, weights, taken = clock(), out / "prior.safetensors", 0
    for trained, taken in by_the_clock(
        lambda s: train_solids((likelihood, config, shapes, CALL), s),
        state,
        config.steps,
        clock,
        max(options.prior_until, clock() + 60.0),
        out / "history.jsonl",
    ):
        if clock() - saved > 100.0:
            saved = clock()
            save_prior(weights, trained.model, story | {"steps": taken}, half=True)
    save_prior(weights, trained.model, story | {"steps": taken}, half=True)
    hashed = load_prior(weights).hash
    save_recognition(out / "prior.recognition.safetensors", trained.recognition, hashed)
    say(f"{clock():.0f} s: prior of {taken} steps")
    del shapes

    plain = [PicturePart.load(m.plain) for m in made]
    drawn = [PicturePart.load(p) for p in _results(scenes, clock, clock()) if isinstance(p, Path)]
    for job in scenes:
        job.cancel()
    say(f"{clock():.0f} s: {sum(len(p.rgb) for p in plain)} plain pictures, {sum(len(p.rgb) for p in drawn)} of scenes")
    pictures = told_pictures([*plain, *drawn], trained.recognition, preset.latent)
    rows, held = posterior_flow.split(pictures, options.network)
    rows = np.concatenate([rows, rows[rows >= sum(len(p.rgb) for p in plain)]])  # scenes count twice
    rows = np.resize(np.random.default_rng(2).permutation(rows), options.pictures)
    device = pictures_on_device(pictures, rows)
    network_story = {
        "recipe": asdict(options.network),
        "pictures": len(np.unique(rows)),
        "revision": revision(),
        "steps": 0,
    }
    path, flow, saved = out / "prior.network.safetensors", load_prior(weights).model.flow, clock()
    for learnt, taken in by_the_clock(
        lambda s: train_pictures((options.network, flow, device, CALL), s),
        network_state,
        options.network.steps,
        clock,
        options.network_until,
        out / "network_history.jsonl",
    ):
        if clock() - saved > 60.0:
            saved = clock()
            save_posterior_network(path, learnt.average, hashed, network_story | {"steps": taken})
    save_posterior_network(path, learnt.average, hashed, network_story | {"steps": taken})
    say(f"{clock():.0f} s: network of {taken} steps")
    validated = posterior_flow.validate(learnt.average, pictures, held, options.network, flow)
    with (out / "network_history.jsonl").open("a") as file:
        file.write(json.dumps({"step": taken, **validated}) + "\n")
    say(f"{clock():.0f} s: {validated}")


def _results(jobs: list[Future], clock: Clock, until: float) -> Iterator[Any]:
    """Results as they come, until the time; what a job raises is raised."""
    waiting = set(jobs)
    while waiting:
        done, waiting = wait(waiting, timeout=max(until - clock(), 0.0), return_when="FIRST_COMPLETED")
        if not done:
            return
        for job in done:
            yield job.result()


def _told(done: Made | str) -> bool:
    if isinstance(done, str):
        say(done)
    return isinstance(done, Made)


def _blank_pictures(count: int, latent: int) -> DevicePictures:
    zeros = jnp.zeros
    return DevicePictures(
        rgb=zeros((count, SIZE, SIZE, 3), jnp.uint8),
        distance=zeros((count, SIZE, SIZE), jnp.float16),
        unknown=zeros((count, SIZE, SIZE), jnp.uint8),
        T_view_camera=jnp.broadcast_to(jnp.eye(4).at[0, 3].set(4.0), (count, 4, 4)),
        tan_half_fov=jnp.full(count, 0.3),
        pose_sigma=jnp.full((count, 5), 0.1),
        yaw=zeros(count),
        pose=zeros((count, 4)),
        mean=zeros((count, latent)),
        sd=zeros((count, latent)),
        kind=zeros(count, jnp.uint8),
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
