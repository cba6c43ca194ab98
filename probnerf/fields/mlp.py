"""Fields f_w(x, v): (parameters, points, directions) -> (density, colour). The MLP field and the analytic one.

Density and colour are separate calls: rays that carry no colour never pay for it.
"""

import math
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from probnerf.types import BASE_Z


def sincospi(u: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """(sin(pi u), cos(pi u)) to 3e-7: exact reduction to [-1, 1), Taylor polynomials of the half angle, one doubling.

    Plain arithmetic, which XLA vectorises and fuses: on a CPU many times faster than its sine.
    """
    h = 0.5 * (u - 2.0 * jnp.floor(0.5 * u + 0.5))  # exact in floating point; |h| <= 1/2
    y = h * h
    s = h * _polynomial(y, (3.14159265, -5.16771278, 2.55016404, -0.59926453, 0.08214589, -0.00737043))
    c = _polynomial(y, (1.0, -4.93480220, 4.05871213, -1.33526277, 0.23533063, -0.02580689, 0.00192957))
    return 2.0 * s * c, (c - s) * (c + s)


def _polynomial(y: Float[Array, "..."], coefficients: tuple[float, ...]) -> Float[Array, "..."]:
    """Horner's rule, lowest power first."""
    value = jnp.full_like(y, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * y + coefficient
    return value


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def encode(x: Float[Array, "c n"], octaves: int) -> Float[Array, "e n"]:
    """[x, sin(2^j pi x), cos(2^j pi x)], j < octaves: c (1 + 2 octaves) features, points last (paper, appendix B).

    The argument is reduced exactly every third octave with double-angle steps between: a recurrence alone loses 1e-3 by
    the tenth octave in float32. The gradient reuses the features: d sin = 2^j pi cos.
    """
    features = [x]
    s = c = x
    for j in range(octaves):
        s, c = sincospi(x * 2.0**j) if j % 3 == 0 else (2.0 * s * c, (c - s) * (c + s))
        features += [s, c]
    # the barrier keeps XLA from recomputing every feature inside the concatenation (12 times slower)
    return jnp.concatenate(jax.lax.optimization_barrier(tuple(features)), axis=0)


def _encode_forward(x, octaves):
    features = encode(x, octaves)
    return features, features


def _encode_backward(octaves, features, g):
    c = features.shape[0] // (1 + 2 * octaves)
    gradient = g[:c]
    for j in range(octaves):
        sine, cosine = slice(c + 2 * c * j, 2 * c + 2 * c * j), slice(2 * c + 2 * c * j, 3 * c + 2 * c * j)
        gradient += (2.0**j * jnp.pi) * (g[sine] * features[cosine] - g[cosine] * features[sine])
    return (gradient,)


encode.defvjp(_encode_forward, _encode_backward)


def encoded_size(octaves: int, channels: int = 3) -> int:
    """Features of one point of so many channels."""
    return channels * (1 + 2 * octaves)


def with_radius(x: Float[Array, "3 n"]) -> Float[Array, "4 n"]:
    """(x, y, z, r): the distance from the body's axis as a fourth coordinate; smoothed within 0.01 of it."""
    return jnp.concatenate([x, jnp.sqrt(x[:1] ** 2 + x[1:2] ** 2 + 1e-4)], axis=0)


STRETCH, SHIFT = 0.3, 0.1  # natural sizes of the fitted field's log-stretch and shift (cube units)


def _octave_scale(octaves: int, channels: int) -> np.ndarray:
    return np.concatenate([np.ones(channels), np.repeat(2.0 ** (-0.75 * np.arange(octaves)), 2 * channels)])


class MLPField(eqx.Module):
    """Two MLPs with two hidden layers each: density, then colour from position, direction and density (paper §2.3).

    The weights of one object are a flat vector, as the hypernetwork makes it; `shapes` unpacks it.
    """

    width: int = eqx.field(static=True, default=64)
    octaves: int = eqx.field(static=True, default=10)
    direction_octaves: int = eqx.field(static=True, default=10)
    density_scale: float = eqx.field(static=True, default=64.0)  # sigma = density_scale * softplus(output)
    radial: bool = eqx.field(static=True, default=False)  # also encode the distance from the axis (not in the paper)
    fitted: bool = eqx.field(static=True, default=False)  # the last six weights stretch and shift the points (nor this)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Kernel and bias shapes in the order of the flat vector: density MLP, colour MLP; log-stretch and shift."""
        position, direction = encoded_size(self.octaves, 3 + self.radial), encoded_size(self.direction_octaves)
        h = self.width
        layers = [(position, h), (h, h), (h, 1), (position + direction + 1, h), (h, h), (h, 3)]
        shapes: list[tuple[int, ...]] = [shape for kernel in layers for shape in (kernel, kernel[1:])]
        return shapes + [(3,), (3,)] * self.fitted

    @property
    def size(self) -> int:
        """Weights per object (20,868 in the paper's preset)."""
        return sum(math.prod(shape) for shape in self.shapes)

    @property
    def weight_scale(self) -> np.ndarray:
        """f32[size], the natural size of each weight: He's sqrt(2 / fan in), octave j of an encoding times 2^(-0.75 j).

        A hypernetwork that works in these units starts at a smooth field and learns coarse shape before detail.
        """
        scale, fan_in = [], 1
        for shape in self.shapes:
            fan_in = shape[0] if len(shape) == 2 else fan_in
            scale.append(np.full(shape, math.sqrt(2.0 / fan_in)))
        place, view = _octave_scale(self.octaves, 3 + self.radial), _octave_scale(self.direction_octaves, 3)
        for index, rows in ((0, [place]), (6, [place, view])):
            rest = np.ones(scale[index].shape[0] - sum(map(len, rows)))
            scale[index] *= np.concatenate([*rows, rest])[:, None]
        if self.fitted:
            scale[12:] = [np.full(3, STRETCH), np.full(3, SHIFT)]
        return np.concatenate([part.ravel() for part in scale]).astype(np.float32)

    def unpack(self, weights: Float[Array, "d"]) -> list[Array]:
        """The flat vector as twelve arrays, and two more where the field is fitted."""
        parts, start = [], 0
        for shape in self.shapes:
            end = start + math.prod(shape)
            parts.append(weights[start:end].reshape(shape))
            start = end
        return parts

    def _place(self, parts: list[Array], points: Float[Array, "... 3"]) -> Float[Array, "e n"]:
        """Encoded points. A fitted field first undoes the object's own stretch and shift about its support point:
        sizes and slack are then six numbers, not a change of every weight.
        """
        x = _columns(points)
        if self.fitted:
            stretch, shift = parts[12:]
            base = jnp.array([[0.0], [0.0], [BASE_Z]])
            x = (x - base - shift[:, None]) * jnp.exp(stretch)[:, None] + base
        return encode(with_radius(x) if self.radial else x, self.octaves)

    def density(self, weights: Float[Array, "d"], points: Float[Array, "... 3"]) -> Float[Array, "..."]:
        """sigma = density_scale * softplus(MLP(encode(x)))."""
        parts = self.unpack(weights)
        output = _mlp(self._place(parts, points), *parts[:6])
        return self.density_scale * jax.nn.softplus(output[0]).reshape(points.shape[:-1])

    def colour(
        self,
        weights: Float[Array, "d"],
        points: Float[Array, "... 3"],
        directions: Float[Array, "... 3"],
        sigma: Float[Array, "..."],
    ) -> Float[Array, "... 3"]:
        """RGB from encode(x), encode(v) and log(1 + sigma) (its logarithm: sigma spans 0 to thousands)."""
        parts = self.unpack(weights)
        seen = encode(_columns(directions), self.direction_octaves)
        inputs = [self._place(parts, points), seen, jnp.log1p(sigma).reshape(1, -1)]
        output = _mlp(jnp.concatenate(inputs, axis=0), *parts[6:12])
        return jax.nn.sigmoid(output).T.reshape(points.shape)


def _columns(points: Float[Array, "... 3"]) -> Float[Array, "3 n"]:
    """Points last: features become contiguous rows, several times faster through XLA on a CPU."""
    return points.reshape(-1, 3).T


def _mlp(x, k0, b0, k1, b1, k2, b2):
    h = jax.nn.relu(k0.T @ x + b0[:, None])
    h = jax.nn.relu(k1.T @ h + b1[:, None])
    return k2.T @ h + b2[:, None]
