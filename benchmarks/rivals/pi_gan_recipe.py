"""How the pi-GAN learns: a step of the discriminator and one of the generator, on pictures that grow."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from benchmarks.rivals.discriminator import Discriminator, halved
from benchmarks.rivals.model import picture_rays
from benchmarks.rivals.pi_gan import PiGAN, PiGANConfig
from benchmarks.rivals.recipe import Metrics, Phase, Recipe
from benchmarks.rivals.volume import Pictures

FADE = 0.15  # of a size's time, in which it comes in
GENERATOR_RATE, DISCRIMINATOR_RATE = 2e-4, 4e-4
PENALTY = 1.0  # R1: half of it times the squared gradient at real pictures
MEMORY = 0.998  # of the mean of the generator's weights


class GANState(eqx.Module):
    """All that a step changes."""

    generator: PiGAN
    mean_generator: PiGAN  # what is kept
    moments: optax.OptState  # of the generator
    discriminator: Discriminator
    discriminator_moments: optax.OptState
    steps: Float[Array, ""]


def optimiser() -> optax.GradientTransformation:
    """Adam as in the paper, but for its rate."""
    return optax.chain(optax.clip_by_global_norm(10.0), optax.scale_by_adam(b1=0.0, b2=0.99))


def draw_real(
    pictures: Pictures, size: int, batch: int, key: PRNGKeyArray
) -> tuple[Float[Array, "b 3 s s"], Float[Array, "b 4 4"]]:
    """Random pictures in [-1, 1] and their cameras."""
    k0, k1 = jax.random.split(key)
    count, views, full = pictures.rgb.shape[:3]
    at = jax.random.randint(k0, (batch,), 0, count), jax.random.randint(k1, (batch,), 0, views)
    rgb = jnp.moveaxis(pictures.rgb[at] / 127.5 - 1.0, 3, 1)
    while full > size:
        rgb, full = halved(rgb), full // 2
    return rgb, pictures.T_object_camera[at]


def draw_fake(
    generator: PiGAN, T_object_camera: Float[Array, "b 4 4"], size: int, key: PRNGKeyArray
) -> Float[Array, "b 3 s s"]:
    """Pictures of samples, in [-1, 1]."""
    k0, k1 = jax.random.split(key)
    batch = len(T_object_camera)

    def one(z, T, key):
        origin, direction = picture_rays(T, generator.config.tan_half_fov, size)
        rgb = generator.colours(generator.style(z), origin, direction, key)
        return jnp.moveaxis(2.0 * rgb.reshape(size, size, 3) - 1.0, 2, 0)

    z = jax.random.normal(k0, (batch, generator.config.latent))
    return jax.vmap(one)(z, T_object_camera, jax.random.split(k1, batch))


def step(
    stage: int, state: GANState, pictures: Pictures, progress: Float[Array, ""], key: PRNGKeyArray
) -> tuple[GANState, Metrics]:
    """One step of both at this share of a size's time: non-saturating losses and R1 (pi-GAN, eq. 6)."""
    config = state.generator.config
    k0, k1, k2, k3 = jax.random.split(key, 4)
    size, batch, last = config.sizes[stage], config.batches[stage], stage == len(config.sizes) - 1
    new = jnp.minimum(progress / FADE, 1.0) if stage else jnp.ones(())
    slower = 0.5 * (1.0 + jnp.cos(jnp.pi * progress)) if last else jnp.ones(())
    real, cameras = draw_real(pictures, size, batch, k0)
    fake = draw_fake(state.generator, cameras, size, k1)

    def discriminator_loss(discriminator):
        """With the penalty R1: the squared slope of its answers to real pictures."""

        def summed(pictures):
            logits = discriminator(pictures, cameras, new)
            return jnp.sum(logits), logits

        slope, on_real = jax.grad(summed, has_aux=True)(real)
        on_fake = discriminator(fake, cameras, new)
        steepness = jnp.mean(jnp.sum(slope**2, axis=(1, 2, 3)))
        loss = jnp.mean(jax.nn.softplus(-on_real) + jax.nn.softplus(on_fake))
        metrics = {"discriminator": loss, "r1": steepness, "real": jnp.mean(on_real), "fake": jnp.mean(on_fake)}
        return loss + 0.5 * PENALTY * steepness, metrics

    def generator_loss(generator):
        _, at = draw_real(pictures, size, batch, k2)
        return jnp.mean(jax.nn.softplus(-discriminator(draw_fake(generator, at, size, k3), at, new)))

    slopes, metrics = jax.grad(discriminator_loss, has_aux=True)(state.discriminator)
    moments = state.discriminator_moments
    discriminator, discriminator_moments = _moved(state.discriminator, slopes, moments, DISCRIMINATOR_RATE * slower)
    value, slopes = jax.value_and_grad(generator_loss)(state.generator)
    generator, moments = _moved(state.generator, slopes, state.moments, GENERATOR_RATE * slower)
    kept = jnp.minimum(MEMORY, (1.0 + state.steps) / (10.0 + state.steps))
    mean = jax.tree.map(lambda old, now: kept * old + (1.0 - kept) * now, state.mean_generator, generator)
    moved = GANState(generator, mean, moments, discriminator, discriminator_moments, state.steps + 1.0)
    return moved, {"generator": value, **metrics}


def _moved(network, slopes, moments, size):
    updates, moments = optimiser().update(slopes, moments)
    return optax.apply_updates(network, jax.tree.map(lambda update: -size * update, updates)), moments


def pi_gan_recipe(config: PiGANConfig) -> Recipe:
    """A phase for each size."""

    def start(key):
        k0, k1 = jax.random.split(key)
        generator = PiGAN(config, k0)
        discriminator = Discriminator(config.sizes[0], len(config.sizes), config.channels, k1)
        moments = optimiser().init(generator), optimiser().init(discriminator)
        # two copies: a donated buffer must not be given twice
        mean = jax.tree.map(jnp.copy, generator)
        return GANState(generator, mean, moments[0], discriminator, moments[1], jnp.zeros(()))

    sizes = enumerate(zip(config.sizes, config.shares, strict=True))
    phases = tuple(Phase(f"{size} px", partial(step, stage), share) for stage, (size, share) in sizes)
    return Recipe(start, phases, lambda state: state.mean_generator)
