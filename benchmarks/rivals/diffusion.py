"""A denoising diffusion model of vectors (Ho, Jain and Abbeel 2020), with the cosine schedule of Nichol and Dhariwal
(2021)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

STEPS = 250  # T
TIME_FEATURES = 32
LARGEST = 4.0  # coordinate of x_0, in standard deviations


class Diffusion(eqx.Module):
    """x_0 -> x_T, which is almost standard normal; a residual network finds the noise in x_t."""

    enter: eqx.nn.Linear
    time: eqx.nn.Linear
    inner: tuple[eqx.nn.Linear, ...]
    outer: tuple[eqx.nn.Linear, ...]
    norms: tuple[eqx.nn.LayerNorm, ...]
    leave: eqx.nn.Linear

    def __init__(self, dim: int, width: int, blocks: int, key: PRNGKeyArray):
        k0, k1, k2, *keys = jax.random.split(key, 3 + 2 * blocks)
        self.enter = eqx.nn.Linear(dim, width, key=k0)
        self.time = eqx.nn.Linear(TIME_FEATURES, width, key=k1)
        self.inner = tuple(eqx.nn.Linear(width, width, key=k) for k in keys[:blocks])
        self.outer = tuple(eqx.nn.Linear(width, width, key=k) for k in keys[blocks:])
        self.norms = tuple(eqx.nn.LayerNorm(width) for _ in range(blocks))
        last = eqx.nn.Linear(width, dim, key=k2)
        self.leave = jax.tree.map(jnp.zeros_like, last)

    def noise(self, x: Float[Array, "k"], t: Int[Array, ""]) -> Float[Array, "k"]:
        """The noise that is probably in x_t, t from 0 (little noise) to `STEPS` - 1."""
        angles = (t / STEPS) * jnp.exp(jnp.linspace(0.0, jnp.log(200.0), TIME_FEATURES // 2))
        time = self.time(jnp.concatenate([jnp.sin(angles), jnp.cos(angles)]))
        h = self.enter(x)
        for inner, outer, norm in zip(self.inner, self.outer, self.norms, strict=True):
            h = h + outer(jax.nn.silu(inner(jax.nn.silu(norm(h) + time))))
        return self.leave(jax.nn.silu(h))

    def loss(self, x: Float[Array, "n k"], key: PRNGKeyArray) -> Float[Array, ""]:
        """Mean squared error of the noise at random times (Ho et al., eq. 14)."""
        k0, k1 = jax.random.split(key)
        t = jax.random.randint(k0, (len(x),), 0, STEPS)
        noise = jax.random.normal(k1, x.shape)
        kept = kept_shares()[t][:, None]
        found = jax.vmap(self.noise)(jnp.sqrt(kept) * x + jnp.sqrt(1.0 - kept) * noise, t)
        return jnp.mean((found - noise) ** 2)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "n k"]:
        """Ancestral sampling (Ho et al., eqs. 6 and 7), of vectors of standardised coordinates."""
        kept = kept_shares()
        before = jnp.concatenate([jnp.ones(1), kept[:-1]])
        k0, k1 = jax.random.split(key)

        def one(x, given):
            """x_(t-1) of x_t."""
            t, key = given
            alpha = kept[t] / before[t]
            noise = jax.vmap(self.noise, (0, None))(x, t)
            # where almost nothing of x_0 is left, its estimate could be anything
            start = jnp.clip((x - jnp.sqrt(1.0 - kept[t]) * noise) / jnp.sqrt(kept[t]), -LARGEST, LARGEST)
            shares = jnp.sqrt(before[t]) * (1.0 - alpha), jnp.sqrt(alpha) * (1.0 - before[t])
            mean = (shares[0] * start + shares[1] * x) / (1.0 - kept[t])
            sd = jnp.sqrt((1.0 - before[t]) / (1.0 - kept[t]) * (1.0 - alpha))
            return mean + sd * jax.random.normal(key, x.shape), None

        start = jax.random.normal(k0, (count, self.enter.weight.shape[1]))
        return jax.lax.scan(one, start, (jnp.arange(STEPS)[::-1], jax.random.split(k1, STEPS)))[0]


def kept_shares() -> Float[Array, "t"]:
    """The share of x_0's variance in x_t (Nichol and Dhariwal, eq. 17)."""
    wave = jnp.cos((jnp.arange(STEPS + 1) / STEPS + 0.008) / 1.008 * jnp.pi / 2) ** 2
    return jnp.cumprod(jnp.maximum(wave[1:] / wave[:-1], 0.001))
