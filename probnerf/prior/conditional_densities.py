"""Conditional densities with exact draws: yaws on the circle, a small Gaussian mixture, and a flow of couplings.

All start, untrained, close to the standard-normal prior (the yaw's: uniform).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.prior.picture_summary import affine

_LOG_2PI = float(np.log(2.0 * np.pi))
# Standard deviations of yaw, radians. The widest is so narrow that three turns of it hold all mass but 1e-12.
_YAW_SIGMA = (0.01, 1.2)


def _bounded(x: Array, limit: float) -> Array:
    """x near 0, and between -limit and limit: a network's output cannot overflow an exponential."""
    return limit * jnp.tanh(x / limit)


def zeroed(linear: eqx.nn.Linear) -> eqx.nn.Linear:
    """The layer with zeros: what it drives starts at its neutral value."""
    return jax.tree.map(jnp.zeros_like, linear)


class YawMixture(eqx.Module):
    """A mixture of the uniform density and normal ones that are wrapped around the circle."""

    log_weight: Float[Array, "c1"]  # the uniform one's is the last
    mean: Float[Array, "c"]  # radians
    sigma: Float[Array, "c"]

    @staticmethod
    def outputs(components: int) -> int:
        """Number of values that `of` takes."""
        return 3 * components + 1

    @classmethod
    def of(cls, output: Float[Array, "o"]) -> "YawMixture":
        """The mixture from a network's output. Zeros give even means and a density that is almost uniform."""
        count = len(output) // 3
        even = jnp.arange(count) * (2.0 * jnp.pi / count)
        low, high = np.log(_YAW_SIGMA)
        start = np.log(np.clip(4.0 / count, *(1.01 * _YAW_SIGMA[0], 0.99 * _YAW_SIGMA[1])))
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        spread = jnp.tanh(output[2 * count : 3 * count] + np.arctanh((start - middle) / half))
        weight = jax.nn.log_softmax(jnp.concatenate([output[:count], output[3 * count :]]))
        return cls(weight, even + output[count : 2 * count], jnp.exp(middle + half * spread))

    def log_density(self, yaw: Float[Array, "n"]) -> Float[Array, "n"]:
        """Log-density with respect to radians."""
        # the angle between yaw and mean, in [-pi, pi); then its turns
        apart = jnp.mod(yaw[:, None] - self.mean + jnp.pi, 2.0 * jnp.pi) - jnp.pi
        white = (apart[..., None] + 2.0 * jnp.pi * jnp.arange(-1.0, 2.0)) / self.sigma[:, None]
        each = logsumexp(-0.5 * white**2, axis=-1) - jnp.log(self.sigma) - 0.5 * _LOG_2PI
        uniform = jnp.full((len(yaw), 1), -_LOG_2PI)
        return logsumexp(jnp.concatenate([each, uniform], axis=1) + self.log_weight, axis=1)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count"]:
        """Independent draws, in [-pi, pi)."""
        which, noise, even = jax.random.split(key, 3)
        k = jax.random.categorical(which, self.log_weight, shape=(count,))
        normal = jnp.append(self.mean, 0.0)[k] + jnp.append(self.sigma, 0.0)[k] * jax.random.normal(noise, (count,))
        uniform = jax.random.uniform(even, (count,), maxval=2.0 * jnp.pi)
        yaw = jnp.where(k == len(self.mean), uniform, normal)
        return jnp.mod(yaw + jnp.pi, 2.0 * jnp.pi) - jnp.pi


class TripleMixture(eqx.Module):
    """Mixtures of Gaussians in three dimensions, one for each row. The precision's root is diag(scale) (I + lower)."""

    log_weight: Float[Array, "n c"]
    mean: Float[Array, "n c 3"]
    log_scale: Float[Array, "n c 3"]
    lower: Float[Array, "n c 3"]  # entries (1, 0), (2, 0) and (2, 1)

    @staticmethod
    def outputs(components: int) -> int:
        """Number of values per row that `of` takes."""
        return 10 * components

    @classmethod
    def of(cls, output: Float[Array, "n o"]) -> "TripleMixture":
        """The mixture from a network's output. Zeros give N(0, I)."""
        count = output.shape[-1] // 10
        weight, each = output[:, :count], output[:, count:].reshape(len(output), count, 9)
        scale, lower = _bounded(each[..., 3:6], 5.0), _bounded(each[..., 6:], 10.0)
        return cls(jax.nn.log_softmax(weight), each[..., :3], scale, lower)

    def log_density(self, x: Float[Array, "n 3"]) -> Float[Array, "n"]:
        """Log-density of each row's point."""
        d0, d1, d2 = jnp.moveaxis(x[:, None] - self.mean, -1, 0)
        l10, l20, l21 = jnp.moveaxis(self.lower, -1, 0)
        white = jnp.exp(self.log_scale) * jnp.stack([d0, d1 + l10 * d0, d2 + l20 * d0 + l21 * d1], axis=-1)
        each = jnp.sum(self.log_scale - 0.5 * white**2 - 0.5 * _LOG_2PI, axis=-1)
        return logsumexp(self.log_weight + each, axis=-1)

    def draw(self, key: PRNGKeyArray) -> Float[Array, "n 3"]:
        """One draw for each row."""
        which, noise = jax.random.split(key)
        k = jax.random.categorical(which, self.log_weight)

        def chosen(a: Array) -> Array:
            return jnp.take_along_axis(a, k[:, None, None], axis=1)[:, 0]

        n0, n1, n2 = (jax.random.normal(noise, (len(k), 3)) * jnp.exp(-chosen(self.log_scale))).T
        l10, l20, l21 = chosen(self.lower).T
        d1 = n1 - l10 * n0
        return chosen(self.mean) + jnp.stack([n0, d1, n2 - l20 * n0 - l21 * d1], axis=-1)


class Coupling(eqx.Module):
    """b -> b exp(s(a, c)) + t(a, c) of one half, given the other half a and a condition c (Dinh et al., 2017)."""

    first: eqx.nn.Linear
    condition: eqx.nn.Linear
    last: eqx.nn.Linear

    def __init__(self, inputs: int, outputs: int, condition: int, hidden: int, key: PRNGKeyArray):
        k0, k1, k2 = jax.random.split(key, 3)
        self.first = eqx.nn.Linear(inputs, hidden, key=k0)
        self.condition = eqx.nn.Linear(condition, hidden, use_bias=False, key=k1)
        self.last = zeroed(eqx.nn.Linear(hidden, 2 * outputs, key=k2))

    def __call__(self, a: Float[Array, "n i"], condition: Float[Array, "n c"]) -> tuple[Array, Array]:
        """Shift and bounded log-scale."""
        hidden = jax.nn.silu(affine(self.first, a) + affine(self.condition, condition))
        shift, scale = jnp.split(affine(self.last, hidden), 2, axis=-1)
        return shift, _bounded(scale, 2.0)


class ConditionalFlow(eqx.Module):
    """x = mean(c) + sd(c) T(u; c), u ~ N(0, I): couplings between fixed permutations, then an amortised Gaussian."""

    couplings: tuple[Coupling, ...]
    gaussian: eqx.nn.Linear
    permutations: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # before each coupling

    def __init__(self, dim: int, condition: int, hidden: int, couplings: int, key: PRNGKeyArray):
        keys = jax.random.split(key, couplings + 1)
        half = dim // 2
        self.couplings = tuple(Coupling(half, dim - half, condition, hidden, k) for k in keys[1:])
        self.gaussian = zeroed(eqx.nn.Linear(condition, 2 * dim, key=keys[0]))
        # Odd couplings change what the even ones before them left. Between pairs the order is random, but fixed.
        random = np.random.default_rng(0)
        swap = np.roll(np.arange(dim), half)
        orders = [swap if i % 2 else random.permutation(dim) for i in range(couplings)]
        self.permutations = tuple(tuple(int(j) for j in order) for order in orders)

    def forward(self, u: Float[Array, "n k"], condition: Float[Array, "n c"]) -> tuple[Array, Float[Array, "n"]]:
        """x and log |dx/du|."""
        log_det = jnp.zeros(len(u))
        half = u.shape[-1] // 2
        for coupling, order in zip(self.couplings, self.permutations, strict=True):
            u = u[:, np.array(order)]
            shift, scale = coupling(u[:, :half], condition)
            u = jnp.concatenate([u[:, :half], u[:, half:] * jnp.exp(scale) + shift], axis=1)
            log_det += jnp.sum(scale, axis=-1)
        mean, log_sd = self._gaussian(condition)
        return mean + jnp.exp(log_sd) * u, log_det + jnp.sum(log_sd, axis=-1)

    def inverse(self, x: Float[Array, "n k"], condition: Float[Array, "n c"]) -> tuple[Array, Float[Array, "n"]]:
        """u and log |du/dx|."""
        mean, log_sd = self._gaussian(condition)
        u, log_det = (x - mean) * jnp.exp(-log_sd), -jnp.sum(log_sd, axis=-1)
        half = x.shape[-1] // 2
        for coupling, order in zip(reversed(self.couplings), reversed(self.permutations), strict=True):
            shift, scale = coupling(u[:, :half], condition)
            u = jnp.concatenate([u[:, :half], (u[:, half:] - shift) * jnp.exp(-scale)], axis=1)
            u = u[:, np.argsort(order)]
            log_det -= jnp.sum(scale, axis=-1)
        return u, log_det

    def _gaussian(self, condition: Float[Array, "n c"]) -> tuple[Array, Array]:
        mean, log_sd = jnp.split(affine(self.gaussian, condition), 2, axis=-1)
        return mean, _bounded(log_sd, 4.0)
