"""Prior samples: the Fréchet distance of each method's objects from true ones, at equal n.

Each sample is seen once, by a random camera of the family. The same cameras see the true objects, and other true
objects: their distance is what n alone makes. Features are Inception's where the user gives its weights
(`benchmarks.rivals.inception`), else those of `benchmarks.rivals.features`; each has rows and a table of its own.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.harness.progress import say
from benchmarks.harness.results import Line
from benchmarks.harness.rows import Row
from benchmarks.harness.tables import Table
from benchmarks.measures.frechet import frechet_distance
from benchmarks.paper.conditioned import SIZE
from benchmarks.paper.experiment import Run
from benchmarks.paper.families import SPLITS, render
from benchmarks.paper.judged import pictures
from benchmarks.paper.methods import Effort, Question
from benchmarks.paper.rival_answers import TrainedRival, shown_by
from benchmarks.rivals.features import features_of, load_features
from benchmarks.rivals.inception import inception_features, load_inception
from benchmarks.rivals.model import DiffusionGenerator, Generator
from probnerf.inference import likelihood_settings
from probnerf.prior.networks import ProbNeRF

COUNTS = (64, 256)  # pictures of each method
# After a method's name, in each kind of features: of a name, the last settings alone count (`harness.results.newest`).
SAMPLES, IN_INCEPTION = ": samples", ": samples, Inception"
OTHERS = "true pictures of other cars"
PAPER = {"ProbNeRF": 84.6, "Functa": 158.1, "Functa, diffusion": 80.3, "pi-GAN": 36.7}  # Inception FID, SRN Cars
Pictures = Callable[[int, Float[np.ndarray, "n 4 4"]], Float[np.ndarray, "n s s 3"]]


@dataclass(frozen=True, eq=False)
class FeatureFile:
    """A network of features, its name in tables, and what its rows' methods end with."""

    of: Callable[[Float[np.ndarray, "n s s 3"]], Float[np.ndarray, "n f"]]
    name: str
    ending: str = SAMPLES


def features_in(path: Path, inception: Path | None = None) -> FeatureFile:
    """Inception's features of these weights; without, those of the network in the file `path`.

    Raises FileNotFoundError or ValueError in one line.
    """
    if inception is not None:
        return FeatureFile(partial(inception_features, load_inception(inception)), _named(inception), IN_INCEPTION)
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such network of features; train one with `python -m benchmarks.rivals.features`"
        )
    return FeatureFile(partial(features_of, load_features(path)[0]), _named(path))


def _named(path: Path) -> str:
    return f"{path.stem} {hashlib.sha256(path.read_bytes()).hexdigest()[:8]}"


def sampled(method: str) -> str:
    """The name of the method whose samples a row is of."""
    return method.removesuffix(IN_INCEPTION).removesuffix(SAMPLES)


def condition_of(family: str, n: int) -> str:
    """A name for rows of n pictures."""
    return f"{family}, prior samples, n {n}"


def measure(run: Run, rivals: Sequence[TrainedRival], features: FeatureFile, counts: Sequence[int] = COUNTS) -> None:
    """One row a method and n."""
    samplers: dict[str, tuple[Line, Pictures]] = {"ProbNeRF": ({}, _own(run)), OTHERS: ({}, _true(run, max(COUNTS)))}
    for rival in rivals:
        weights: Line = {"weights": rival.digest}
        if isinstance(rival.model, Generator):
            samplers[rival.label] = (weights, _of(rival, rival.model.sample))
        if isinstance(rival.model, DiffusionGenerator):
            samplers[f"{rival.label}, diffusion"] = (weights, _of(rival, rival.model.sample_diffusion))
    for n in counts:
        T = np.concatenate([run.family.cameras(seed, 1) for seed in SPLITS["val"][:n]])
        truth = None
        for name, (weights, made) in samplers.items():
            settings = {**weights, "features": features.name}
            if (line := run.missing(f"{name}{features.ending}", settings, condition_of(run.family.name, n), 0)) is None:
                continue
            if truth is None:
                truth = features.of(_true(run, 0)(n, T))
            distance = frechet_distance(features.of(made(n, T)), truth)
            run.results.add({**line, "distance": round(distance, 4)})
            say(f"{line['condition']}, {name}: {distance:.3f}")


def _true(run: Run, first: int) -> Pictures:
    def made(n: int, T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n s s 3"]:
        seeds = SPLITS["val"][first : first + n]
        shown = [render(run.family.draw(s), camera[None], SIZE).rgb[0] for s, camera in zip(seeds, T, strict=True)]
        return np.stack(shown).astype(np.float32) / 255.0

    return made


def _own(run: Run) -> Pictures:
    return lambda n, T: own_samples(run.prior.model, jax.random.key(run.seed), T)


def own_samples(
    model: ProbNeRF, key: Array, T_object_camera: Float[np.ndarray, "n 4 4"]
) -> Float[np.ndarray, "n s s 3"]:
    """Pictures of n draws of the prior, each from its camera."""
    z = jax.random.normal(key, (len(T_object_camera), model.latent))
    config = Question(None, model, Effort(), 0).config(delta=False)  # type: ignore[arg-type]
    likelihood = likelihood_settings(config, sample_pose=False)
    each = ((z[i : i + 1], T_object_camera[i : i + 1]) for i in range(len(z)))
    return np.stack([pictures(model, likelihood, *one)[0, 0] for one in each]).astype(np.float32)


def _of(rival: TrainedRival, sample: Callable) -> Pictures:
    def made(n: int, T: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n s s 3"]:
        states = jax.jit(sample, static_argnums=1)(jax.random.key(0), n)
        each = (jax.tree.map(lambda a, i=i: a[i], states) for i in range(n))
        shown = [shown_by(rival.model, s, jnp.asarray(T[i : i + 1], jnp.float32))[0] for i, s in enumerate(each)]
        return np.clip(np.stack(shown), 0.0, 1.0)

    return made


def tables(lines: Sequence[Line], rows: list[Row]) -> list[Table]:
    """One of each family and kind of features: distances by n, beside the paper's."""
    found = []
    every = [line for line in lines if ", prior samples, n " in line["condition"]]
    kinds = dict.fromkeys((line["condition"].split(",")[0], line["method"].endswith(IN_INCEPTION)) for line in every)
    for family, inception in kinds:
        columns = [condition_of(family, n) for n in COUNTS]
        own = [x for x in every if x["condition"] in columns and x["method"].endswith(IN_INCEPTION) == inception]
        value = {(sampled(x["method"]), x["condition"]): x["distance"] for x in own}
        names = dict.fromkeys(line["settings"]["features"] for line in own)
        cells, metric = [], "fid" if inception else "frechet"
        for method in dict.fromkeys(name for name, _ in value):
            for n, condition in zip(COUNTS, columns, strict=True):
                if (method, condition) in value:
                    rows.append(Row("paper", method, condition, metric, value[method, condition], "", n))
            shown = [f"{value[method, c]:.2f}" if (method, c) in value else "" for c in columns]
            cells.append([method, *shown, f"{PAPER[method]:g}" if method in PAPER else ""])
        title = f"{family}, prior samples: Fréchet distance in the features '{'; '.join(names)}'"
        header = ("method", *(f"n {n}" for n in COUNTS), "the paper's, of Inception on SRN Cars")
        found.append(Table(title, header, cells))
    return found
