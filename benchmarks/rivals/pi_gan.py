"""A pi-GAN (Chan et al. 2021): a generator of radiance fields that learns from pictures against a discriminator.

z ~ N(0, I) goes through a mapping network to the frequencies and phases of a SIREN. There is no way from a picture to
z, so it only samples. Smaller than the published one. Cameras are those of the data, which are known here, so the
discriminator is told them (a projection discriminator, as EG3D's): without that, it would have to find the canonical
pose by itself. It also sees how far the pictures of a batch differ, as progressive GANs' do. Pictures grow from 16 to
32 px; the field can be rendered at any size.
"""

import math
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from benchmarks.rivals.layers import Dense, fast
from benchmarks.rivals.model import rendered
from benchmarks.rivals.volume import Box, integrate


@dataclass(frozen=True)
class PiGANConfig:
    """Sizes of the generator, and how it is trained."""

    box: Box
    """Outside is nothing."""
    tan_half_fov: float
    """Of all cameras."""
    latent: int = 64
    mapping: int = 128
    """Width of the mapping network, of three layers."""
    width: int = 96
    layers: int = 5
    """Sine layers before the density."""
    samples: int = 20
    """On a ray, in training; in pictures of `render`, twice as many."""
    density_scale: float = 30.0
    """Per cube unit."""
    sizes: tuple[int, ...] = (16, 32)
    """px a side of what it learns from, one after the other."""
    shares: tuple[float, ...] = (0.3, 0.7)
    """Of the training's time."""
    batches: tuple[int, ...] = (64, 32)
    """Pictures a step."""
    channels: tuple[int, ...] = (96, 128, 192, 256)
    """Of the discriminator, from the largest size down to 4 px."""


class SineLayer(eqx.Module):
    """sin((15 frequency + 30) (W x + b) + phase) (pi-GAN, eq. 3 and its code)."""

    weight: Float[Array, "i o"]
    bias: Float[Array, "o"]

    def __init__(self, inputs: int, outputs: int, key: PRNGKeyArray, first: bool = False):
        k0, k1 = jax.random.split(key)
        span = 1.0 / inputs if first else math.sqrt(6.0 / inputs) / 25.0
        self.weight = jax.random.uniform(k0, (inputs, outputs), minval=-span, maxval=span)
        self.bias = jax.random.uniform(k1, (outputs,), minval=-1.0, maxval=1.0) / math.sqrt(inputs) / 25.0

    def __call__(self, x: Float[Array, "n i"], style: Float[Array, "2 o"]) -> Float[Array, "n o"]:
        """Products in the precision of `fast`, angles in single precision."""
        angle = jnp.dot(fast(x), fast(self.weight), preferred_element_type=jnp.float32) + self.bias
        return jnp.sin((15.0 * style[0] + 30.0) * angle + style[1])


class PiGAN(eqx.Module):
    """From z to a field. The state of an object is its style: frequencies and phases of each layer."""

    config: PiGANConfig = eqx.field(static=True)
    mapping: tuple[Dense, ...]
    layers: tuple[SineLayer, ...]
    density: Dense
    colour_layer: SineLayer
    colour: Dense

    def __init__(self, config: PiGANConfig, key: PRNGKeyArray):
        k0, k1, k2, k3, *keys = jax.random.split(key, 4 + config.layers)
        self.config = config
        sizes = (config.latent, *3 * (config.mapping,), 2 * (config.layers + 1) * config.width)
        gains = (1.0, 1.0, 1.0, 0.25)
        mapped = zip(sizes[:-1], sizes[1:], jax.random.split(k0, 4), gains, strict=True)
        self.mapping = tuple(Dense(*each) for each in mapped)
        w = config.width
        self.layers = tuple(SineLayer(3 if i == 0 else w, w, k, first=i == 0) for i, k in enumerate(keys))
        self.density = Dense(w, 1, k1, gain=0.2)
        self.colour_layer = SineLayer(w + 3, w, k2)
        self.colour = Dense(w, 3, k3, gain=0.2)

    def style(self, z: Float[Array, "k"]) -> Float[Array, "l 2 w"]:
        """The state that a latent gives."""
        h = z
        for dense in self.mapping[:-1]:
            h = jax.nn.leaky_relu(dense(h), 0.2)
        return self.mapping[-1](h).astype(jnp.float32).reshape(-1, 2, self.config.width)

    def field(
        self, style: Float[Array, "l 2 w"], points: Float[Array, "n 3"], directions: Float[Array, "n 3"]
    ) -> tuple[Array, Array]:
        """sigma [n] and rgb [n 3] at points of the object's frame."""
        low, high = jnp.asarray(self.config.box).reshape(2, 3)
        h = (points - 0.5 * (low + high)) / (0.5 * jnp.max(high - low))
        for layer, own in zip(self.layers, style[:-1], strict=True):
            h = layer(h, own)
        sigma = self.config.density_scale * jax.nn.softplus(self.density(h)[:, 0].astype(jnp.float32) - 2.0)
        h = self.colour_layer(jnp.concatenate([h, directions], axis=-1), style[-1])
        return sigma, jax.nn.sigmoid(self.colour(h).astype(jnp.float32))

    def colours(
        self,
        style: Float[Array, "l 2 w"],
        origin: Float[Array, "n 3"],
        direction: Float[Array, "n 3"],
        key: PRNGKeyArray | None = None,
    ) -> Float[Array, "n 3"]:
        """Colours of rays."""
        samples = self.config.samples
        return integrate(lambda p, d: self.field(style, p, d), self.config.box, origin, direction, samples, key)[0]

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "n l 2 w"]:
        """Styles of draws of N(0, I)."""
        return jax.vmap(self.style)(jax.random.normal(key, (count, self.config.latent)))

    def render(
        self, state: Float[Array, "l 2 w"], T_object_camera: Float[Array, "v 4 4"], size: int
    ) -> Float[Array, "v s s 3"]:
        """Square pictures, in [0, 1]."""
        config = self.config
        field = partial(self.field, state)
        return rendered(field, config.box, config.tan_half_fov, T_object_camera, size, 2 * config.samples)
