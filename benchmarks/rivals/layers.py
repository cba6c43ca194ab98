"""Layers of the rivals' networks: points through dense layers in half precision, pictures through convolutions."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def fast(x: Array) -> Array:
    """The same in bfloat16 where there is an accelerator; as it is on a CPU, which is slow at that."""
    return x if jax.default_backend() == "cpu" else x.astype(jnp.bfloat16)


def encoded(points: Float[Array, "... 3"], octaves: int) -> Float[Array, "... e"]:
    """[x, sin(2^j pi x), cos(2^j pi x)], j < octaves (NeRF, eq. 4): 3 (1 + 2 octaves) features."""
    angles = jnp.pi * points[..., None, :] * 2.0 ** jnp.arange(octaves)[:, None]
    waves = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1)
    return jnp.concatenate([points, waves.reshape(*points.shape[:-1], 6 * octaves)], axis=-1)


class Dense(eqx.Module):
    """x W + b on the last axis, computed by `fast`. He's initialisation times `gain`."""

    weight: Float[Array, "i o"]
    bias: Float[Array, "o"]

    def __init__(self, inputs: int, outputs: int, key: PRNGKeyArray, gain: float = 1.0):
        self.weight = gain * (2.0 / inputs) ** 0.5 * jax.random.normal(key, (inputs, outputs))
        self.bias = jnp.zeros(outputs)

    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        """In the precision of `fast`."""
        return fast(x) @ fast(self.weight) + fast(self.bias)


class ConditionedBlock(eqx.Module):
    """A residual block of two dense layers with an input of its own: h' = h + C c, then h' + W2 relu(W1 relu(h')).

    pixelNeRF, figure 8 of its supplement.
    """

    condition: Dense
    inner: Dense
    outer: Dense

    def __init__(self, width: int, condition: int, key: PRNGKeyArray):
        k0, k1, k2 = jax.random.split(key, 3)
        self.condition = Dense(condition, width, k0, gain=0.5)
        self.inner = Dense(width, width, k1)
        self.outer = Dense(width, width, k2, gain=0.3)

    def __call__(self, h: Float[Array, "... w"], condition: Float[Array, "... c"]) -> Float[Array, "... w"]:
        """`condition` broadcasts over points."""
        h = h + self.condition(condition)
        return h + self.outer(jax.nn.relu(self.inner(jax.nn.relu(h))))


class ConvolutionBlock(eqx.Module):
    """A residual block of two 3x3 convolutions on c[h w], the first with this stride."""

    first: eqx.nn.Conv2d
    second: eqx.nn.Conv2d
    shortcut: eqx.nn.Conv2d
    norms: tuple[eqx.nn.GroupNorm, eqx.nn.GroupNorm]

    def __init__(self, inputs: int, outputs: int, key: PRNGKeyArray, stride: int = 1):
        k0, k1, k2 = jax.random.split(key, 3)
        self.first = eqx.nn.Conv2d(inputs, outputs, 3, stride, 1, key=k0)
        self.second = eqx.nn.Conv2d(outputs, outputs, 3, 1, 1, key=k1)
        self.shortcut = eqx.nn.Conv2d(inputs, outputs, 1, stride, key=k2)
        self.norms = eqx.nn.GroupNorm(8, outputs), eqx.nn.GroupNorm(8, outputs)

    def __call__(self, x: Float[Array, "i h w"]) -> Float[Array, "o h2 w2"]:
        """relu(norm(conv(relu(norm(conv(x)))) + shortcut(x)))."""
        h = jax.nn.relu(self.norms[0](self.first(x)))
        return jax.nn.relu(self.norms[1](self.second(h)) + self.shortcut(x))


def descent(channels: tuple[int, ...], key: PRNGKeyArray) -> tuple[ConvolutionBlock, ...]:
    """Blocks that halve the picture each, between these numbers of channels."""
    keys = jax.random.split(key, len(channels) - 1)
    return tuple(ConvolutionBlock(i, o, k, stride=2) for (i, o), k in zip(pairwise(channels), keys, strict=True))


def doubled(x: Float[Array, "c h w"]) -> Float[Array, "c h2 w2"]:
    """Twice the size, by repetition."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)


def parameters(model: eqx.Module) -> int:
    """How many numbers training finds."""
    return sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array)))
