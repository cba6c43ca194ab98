"""Functa (Dupont et al. 2022) of radiance fields: a SIREN whose layers are shifted by a latent of each object.

Weights are learnt so that three gradient steps from zero find an object's latent. The prior over latents is the
RealNVP of ProbNeRF, as in that paper's comparison, or a diffusion model, as in Dupont et al. Smaller than theirs, for
64x64 pictures.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from benchmarks.rivals.diffusion import Diffusion
from benchmarks.rivals.layers import fast
from benchmarks.rivals.model import picture_rays, rendered
from benchmarks.rivals.volume import Box, integrate
from probnerf.prior.networks import RealNVP

FIRST_STEP = 5.0  # of the inner loop, before it is learnt: about what lowers the loss most in a new field


@dataclass(frozen=True)
class FunctaConfig:
    """Sizes of the networks, how they are trained, and the search for a MAP latent."""

    box: Box
    """Outside is nothing."""
    tan_half_fov: float
    """Of all cameras."""
    width: int = 256
    layers: int = 6
    """Sines in a row."""
    frequency: float = 10.0
    """omega_0 of a sine."""
    latent: int = 128
    density_scale: float = 30.0
    """Per cube unit."""
    samples: int = 48
    """On a ray of a picture."""
    training_samples: int = 32
    """On a ray while the field learns."""
    objects: int = 12
    """A step."""
    rays: int = 192
    """An object and inner step."""
    inner_steps: int = 3
    flow_hidden: int = 512
    flow_pairs: int = 4
    diffusion_width: int = 384
    diffusion_blocks: int = 3
    map_steps: int = 1000
    map_rays: int = 512
    """A step."""
    map_rate: float = 0.03
    """First step size of Adam, in deviations of a latent."""
    noise: float = 0.1
    """Deviation of a colour in a picture; of ProbNeRF's."""


class Siren(eqx.Module):
    """Points to density and colour. Layer i is sin(omega (W_i h + b_i + shift_i)), the last one linear."""

    first: Float[Array, "3 w"]
    hidden: Float[Array, "l w w"]
    biases: Float[Array, "l1 w"]
    last: Float[Array, "w 4"]
    last_bias: Float[Array, "4"]

    def __init__(self, config: FunctaConfig, key: PRNGKeyArray):
        """As in Sitzmann et al. 2020."""
        k0, k1, k2, k3 = jax.random.split(key, 4)
        width, bound = config.width, (6.0 / config.width) ** 0.5
        self.first = jax.random.uniform(k0, (3, width), minval=-1.0, maxval=1.0)
        hidden = jax.random.uniform(k1, (config.layers - 1, width, width), minval=-bound, maxval=bound)
        self.hidden = hidden / config.frequency
        self.biases = jax.random.uniform(k2, (config.layers, width), minval=-1.0, maxval=1.0) / config.frequency
        self.last = jax.random.uniform(k3, (width, 4), minval=-bound, maxval=bound)
        self.last_bias = jnp.zeros(4)

    def __call__(
        self, points: Float[Array, "n 3"], shifts: Float[Array, "l w"], frequency: float
    ) -> Float[Array, "n 4"]:
        """In single precision; the products of hidden layers in that of `fast`."""
        shifts = shifts + self.biases
        h = jnp.sin(frequency * (points @ self.first + shifts[0]))
        for weight, shift in zip(self.hidden, shifts[1:], strict=True):
            product = jnp.matmul(fast(h), fast(weight), preferred_element_type=jnp.float32)
            h = jnp.sin(frequency * (product + shift))
        return jnp.matmul(fast(h), fast(self.last), preferred_element_type=jnp.float32) + self.last_bias


class Functa(eqx.Module):
    """The shared field, the steps of its inner loop, and priors of latents. A state is a latent [k]."""

    config: FunctaConfig = eqx.field(static=True)
    siren: Siren
    modulation: Float[Array, "k l w"]
    log_step: Float[Array, "k"]  # of the inner loop (meta-SGD)
    mean: Float[Array, "k"]  # of the functaset
    deviation: Float[Array, "k"]
    flow: RealNVP
    diffusion: Diffusion

    def __init__(self, config: FunctaConfig, key: PRNGKeyArray):
        k0, k1, k2, k3 = jax.random.split(key, 4)
        self.config = config
        self.siren = Siren(config, k0)
        shape = (config.latent, config.layers, config.width)
        self.modulation = jax.random.normal(k1, shape) / (config.frequency * config.latent**0.5)
        self.log_step = jnp.full(config.latent, jnp.log(FIRST_STEP))
        self.mean, self.deviation = jnp.zeros(config.latent), jnp.ones(config.latent)
        self.flow = RealNVP(config.latent, config.flow_hidden, k2, config.flow_pairs)
        self.diffusion = Diffusion(config.latent, config.diffusion_width, config.diffusion_blocks, k3)

    def field(self, latent: Float[Array, "k"], points: Float[Array, "n 3"]) -> tuple[Array, Array]:
        """sigma [n] and rgb [n 3] at points of the object's frame."""
        shifts = jnp.einsum("k,klw->lw", latent, self.modulation)
        raw = self.siren(points, shifts, self.config.frequency)
        return self.config.density_scale * jax.nn.softplus(raw[:, 0] - 2.0), jax.nn.sigmoid(raw[:, 1:])

    def colours(
        self,
        latent: Float[Array, "k"],
        origin: Float[Array, "n 3"],
        direction: Float[Array, "n 3"],
        key: PRNGKeyArray,
        samples: int,
    ) -> Float[Array, "n 3"]:
        """Of rays, on white, with as many random samples."""
        box = self.config.box
        return integrate(lambda points, _: self.field(latent, points), box, origin, direction, samples, key)[0]

    def log_prior(self, latent: Float[Array, "k"]) -> Float[Array, ""]:
        """Of a latent in units of the functaset's deviations from its mean, under the flow; up to a constant."""
        normal, log_det = self.flow.inverse(latent)
        return log_det - 0.5 * jnp.sum(normal**2)

    def condition(
        self, picture: UInt8[Array, "s s 3"], T_object_camera: Float[Array, "4 4"], key: PRNGKeyArray, draws: int
    ) -> Float[Array, "d k"]:
        """The MAP latent under the flow's prior (Dupont et al., eq. 2), `draws` times the same.

        Adam climbs from the functaset's mean, each time with some of the picture's rays.
        """
        config, size = self.config, len(picture)
        origin, direction = picture_rays(T_object_camera, config.tan_half_fov, size)
        truth = jnp.asarray(picture).reshape(-1, 3) / 255.0

        def loss(normal, key):
            """-log p(picture, latent), estimated from some rays; the latent in units of the functaset's deviations."""
            k0, k1 = jax.random.split(key)
            rays = jax.random.randint(k0, (config.map_rays,), 0, size * size)
            rgb = self.colours(self.mean + self.deviation * normal, origin[rays], direction[rays], k1, config.samples)
            misfit = 0.5 * size * size * jnp.mean(jnp.sum((rgb - truth[rays]) ** 2, axis=-1)) / config.noise**2
            return misfit - self.log_prior(normal)

        optimiser = optax.adam(optax.cosine_decay_schedule(config.map_rate, config.map_steps))

        def climb(carry, key):
            normal, state = carry
            updates, state = optimiser.update(jax.grad(loss)(normal, key), state)
            return (normal + updates, state), None

        start = jnp.zeros(config.latent)
        keys = jax.random.split(key, config.map_steps)
        normal = jax.lax.scan(climb, (start, optimiser.init(start)), keys)[0][0]
        return jnp.broadcast_to(self.mean + self.deviation * normal, (draws, config.latent))

    def render(
        self, state: Float[Array, "k"], T_object_camera: Float[Array, "v 4 4"], size: int
    ) -> Float[Array, "v s s 3"]:
        """Square pictures of an object, in [0, 1]."""
        config = self.config
        field = lambda points, _: self.field(state, points)  # noqa: E731
        return rendered(field, config.box, config.tan_half_fov, T_object_camera, size, config.samples)

    def sample(self, key: PRNGKeyArray, count: int) -> Float[Array, "n k"]:
        """Latents from the flow's prior."""
        normal = jax.random.normal(key, (count, self.config.latent))
        return self.mean + self.deviation * jax.vmap(self.flow.forward)(normal)[0]

    def sample_diffusion(self, key: PRNGKeyArray, count: int) -> Float[Array, "n k"]:
        """Latents from the diffusion model's prior."""
        return self.mean + self.deviation * self.diffusion.sample(key, count)
