"""A NeRF-VAE (Kosiorek et al. 2021): one latent Gaussian for an object, joined to each point; an encoder infers it.

The encoder sees one to four pictures with their cameras and q(z | pictures) is its answer: amortised, no search. As in
the ProbNeRF paper's account of it, z is concatenated to the input of each layer of the field. The objective is the
ELBO of one picture's pixels: sum of log N(rgb | rendered, noise^2) over all its pixels, estimated from random rays of
all views, minus KL(q || N(0, I)), whose factor rises from 0 to 1 in the first part of training.
"""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from benchmarks.rivals.layers import ConditionedBlock, Dense, descent, encoded
from benchmarks.rivals.model import rendered
from benchmarks.rivals.recipe import Metrics, Phase, Recipe, descend, optimiser, rate
from benchmarks.rivals.volume import FieldConfig, Pictures, directions, draw_rays, integrate

MOST_GIVEN = 4  # pictures


@dataclass(frozen=True)
class NeRFVAEConfig(FieldConfig):
    """Sizes of the networks, and how they are trained."""

    size: int = 64
    """px a side of the pictures that the encoder sees."""
    latent: int = 64
    channels: tuple[int, ...] = (32, 64, 128, 192)
    """Of the encoder, from half the picture's size on."""
    summary: int = 256
    """Features of a picture."""
    noise: float = 0.1
    """Standard deviation of a pixel's colour."""
    warm_up: float = 0.25
    """Share of the training in which the KL's factor rises to 1."""


class Encoder(eqx.Module):
    """q(z | pictures with cameras): features of each picture, their mean, a Gaussian."""

    first: eqx.nn.Conv2d
    down: tuple
    summary: Dense
    answer: tuple[Dense, Dense]

    def __init__(self, config: NeRFVAEConfig, key: PRNGKeyArray):
        k0, k1, k2, k3, k4 = jax.random.split(key, 5)
        self.first = eqx.nn.Conv2d(9, config.channels[0], 5, 2, 2, key=k0)
        self.down = descent(config.channels, k1)
        cells = (config.size // 2 ** len(config.channels)) ** 2
        self.summary = Dense(cells * config.channels[-1], config.summary, k2)
        self.answer = (
            Dense(config.summary, config.summary, k3),
            Dense(config.summary, 2 * config.latent, k4, gain=0.1),
        )

    def __call__(
        self,
        rgb: UInt8[Array, "m s s 3"],
        T_object_camera: Float[Array, "m 4 4"],
        tan_half_fov: float,
        used: Float[Array, "m"],
    ) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
        """Mean and log standard deviation from the pictures of `used` 1."""

        def one(rgb, T):
            """Features of a picture; each pixel's ray is told beside its colour."""
            size = len(rgb)
            row, column = jnp.meshgrid(jnp.arange(size) + 0.5, jnp.arange(size) + 0.5, indexing="ij")
            ray = directions(T, jnp.asarray(tan_half_fov), jnp.stack([column, row], axis=-1), size)
            origin = jnp.broadcast_to(T[:3, 3], ray.shape)
            x = jnp.moveaxis(jnp.concatenate([1.0 - rgb / 255.0, ray, origin], axis=-1), 2, 0)
            x = jax.nn.relu(self.first(x))
            for block in self.down:
                x = block(x)
            return jax.nn.relu(self.summary(x.ravel()).astype(jnp.float32))

        features = jax.vmap(one)(rgb, T_object_camera)
        mean = jnp.sum(used[:, None] * features, axis=0) / jnp.sum(used)
        raw = self.answer[1](jax.nn.relu(self.answer[0](mean))).astype(jnp.float32)
        centre, log_deviation = jnp.split(raw, 2)
        return centre, jnp.clip(log_deviation - 1.0, -6.0, 2.0)


class NeRFVAE(eqx.Module):
    """Encoder and field. The state of an object is its z."""

    config: NeRFVAEConfig = eqx.field(static=True)
    encoder: Encoder
    enter: Dense
    blocks: tuple[ConditionedBlock, ...]
    leave: Dense

    def __init__(self, config: NeRFVAEConfig, key: PRNGKeyArray):
        k0, k1, k2, *keys = jax.random.split(key, 3 + config.blocks)
        self.config = config
        self.encoder = Encoder(config, k0)
        self.enter = Dense(3 * (1 + 2 * config.octaves), config.width, k1)
        self.blocks = tuple(ConditionedBlock(config.width, config.latent, k) for k in keys)
        self.leave = Dense(config.width, 4, k2, gain=0.1)

    def field(
        self, z: Float[Array, "k"], points: Float[Array, "n 3"], directions: Float[Array, "n 3"]
    ) -> tuple[Array, Array]:
        """sigma [n] and rgb [n 3] at points of the object's frame; colours do not depend on the direction."""
        h = self.enter(encoded(points, self.config.octaves))
        for block in self.blocks:
            h = block(h, z)
        raw = self.leave(jax.nn.relu(h)).astype(jnp.float32)
        return self.config.density_scale * jax.nn.softplus(raw[:, 0] - 2.0), jax.nn.sigmoid(raw[:, 1:])

    def condition(
        self, picture: UInt8[Array, "s s 3"], T_object_camera: Float[Array, "4 4"], key: PRNGKeyArray, draws: int
    ) -> Float[Array, "d k"]:
        """Draws of q(z | picture)."""
        mean, log_deviation = self.encoder(picture[None], T_object_camera[None], self.config.tan_half_fov, jnp.ones(1))
        return mean + jnp.exp(log_deviation) * jax.random.normal(key, (draws, len(mean)))

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "n k"]:
        """Draws of N(0, I)."""
        return jax.random.normal(key, (count, self.config.latent))

    def render(
        self, state: Float[Array, "k"], T_object_camera: Float[Array, "v 4 4"], size: int
    ) -> Float[Array, "v s s 3"]:
        """Square pictures, in [0, 1]."""
        config = self.config
        field = partial(self.field, state)
        return rendered(field, config.box, config.tan_half_fov, T_object_camera, size, config.samples)


def loss(
    model: NeRFVAE, pictures: Pictures, key: PRNGKeyArray, progress: Float[Array, ""]
) -> tuple[Float[Array, ""], Metrics]:
    """-ELBO of a picture per pixel, and its parts, after this share of the training."""
    config = model.config
    k0, k1, k2, k3, k4, k5 = jax.random.split(key, 6)
    count, views, size = pictures.rgb.shape[:3]
    objects = jax.random.randint(k0, (config.objects,), 0, count)
    given = jax.random.randint(k1, (config.objects, MOST_GIVEN), 0, views)
    used = jnp.arange(MOST_GIVEN) < jax.random.randint(k2, (config.objects, 1), 1, MOST_GIVEN + 1)
    targets = jax.random.randint(k3, (config.objects, config.rays), 0, views)
    rays = draw_rays(pictures, objects, targets, k4)

    def one(rgb, T, used, origin, direction, key):
        """Colours of an object's rays at a draw of z, and its KL in closed form."""
        k0, k1 = jax.random.split(key)
        mean, log_deviation = model.encoder(rgb, T, config.tan_half_fov, used)
        z = mean + jnp.exp(log_deviation) * jax.random.normal(k0, mean.shape)
        seen, _ = integrate(partial(model.field, z), config.box, origin, direction, config.samples, k1)
        kl = jnp.sum(0.5 * (mean**2 + jnp.exp(2.0 * log_deviation) - 1.0) - log_deviation)
        return seen, kl

    at = objects[:, None], given
    rgb, kl = jax.vmap(one)(
        pictures.rgb[at],
        pictures.T_object_camera[at],
        used.astype(jnp.float32),
        rays.origin,
        rays.direction,
        jax.random.split(k5, config.objects),
    )
    squared = jnp.mean(rays.weight * jnp.sum((rgb - rays.rgb) ** 2, axis=-1))
    factor = jnp.minimum(progress / config.warm_up, 1.0)
    total = 0.5 * squared / config.noise**2 + factor * jnp.mean(kl) / size**2
    return total, {"mse": squared / 3.0, "kl": jnp.mean(kl)}


def nerf_vae_recipe(config: NeRFVAEConfig) -> Recipe:
    """One phase of Adam on `loss`."""

    def start(key):
        model = NeRFVAE(config, key)
        return model, optimiser().init(model)

    def step(state, pictures, progress, key):
        model, moments = state
        gradient, metrics = jax.grad(loss, has_aux=True)(model, pictures, key, progress)
        return descend(model, gradient, moments, rate(progress, config.peak_rate)), metrics

    return Recipe(start, (Phase("elbo", step),), lambda state: state[0])
