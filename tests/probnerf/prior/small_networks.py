"""A small posterior network with random weights, and a random picture."""

import jax
import jax.numpy as jnp
import numpy as np

from probnerf.geometry import look_at
from probnerf.prior.posterior_flow import NetworkSizes, PosteriorNetwork
from probnerf.prior.posterior_network import EncoderPicture

SIZES = NetworkSizes(
    latent=3, image_size=8, patch=2, channels=8, blocks=1, context=16, harmonics=2, point_channels=2, trunk=16,
    condition=8, couplings=3, hidden=16, yaw_components=4, pose_components=2,
)  # fmt: skip
SIGMA = np.array([0.1, 0.1, 0.05, 0.02, 0.03], np.float32)


def shaken(sizes: NetworkSizes = SIZES, size: float = 0.15) -> PosteriorNetwork:
    """A network with normal weights of this standard deviation. (An untrained one's output layers are zero.)"""
    shapes = jax.eval_shape(lambda key: PosteriorNetwork(sizes, key), jax.random.key(0))
    rng = np.random.default_rng(1)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(0.0, size, a.shape), jnp.float32), shapes)


def picture(azimuth: float = 0.0, size: int = SIZES.image_size) -> EncoderPicture:
    """The same object pixels, with and without ranges, seen from this azimuth."""
    rng = np.random.default_rng(0)
    c, s = np.cos(azimuth), np.sin(azimuth)
    T = look_at(np.array([4.0 * c, 4.0 * s, 1.5]), np.zeros(3))
    distance = np.where(rng.uniform(size=(size, size)) < 0.5, rng.uniform(3.5, 4.5, (size, size)), 0.0)
    distance[:2, :2] = -1.0
    return EncoderPicture(
        jnp.asarray(rng.uniform(size=(size, size, 3)), jnp.float32),
        jnp.asarray(distance, jnp.float32),
        jnp.asarray(rng.uniform(size=(size, size)) < 0.2, jnp.float32),
        jnp.asarray(T, jnp.float32),
        jnp.asarray(0.3),
    )
