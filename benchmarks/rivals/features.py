"""Features of pictures for Fréchet distances, of a network trained apart from all methods that are compared.

`python -m benchmarks.rivals.features --data FILE --out benchmarks/checkpoints/paper/features.safetensors`: a small
convolutional network learns to tell a car's style, its paint and from where it is seen, some minutes on one CPU core.
Its last layer but one is the features. It saw true pictures only. Unlike Inception's, its features know cars alone, so
distances are not those of other papers.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from benchmarks.harness.command import command
from benchmarks.harness.machine import machine, revision
from benchmarks.harness.progress import say
from benchmarks.paper.cars import STYLES, draw_car
from benchmarks.rivals.layers import Dense
from benchmarks.rivals.model import load_rival, save_rival
from benchmarks.rivals.picture_set import PictureSet, load_pictures
from benchmarks.rivals.recipe import descend, optimiser, rate

NAME = "features"
SHIFT = 3  # px that a picture is moved by, so that features do not depend on single pixels
NEW = 0.05  # of the objects: the last ones, examined and never learnt


@dataclass(frozen=True)
class FeatureSizes:
    """Of the network."""

    channels: tuple[int, ...] = (16, 32, 48, 64)
    """Of convolutions that halve the picture each."""
    features: int = 32


class Features(eqx.Module):
    """Pictures to features, and what these tell: style, then view (3) and paint (3)."""

    config: FeatureSizes = eqx.field(static=True)
    convolutions: tuple[eqx.nn.Conv2d, ...]
    embed: Dense
    tell: Dense

    def __init__(self, config: FeatureSizes, key: PRNGKeyArray):
        k0, k1, *keys = jax.random.split(key, 2 + len(config.channels))
        self.config = config
        inputs = (3, *config.channels)
        pairs = zip(inputs[:-1], inputs[1:], keys, strict=True)
        self.convolutions = tuple(eqx.nn.Conv2d(i, o, 3, 2, 1, key=k) for i, o, k in pairs)
        self.embed = Dense(2 * config.channels[-1], config.features, k0)
        self.tell = Dense(config.features, len(STYLES) + 6, k1, gain=0.3)

    def __call__(self, rgb: Float[Array, "s s 3"]) -> Float[Array, "f"]:
        """Of one picture, [0, 1], white where nothing is."""
        x = jnp.moveaxis(1.0 - rgb, 2, 0)
        for layer in self.convolutions:
            x = jax.nn.relu(layer(x))
        return self.embed(jnp.concatenate([x.mean(axis=(1, 2)), x.max(axis=(1, 2))]))

    def told(self, rgb: Float[Array, "s s 3"]) -> Float[Array, "o"]:
        """Logits of the style, then view and paint."""
        return self.tell(jax.nn.relu(self(rgb)))


@eqx.filter_jit
def _features_of(model: Features, rgb: Float[Array, "n s s 3"]) -> Float[Array, "n f"]:
    return jax.lax.map(model, rgb, batch_size=64)


def features_of(model: Features, rgb: Float[np.ndarray, "n s s 3"]) -> Float[np.ndarray, "n f"]:
    """Of pictures in [0, 1]."""
    return np.asarray(_features_of(model, jnp.asarray(rgb)))


def load_features(path: Path) -> tuple[Features, dict[str, Any]]:
    """The network and its file's metadata. Raises as `load_rival` does."""

    def build(story: dict[str, Any]):
        if story["model"] != NAME:
            raise ValueError(f"it holds '{story['model']}', not '{NAME}'")
        return lambda key: Features(FeatureSizes(**story["config"]), key)

    return load_rival(path, build)


def labels(pictures: PictureSet) -> tuple[np.ndarray, Float[np.ndarray, "n v 6"]]:
    """Each object's style, and for each picture its camera's direction from the object and the object's paint."""
    cars = [draw_car(int(seed)) for seed in pictures.seed]
    style = np.array([STYLES.index(car.style) for car in cars])
    view = -pictures.T_object_camera[..., :3, 2]  # cameras look along z
    paint = np.broadcast_to(np.stack([car.paint for car in cars])[:, None], view.shape)
    return style, np.concatenate([view, 2.0 * paint - 1.0], axis=-1)


def loss(
    model: Features, rgb: UInt8[Array, "b s s 3"], style: Array, numbers: Float[Array, "b 6"]
) -> tuple[Array, dict[str, Array]]:
    """Cross-entropy of the style and squared errors of view and paint."""
    told = jax.vmap(model.told)(rgb / 255.0)
    logits, rest = told[:, : len(STYLES)], told[:, len(STYLES) :]
    nats = -jnp.mean(jnp.take_along_axis(jax.nn.log_softmax(logits), style[:, None], axis=1))
    right = jnp.mean(jnp.argmax(logits, axis=1) == style)
    squared = jnp.mean((rest - numbers) ** 2)
    return nats + 4.0 * squared, {"nats": nats, "right": right, "squared": squared}


@jax.jit
def step(
    state: tuple[Features, Any], rgb: Array, style: Array, numbers: Array, size: Array
) -> tuple[tuple[Features, Any], dict[str, Array]]:
    """One step of Adam."""
    gradient, metrics = jax.grad(loss, has_aux=True)(state[0], rgb, style, numbers)
    return descend(*(state[0], gradient, state[1]), size), metrics


@dataclass(frozen=True)
class Options:
    """Train the network of features."""

    data: Path
    """Pictures of cars, as `benchmarks.rivals.pictures` writes them."""
    out: Path
    """The weights, .safetensors."""
    steps: int = 3000
    """Of 64 pictures."""
    seed: int = 0
    """Of weights and batches."""


def train(options: Options, pictures: PictureSet, sizes: FeatureSizes = FeatureSizes()) -> dict[str, float]:
    """Train, write, and say what is told of objects that were not learnt."""
    begun, batch = time.monotonic(), 64
    (style, numbers), count = map(jnp.asarray, labels(pictures)), len(pictures.seed)
    new = max(1, round(NEW * count))
    rng = np.random.default_rng(options.seed)
    model = Features(sizes, jax.random.key(options.seed))
    state = model, optimiser().init(model)
    for t in range(options.steps):
        objects, views = rng.integers(0, count - new, batch), rng.integers(0, pictures.rgb.shape[1], batch)
        moved = np.roll(pictures.rgb[objects, views], rng.integers(-SHIFT, SHIFT + 1, 2), axis=(1, 2))
        size = rate(jnp.asarray(t / options.steps), 2e-3)
        state, metrics = step(state, moved, style[objects], numbers[objects, views], size)
        if (t + 1) % 250 == 0:
            say(f"{t + 1}  " + "  ".join(f"{name} {float(value):.4f}" for name, value in metrics.items()))
    rgb, views = pictures.rgb[-new:].reshape(-1, *pictures.rgb.shape[2:]), pictures.rgb.shape[1]
    told = loss(state[0], jnp.asarray(rgb), jnp.repeat(style[-new:], views), numbers[-new:].reshape(-1, 6))[1]
    figures = {f"{name}_new": round(float(value), 4) for name, value in told.items()}
    story = {"steps": options.steps, "objects": count - new, "views": views, "size": rgb.shape[1], "seed": options.seed}
    story |= {"seconds": round(time.monotonic() - begun, 1), "machine": machine(), "revision": revision()}
    save_rival(options.out, NAME, state[0], story | figures)
    return figures


def main(options: Options) -> Path:
    """Train and write; the path of the file."""
    say(str(train(options, load_pictures(options.data))))
    return options.out


if __name__ == "__main__":
    command(main, Options)
