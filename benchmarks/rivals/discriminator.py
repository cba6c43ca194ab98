"""The discriminator of the pi-GAN: a residual network on pictures that grow, told the camera. It is not kept."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from benchmarks.rivals.layers import Dense


def halved(pictures: Float[Array, "*b h w"]) -> Float[Array, "*b h2 w2"]:
    """Half the size, by means of 2x2 pixels."""
    *rest, h, w = pictures.shape
    return pictures.reshape(*rest, h // 2, 2, w // 2, 2).mean(axis=(-3, -1))


class Halving(eqx.Module):
    """A residual block of two convolutions and a mean of 2x2 pixels."""

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d
    shortcut: eqx.nn.Conv2d

    def __init__(self, inputs: int, outputs: int, key: PRNGKeyArray):
        k0, k1, k2 = jax.random.split(key, 3)
        self.first = eqx.nn.Conv2d(inputs, outputs, 3, 1, 1, key=k0)
        self.second = eqx.nn.Conv2d(outputs, outputs, 3, 1, 1, key=k1)
        self.shortcut = eqx.nn.Conv2d(inputs, outputs, 1, use_bias=False, key=k2)

    def __call__(self, x: Float[Array, "i h w"]) -> Float[Array, "o h2 w2"]:
        """(shortcut(x) + convolutions(x)) / sqrt 2, halved."""
        h = jax.nn.leaky_relu(self.first(x), 0.2)
        h = jax.nn.leaky_relu(self.second(h), 0.2)
        return halved((h + self.shortcut(x)) / jnp.sqrt(2.0))


class Discriminator(eqx.Module):
    """How real pictures look from their cameras. A picture of 2^k times the smallest size enters k blocks earlier."""

    enter: tuple[eqx.nn.Conv2d, ...]  # of each size, the smallest last
    blocks: tuple[Halving, ...]  # the same, and those of the smallest size down to 4 px
    summary: Dense
    camera: tuple[Dense, Dense]
    verdict: Dense

    def __init__(self, smallest: int, sizes: int, channels: tuple[int, ...], key: PRNGKeyArray):
        """`channels` of each size from the largest to 4 px."""
        k0, k1, k2, k3, k4, k5 = jax.random.split(key, 6)
        pairs = list(pairwise(channels))
        if smallest * 2 ** (sizes - 1) != 4 * 2 ** len(pairs):
            raise ValueError(
                f"{channels} are not the channels of {sizes} sizes from {smallest} px and of those down to 4"
            )
        keys = jax.random.split(k0, sizes)
        self.enter = tuple(eqx.nn.Conv2d(3, c, 1, key=k) for c, k in zip(channels[:sizes], keys, strict=True))
        self.blocks = tuple(Halving(*pair, k) for pair, k in zip(pairs, jax.random.split(k1, len(pairs)), strict=True))
        self.summary = Dense(16 * channels[-1] + 1, 256, k2)
        self.camera = Dense(9, 64, k3), Dense(64, 256, k4)
        self.verdict = Dense(256, 1, k5)

    def __call__(
        self, pictures: Float[Array, "b 3 s s"], T_object_camera: Float[Array, "b 4 4"], new: Float[Array, ""]
    ) -> Float[Array, "b"]:
        """Logits; rgb in [-1, 1]. `new` fades the largest size in: at 0 only the picture of half the size counts."""
        size = pictures.shape[-1]
        start = len(self.blocks) - (size // 4).bit_length() + 1

        def entered(x, k):
            return jax.nn.leaky_relu(jax.vmap(self.enter[k])(x), 0.2)

        x = jax.vmap(self.blocks[start])(entered(pictures, start))
        if start + 1 < len(self.enter):
            x = new * x + (1.0 - new) * entered(halved(pictures), start + 1)
        for block in self.blocks[start + 1 :]:
            x = jax.vmap(block)(x)
        spread = jnp.mean(jnp.sqrt(jnp.var(x, axis=0) + 1e-8))  # of the batch: low where all samples look alike
        x = jnp.concatenate([x.reshape(len(x), -1), jnp.full((len(x), 1), spread)], axis=-1)
        h = jax.nn.leaky_relu(self.summary(x), 0.2)
        camera = self.camera[1](jax.nn.leaky_relu(self.camera[0](T_object_camera[:, :3, :3].reshape(-1, 9)), 0.2))
        match = jnp.sum((h * camera).astype(jnp.float32), axis=-1) / jnp.sqrt(h.shape[-1])
        return self.verdict(h)[:, 0].astype(jnp.float32) + match
