"""Train a prior's network on objects, scenes and the model's own draws: `python -m benchmarks.household.network`.

A network that has seen the same objects hundreds of times knows them by heart: the one that
`benchmarks.household.train` leaves has a training loss of 108 nats and one of 169 on other objects. So a share of each
batch is pictures of the prior's own shapes (`perception.simulation.model_pictures`), and others are of new objects.
Training ends at its time; the learning rate follows the clock, as in `benchmarks.household.train`.
"""

from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from itertools import count, islice
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array

from benchmarks.harness.machine import revision
from benchmarks.harness.progress import say
from benchmarks.household.latents import told_pictures
from benchmarks.household.objects import SIZE
from benchmarks.household.train import Clock, by_the_clock
from foundation.whole_file import whole_file
from foundation.worker_pool import worker_pool
from perception.simulation.model_pictures import draw_shape
from perception.simulation.plain_pictures import PlainDraws
from perception.simulation.training_pictures import PicturePart
from probnerf.prior.checkpoint import (
    Prior,
    load_prior,
    load_recognition,
    network_path,
    recognition_path,
    save_posterior_network,
)
from probnerf.prior.networks import RealNVP
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork
from probnerf.training import posterior_flow
from probnerf.training.picture_set import Examples, PictureSet, changed
from probnerf.training.posterior_flow import PosteriorTrainState
from probnerf.training.settings import PosteriorTrainConfig
from probnerf.training.shape_set import batch_of, load_shapes
from probnerf.types import on_device

UNTOLD = 255  # the kind of a draw of the model
OWN = 0.6  # of the model's draws, those of N(0, I); the others are what recognition tells of objects
MOST_SQUARES = 3.0  # mean square of an object's z~ beyond which recognition has not understood it: it is left out
SHAPES, VIEWS = 250, 2  # of a part of the model's draws
SIZES = NetworkSizes(latent=96, context=320, trunk=320, hidden=320, condition=160)
CALL = 10  # steps between two looks at the clock


@dataclass(frozen=True)
class Options:
    """Train the posterior network of a prior for a given time."""

    prior: Path
    """Weights; training begins at the network beside them, if there is one. The recognition must lie there, too."""
    work: Path
    """Folder with the shapes and pictures that `benchmarks.household.train` (or `objects.make`) left."""
    out: Path = Path("runs/household-network")
    """Folder of the network and its history."""
    draws: int = 40_000
    """Pictures of the model's own shapes; kept in WORK."""
    seconds: float = 1800.0
    """Of training."""
    shares: tuple[float, float, float] = (0.34, 0.22, 0.44)
    """Of a batch: plain pictures of objects, scenes, the model's own shapes."""
    processes: int = 2
    """That draw pictures."""
    held_out: float = 0.08
    """Share of the objects that are judged by alone; so many of the model's draws, too."""
    recipe: tyro.conf.OmitArgPrefixes[PosteriorTrainConfig] = field(
        default_factory=lambda: PosteriorTrainConfig(
            steps=1_000_000, warmup=20_000, batch=128, learning_rate=6e-4, final_learning_rate=1e-6
        )
    )


@cache
def _prior(path: Path) -> Prior:
    return load_prior(path)


def draw_part(number: int, weights: Path, work: Path) -> Path:
    """A file of plain pictures of the model's own shapes, with their z as `mean`."""
    prior, rng = _prior(weights), np.random.default_rng([number, 99])
    path = work / f"model_{prior.hash[:8]}_{number:05d}.npz"
    if path.exists():
        return path
    recognition = load_recognition(recognition_path(weights), prior)
    sources = sorted(work.glob("*.shapes"))
    pictures, latents, kinds, owner = [], [], [], []
    for shape in range(SHAPES):
        z, kind = np.asarray(_forward(prior.model.flow, on_device(rng.standard_normal(prior.model.latent)))), UNTOLD
        if sources and rng.random() >= OWN:
            shapes = _shapes(sources[int(rng.integers(len(sources)))])
            row = int(rng.integers(len(shapes)))
            told = batch_of(shapes, rng, np.array([row]), 4, 1).description[0]
            mean, precision = (np.asarray(a) for a in _recognised(recognition, told))
            z, kind = mean + rng.standard_normal(len(mean)) / np.sqrt(precision), int(shapes.kind[row])
        field_weights = _decoded(prior.model.hyper, on_device(z))
        drawn = draw_shape(rng, prior.model.field, field_weights, VIEWS, SIZE, PlainDraws())
        pictures += drawn
        latents += [z] * len(drawn)
        kinds += [kind] * len(drawn)
        owner += [-1 - number * SHAPES - shape] * len(drawn)
    arrays: dict[str, Any] = {
        name: np.stack([np.asarray(getattr(picture, name)) for picture in pictures]).astype(kind)
        for name, kind in _TYPES.items()
        if name != "rgb"
    }
    arrays["rgb"] = np.stack([np.round(255.0 * picture.rgb) for picture in pictures]).astype(np.uint8)
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            **arrays,
            mean=np.stack(latents).astype(np.float32),
            kind=np.array(kinds, np.uint8),
            object_id=np.array(owner),
        )
    return path


_TYPES = {
    "rgb": np.uint8,
    "distance": np.float16,
    "unknown": np.uint8,
    "T_view_camera": np.float32,
    "tan_half_fov": np.float32,
    "pose_sigma": np.float32,
    "yaw": np.float32,
    "pose": np.float32,
}
_shapes = cache(load_shapes)
_recognised = eqx.filter_jit(lambda recognition, told: recognition(jnp.asarray(told)))
_forward = eqx.filter_jit(lambda flow, z_tilde: flow.forward(z_tilde)[0])
_squares = eqx.filter_jit(lambda flow, z: jax.vmap(lambda one: jnp.sum(flow.inverse(one)[0] ** 2))(z))
_decoded = eqx.filter_jit(lambda hyper, z: hyper(z))


def _untold(flow: RealNVP, mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """-log N(z~; 0, I) of a draw of each z, nats."""
    z = mean + sd * np.random.default_rng(0).standard_normal(mean.shape)
    return 0.5 * np.asarray(_squares(flow, on_device(z))) + 0.5 * mean.shape[1] * np.log(2.0 * np.pi)


@dataclass(frozen=True)
class Material:
    """All pictures, and which rows are of which sort."""

    pictures: PictureSet
    sorts: dict[str, np.ndarray]  # rows to train on
    held_out: dict[str, np.ndarray]


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """What `draw_part` left; its draws' z is known exactly."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return arrays | {"sd": np.zeros_like(arrays["mean"])}


def gathered(prior: Prior, weights: Path, work: Path, model_parts: Sequence[Path], held_out: float) -> Material:
    """The objects' pictures, the scenes' and the model's own."""
    recognition = load_recognition(recognition_path(weights), prior)
    parts = {
        sort: [PicturePart.load(path) for path in sorted(work.glob(pattern))]
        for sort, pattern in (("objects", "*.plain"), ("scenes", "scenes-*.npz"))
    }
    real = told_pictures([part for each in parts.values() for part in each], recognition, prior.model.latent)
    own = [_arrays(path) for path in model_parts]
    names = [f.name for f in fields(PictureSet)]
    every = PictureSet(**{name: np.concatenate([getattr(real, name), *(part[name] for part in own)]) for name in names})
    sort = np.full(len(every), 2)
    sort[: len(real)] = np.arange(len(real)) >= sum(len(part.rgb) for part in parts["objects"])
    known = np.unique(every.object_id)
    kept = np.random.default_rng(1).permutation(known)[: round(held_out * len(known))]
    out = np.isin(every.object_id, kept)
    likely = _squares(prior.model.flow, on_device(every.mean)) < MOST_SQUARES * prior.model.latent
    rows = {name: (sort == k) & likely for k, name in enumerate(("objects", "scenes", "model"))}
    return Material(
        every,
        {name: np.flatnonzero(these & ~out) for name, these in rows.items()},
        {name: np.flatnonzero(these & out) for name, these in rows.items()},
    )


def judged(
    network: PosteriorNetwork, material: Material, flow: RealNVP, recipe: PosteriorTrainConfig
) -> dict[str, dict[str, float]]:
    """The parts of the loss on held-out pictures of each sort, nats; `untold` is N(0, I)'s, which looks at nothing."""
    found, pictures = {}, material.pictures
    for name, rows in material.held_out.items():
        if len(rows) >= recipe.batch:
            parts = posterior_flow.validate(network, pictures, rows, recipe, flow)
            found[name] = {key.removeprefix("validation_"): round(value, 2) for key, value in parts.items()}
            found[name]["untold"] = round(float(np.mean(_untold(flow, pictures.mean[rows], pictures.sd[rows]))), 2)
    return found


def main(options: Options) -> None:
    """Draw what is missing, train, and write the network."""
    prior, recipe, out = load_prior(options.prior), options.recipe, options.out
    out.mkdir(parents=True, exist_ok=True)
    options.work.mkdir(parents=True, exist_ok=True)
    if not any(options.work.glob("*.plain")):
        raise ValueError(
            f"{options.work} has no pictures of objects (*.plain); `benchmarks.household.objects.make` draws them"
        )
    parts = range(-(-options.draws // (SHAPES * VIEWS)))
    with worker_pool(options.processes) as pool:
        jobs = [pool.submit(draw_part, n, options.prior, options.work) for n in parts]
        drawn = [job.result() for job in jobs]
    material = gathered(prior, options.prior, options.work, drawn, options.held_out)
    say(str({name: len(rows) for name, rows in material.sorts.items()}))
    flow, path = prior.model.flow, network_path(out / "prior.safetensors")
    sizes = replace(SIZES, latent=prior.model.latent)
    start = prior.network or PosteriorNetwork(sizes, jax.random.key(recipe.seed))
    say(f"begins at {judged(start, material, flow, recipe)}")
    story: dict[str, Any] = {"recipe": asdict(recipe), "pictures": sum(map(len, material.sorts.values()))}
    story |= {"shares": options.shares, "seconds": options.seconds, "revision": revision()}
    state = posterior_flow.initial_state(start, recipe)
    with closing(_batches(material, options.shares, recipe)) as batches:

        def call(state: PosteriorTrainState) -> tuple[PosteriorTrainState, dict[str, Array]]:
            """Steps until the next look at the clock."""
            told = []
            for examples in islice(batches, CALL):
                state, parts = posterior_flow.train_step((recipe, flow), state, examples)
                told.append(parts)
            return state, jax.tree.map(lambda *values: jnp.stack(values), *told)

        history = out / "network_history.jsonl"
        ticks = by_the_clock(call, state, recipe.steps, Clock(), options.seconds, history, every=60.0, size=CALL)
        for state, steps in ticks:
            save_posterior_network(path, state.average, prior.hash, story | {"steps": steps})
    found = judged(state.average, material, flow, recipe)
    save_posterior_network(path, state.average, prior.hash, story | {"steps": steps, "validation": found})
    say(f"{path}: {steps} steps, {found}")


def _batches(
    material: Material, shares: tuple[float, float, float], recipe: PosteriorTrainConfig
) -> Generator[Examples]:
    """Batches without end; the next one is drawn while one is used."""
    sizes = np.random.default_rng(0).multinomial(recipe.batch, np.array(shares) / sum(shares))

    def drawn(step: int) -> Examples:
        rng = np.random.default_rng([recipe.seed, step, 7])
        rows = [rng.choice(r, n) for r, n in zip(material.sorts.values(), sizes, strict=True) if len(r)]
        return changed(material.pictures, np.concatenate(rows), rng, recipe)

    with ThreadPoolExecutor(1) as drawer:
        coming = drawer.submit(drawn, 0)
        for step in count(1):
            examples, coming = coming.result(), drawer.submit(drawn, step)
            yield examples


if __name__ == "__main__":
    main(tyro.cli(Options))
