"""A pixelNeRF (Yu et al. 2021): a field that reads the features of one picture where a point appears in it.

A point estimate without a prior. Smaller than the published one: a U-net on 64x64 pictures takes the place of a
ResNet-34 that has seen ImageNet, and one pass of samples the place of two. As there, points and directions are in the
camera's frame of the given picture, and the loss is the squared error of random rays of other views. Points are also
given in the object's frame: all methods are told the camera's pose in it, and it speeds learning.
"""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from benchmarks.rivals.layers import ConditionedBlock, ConvolutionBlock, Dense, descent, doubled, encoded
from benchmarks.rivals.model import rendered
from benchmarks.rivals.recipe import Metrics, Phase, Recipe, descend, optimiser, rate
from benchmarks.rivals.volume import FieldConfig, Pictures, draw_rays, integrate, projected


@dataclass(frozen=True)
class PixelNeRFConfig(FieldConfig):
    """Sizes of the networks, and how they are trained."""

    channels: tuple[int, ...] = (32, 64, 96, 128, 160)
    """Of the U-net on its way down, from the whole picture on."""
    features: int = 96
    """Of a pixel."""


class UNet(eqx.Module):
    """Features of each pixel that know the whole picture."""

    first: ConvolutionBlock
    down: tuple[ConvolutionBlock, ...]
    up: tuple[ConvolutionBlock, ...]

    def __init__(self, channels: tuple[int, ...], features: int, key: PRNGKeyArray):
        k0, k1, *keys = jax.random.split(key, 1 + len(channels))
        self.first = ConvolutionBlock(3, channels[0], k0)
        self.down = descent(channels, k1)
        outputs = (*(max(c, features) for c in channels[1:-1]), features)
        outputs = (*reversed(outputs[:-1]), features)
        inputs = (channels[-1], *outputs[:-1])
        sizes = zip(inputs, reversed(channels[:-1]), outputs, keys, strict=True)
        self.up = tuple(ConvolutionBlock(i + skip, o, k) for i, skip, o, k in sizes)

    def __call__(self, picture: Float[Array, "3 s s"]) -> Float[Array, "f s s"]:
        """From a picture whose background is zero."""
        levels = [self.first(picture)]
        for block in self.down:
            levels.append(block(levels[-1]))
        x = levels.pop()
        for block in self.up:
            x = block(jnp.concatenate([doubled(x), levels.pop()]))
        return x


class Seen(eqx.Module):
    """The state: a picture's features, and from where it was taken."""

    features: Float[Array, "s s f"]
    T_object_camera: Float[Array, "4 4"]


class PixelNeRF(eqx.Module):
    """Encoder and field."""

    config: PixelNeRFConfig = eqx.field(static=True)
    encoder: UNet
    enter: Dense
    blocks: tuple[ConditionedBlock, ...]
    leave: Dense

    def __init__(self, config: PixelNeRFConfig, key: PRNGKeyArray):
        k0, k1, k2, *keys = jax.random.split(key, 3 + config.blocks)
        self.config = config
        self.encoder = UNet(config.channels, config.features, k0)
        self.enter = Dense(6 * (1 + 2 * config.octaves) + 3, config.width, k1)
        self.blocks = tuple(ConditionedBlock(config.width, config.features, k) for k in keys)
        self.leave = Dense(config.width, 4, k2, gain=0.1)

    def see(self, rgb: UInt8[Array, "s s 3"], T_object_camera: Float[Array, "4 4"]) -> Seen:
        """The state that one picture gives."""
        features = self.encoder(1.0 - jnp.moveaxis(rgb, 2, 0) / 255.0)
        return Seen(jnp.moveaxis(features, 0, 2), T_object_camera)

    def field(self, seen: Seen, points: Float[Array, "n 3"], directions: Float[Array, "n 3"]) -> tuple[Array, Array]:
        """sigma [n] and rgb [n 3] at points of the object's frame."""
        tan = jnp.asarray(self.config.tan_half_fov)
        place, camera = projected(seen.T_object_camera, tan, points, len(seen.features))
        view = directions @ seen.T_object_camera[:3, :3]
        places = encoded(jnp.stack([camera, points], axis=1), self.config.octaves).reshape(len(points), -1)
        h = self.enter(jnp.concatenate([places, view], axis=-1))
        condition = bilinear(seen.features, place)
        for block in self.blocks:
            h = block(h, condition)
        raw = self.leave(jax.nn.relu(h)).astype(jnp.float32)
        return self.config.density_scale * jax.nn.softplus(raw[:, 0] - 2.0), jax.nn.sigmoid(raw[:, 1:])

    def condition(
        self, picture: UInt8[Array, "s s 3"], T_object_camera: Float[Array, "4 4"], key: PRNGKeyArray, draws: int
    ) -> Seen:
        """The state of this picture, `draws` times the same."""
        seen = self.see(picture, T_object_camera)
        return jax.tree.map(lambda array: jnp.broadcast_to(array, (draws, *array.shape)), seen)

    def render(self, state: Seen, T_object_camera: Float[Array, "v 4 4"], size: int) -> Float[Array, "v s s 3"]:
        """Square pictures, in [0, 1]."""
        config = self.config
        field = partial(self.field, state)
        return rendered(field, config.box, config.tan_half_fov, T_object_camera, size, config.samples)


def bilinear(picture: Float[Array, "s s f"], place: Float[Array, "n 2"]) -> Float[Array, "n f"]:
    """Features between the centres of four pixels, at places (column, row); the border goes on outside."""
    size = len(picture)
    at = jnp.clip(place - 0.5, 0.0, size - 1.0)
    low = jnp.clip(jnp.floor(at).astype(int), 0, size - 2)
    x, y = jnp.moveaxis(at - low, 1, 0)[..., None]
    i, j = low[:, 1], low[:, 0]
    top = (1.0 - x) * picture[i, j] + x * picture[i, j + 1]
    return (1.0 - y) * top + y * ((1.0 - x) * picture[i + 1, j] + x * picture[i + 1, j + 1])


def loss(model: PixelNeRF, pictures: Pictures, key: PRNGKeyArray) -> tuple[Float[Array, ""], Metrics]:
    """Squared error of rays of other views of random objects, half of them in the object's frame.

    The metric `mse` is its unbiased mean over all pixels.
    """
    config = model.config
    k0, k1, k2, k3, k4 = jax.random.split(key, 5)
    count, views = pictures.rgb.shape[:2]
    objects = jax.random.randint(k0, (config.objects,), 0, count)
    source = jax.random.randint(k1, (config.objects,), 0, views)
    others = jax.random.randint(k2, (config.objects, config.rays), 1, views)
    rays = draw_rays(pictures, objects, (source[:, None] + others) % views, k3)

    def one(rgb, T, origin, direction, key):
        field = partial(model.field, model.see(rgb, T))
        return integrate(field, config.box, origin, direction, config.samples, key)[0]

    given = pictures.rgb[objects, source], pictures.T_object_camera[objects, source]
    rgb = jax.vmap(one)(*given, rays.origin, rays.direction, jax.random.split(k4, config.objects))
    squared = jnp.mean((rgb - rays.rgb) ** 2, axis=-1)
    return jnp.mean(squared), {"mse": jnp.mean(rays.weight * squared)}


def pixel_nerf_recipe(config: PixelNeRFConfig) -> Recipe:
    """One phase of Adam on `loss`."""

    def start(key):
        model = PixelNeRF(config, key)
        return model, optimiser().init(model)

    def step(state, pictures, progress, key):
        model, moments = state
        gradient, metrics = jax.grad(loss, has_aux=True)(model, pictures, key)
        return descend(model, gradient, moments, rate(progress, config.peak_rate)), metrics

    return Recipe(start, (Phase("rays", step),), lambda state: state[0])
