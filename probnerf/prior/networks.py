"""The learned prior: z~ -> (RealNVP m) -> z -> (hypernetwork h) -> field weights w; and the encoder q(z | views).

Paper §2.1 to §2.3. Presets change only sizes and a few options.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.fields.mlp import MLPField, encoded_size

CAMERA_FEATURES = 13  # rotation (9), position (3), tangent of the half field of view
POINT_OCTAVES = 2  # of the encoding of each pixel's position in the object frame
IMAGE_CHANNELS = 6 + encoded_size(POINT_OCTAVES, 4)  # rgb; object, unknown and range masks; the position


@dataclass(frozen=True)
class Preset:
    """All sizes of a model. `paper` has the paper's sizes; `small` is for two CPU cores."""

    name: str
    latent: int  # K
    width: int  # hidden units of both field MLPs
    octaves: int
    direction_octaves: int
    flow_hidden: int
    hyper_hidden: int
    lattice: int  # G
    image_size: int  # encoder input, pixels
    encoder_channels: tuple[int, ...]
    radial: bool = False  # the field's input includes the distance from the body's axis
    fitted: bool = False  # the field first scales and shifts the points
    smooth: bool = False  # SiLU in the hypernetwork instead of the paper's ReLU
    pairs: int = 2  # of couplings in the flow
    explains: float = 1.0  # share of a view's pixels that its models explain of 98% of what they should know
    wall_sigma: float = 0.0  # cube units: the least `InferConfig.wall_sigma` with such a model

    @property
    def field(self) -> MLPField:
        """The field whose weights the hypernetwork outputs."""
        return MLPField(
            width=self.width,
            octaves=self.octaves,
            direction_octaves=self.direction_octaves,
            radial=self.radial,
            fitted=self.fitted,
        )


_HOUSEHOLD = Preset(
    "household",
    64,
    48,
    6,
    1,
    192,
    512,
    32,
    32,
    (24, 32, 48, 64, 128),
    radial=True,
    fitted=True,
    smooth=True,
    pairs=4,
    explains=0.61,  # of 108 things to choose by: household validation objects and scans (`farside bench strangers`)
    wall_sigma=0.1,  # chosen by the scans' scores (`farside bench strangers`)
)
PRESETS = {
    preset.name: preset
    for preset in (
        Preset("paper", 128, 64, 10, 10, 512, 512, 128, 128, (32, 64, 128, 128, 128)),
        Preset("small", 48, 48, 6, 1, 128, 256, 32, 32, (24, 32, 48, 64, 128), radial=True, fitted=True, smooth=True),
        _HOUSEHOLD,
        replace(_HOUSEHOLD, name="everyday", latent=96, flow_hidden=256, hyper_hidden=768),
        Preset("tiny", 4, 8, 2, 1, 16, 16, 8, 16, (4, 4, 4, 4, 4)),  # for tests
    )
}


def relu_layer(layer: eqx.nn.Linear | eqx.nn.Conv2d) -> Any:
    """The layer with He's scale (weights of variance 2 / fan in): ReLU layers then preserve the scale of signals."""
    assert layer.bias is not None
    scaled = layer.weight * math.sqrt(6.0)  # equinox draws uniformly with variance 1 / (3 fan in)
    return eqx.tree_at(lambda n: (n.weight, n.bias), layer, (scaled, jnp.zeros_like(layer.bias)))


class TwoLayer(eqx.Module):
    """Linear, ReLU, linear. It holds only arrays, so a model is a plain pytree for `jax.jit`."""

    first: eqx.nn.Linear
    last: eqx.nn.Linear

    def __init__(self, inputs: int, outputs: int, hidden: int, key: PRNGKeyArray):
        k0, k1 = jax.random.split(key)
        self.first = relu_layer(eqx.nn.Linear(inputs, hidden, key=k0))
        self.last = eqx.nn.Linear(hidden, outputs, key=k1)

    def __call__(self, x: Float[Array, "i"]) -> Float[Array, "o"]:
        return self.last(jax.nn.relu(self.first(x)))


class CouplingPair(eqx.Module):
    """Two affine couplings that update complementary halves, then a fixed permutation (paper §2.3)."""

    first: TwoLayer
    second: TwoLayer
    permutation: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, dim: int, hidden: int, permutation: tuple[int, ...], key: PRNGKeyArray):
        k0, k1 = jax.random.split(key)
        half = dim // 2

        def coupling(inputs: int, outputs: int, k: PRNGKeyArray) -> TwoLayer:
            net = TwoLayer(inputs, 2 * outputs, hidden, k)
            # start at the identity
            return eqx.tree_at(lambda n: n.last, net, jax.tree.map(jnp.zeros_like, net.last))

        self.first, self.second = coupling(half, dim - half, k0), coupling(dim - half, half, k1)
        self.permutation = permutation

    def forward(self, x: Float[Array, "k"]) -> tuple[Float[Array, "k"], Float[Array, ""]]:
        """y and log |dy/dx|."""
        half = x.shape[0] // 2
        a, b = x[:half], x[half:]
        shift, scale = _shift_and_scale(self.first(a))
        b = b * jnp.exp(scale) + shift
        log_det = jnp.sum(scale)
        shift, scale = _shift_and_scale(self.second(b))
        a = a * jnp.exp(scale) + shift
        return jnp.concatenate([a, b])[jnp.array(self.permutation)], log_det + jnp.sum(scale)

    def inverse(self, y: Float[Array, "k"]) -> tuple[Float[Array, "k"], Float[Array, ""]]:
        """x and log |dx/dy|."""
        y = y[jnp.array(np.argsort(self.permutation))]
        half = y.shape[0] // 2
        a, b = y[:half], y[half:]
        shift, scale = _shift_and_scale(self.second(b))
        a = (a - shift) * jnp.exp(-scale)
        log_det = -jnp.sum(scale)
        shift, scale = _shift_and_scale(self.first(a))
        b = (b - shift) * jnp.exp(-scale)
        return jnp.concatenate([a, b]), log_det - jnp.sum(scale)


def _shift_and_scale(output: Float[Array, "two_k"]) -> tuple[Array, Array]:
    shift, scale = jnp.split(output, 2)
    return shift, 2.0 * jnp.tanh(0.5 * scale)  # bounded log-scale: a coupling cannot overflow


class RealNVP(eqx.Module):
    """z = m(z~; zeta): two pairs of couplings."""

    pairs: tuple[CouplingPair, ...]

    def __init__(self, dim: int, hidden: int, key: PRNGKeyArray, pairs: int = 2):
        permutations = np.random.default_rng(0)  # fixed by the architecture, independent of the seed
        self.pairs = tuple(
            CouplingPair(dim, hidden, tuple(int(i) for i in permutations.permutation(dim)), k)
            for k in jax.random.split(key, pairs)
        )

    def forward(self, z_tilde: Float[Array, "k"]) -> tuple[Float[Array, "k"], Float[Array, ""]]:
        """z and log |dz/dz~|."""
        z, log_det = z_tilde, jnp.zeros(())
        for pair in self.pairs:
            z, part = pair.forward(z)
            log_det += part
        return z, log_det

    def inverse(self, z: Float[Array, "k"]) -> tuple[Float[Array, "k"], Float[Array, ""]]:
        """z~ and log |dz~/dz|."""
        log_det = jnp.zeros(())
        for pair in reversed(self.pairs):
            z, part = pair.inverse(z)
            log_det += part
        return z, log_det


class HyperNetwork(eqx.Module):
    """w = h(z; theta): two hidden layers, then a linear map to every field weight."""

    hidden0: eqx.nn.Linear
    hidden1: eqx.nn.Linear
    weight: Float[Array, "d h"]
    bias: Float[Array, "d"]
    scale: Float[Array, "d"]  # each weight's scale (`MLPField.weight_scale`): outputs start as in a new MLP
    smooth: bool = eqx.field(static=True)

    def __init__(self, latent: int, hidden: int, field: MLPField, smooth: bool, key: PRNGKeyArray):
        self.smooth = smooth
        k0, k1, k2, k3 = jax.random.split(key, 4)
        self.hidden0 = relu_layer(eqx.nn.Linear(latent, hidden, key=k0))
        self.hidden1 = relu_layer(eqx.nn.Linear(hidden, hidden, key=k1))
        self.scale = jnp.asarray(field.weight_scale)
        kernels = np.concatenate([np.full(math.prod(shape), len(shape) == 2) for shape in field.shapes])
        self.bias = jax.random.normal(k3, (field.size,)) * kernels
        self.weight = 0.5 * jax.random.normal(k2, (field.size, hidden))

    def __call__(self, z: Float[Array, "k"]) -> Float[Array, "d"]:
        activation = jax.nn.silu if self.smooth else jax.nn.relu
        h = activation(self.hidden1(activation(self.hidden0(z))))
        # divide here, not in the weights, so that Adam's steps in w are as small as those of the bias
        return jax.lax.stop_gradient(self.scale) * (self.weight @ h / math.sqrt(h.shape[0]) + self.bias)


class Encoder(eqx.Module):
    """Gaussian potentials (mu_j, tau_j) of each view, combined with a learned prior potential (paper §2.2)."""

    convolutions: tuple[eqx.nn.Conv2d, ...]
    camera: TwoLayer
    hidden: eqx.nn.Linear
    output: eqx.nn.Linear
    prior_mean: Float[Array, "k"]
    prior_log_precision: Float[Array, "k"]

    def __init__(self, preset: Preset, key: PRNGKeyArray):
        keys = jax.random.split(key, len(preset.encoder_channels) + 3)
        channels = (IMAGE_CHANNELS, *preset.encoder_channels)
        self.convolutions = tuple(
            relu_layer(eqx.nn.Conv2d(a, b, 3, stride=2 if i < 3 else 1, padding=1, key=k))
            for i, (a, b, k) in enumerate(zip(channels[:-1], channels[1:], keys, strict=False))
        )
        width = 2 * channels[-1]
        self.camera = TwoLayer(CAMERA_FEATURES, width // 2, width // 2, keys[-3])
        self.hidden = relu_layer(eqx.nn.Linear(2 * channels[-1] + width // 2, width, key=keys[-2]))
        self.output = eqx.nn.Linear(width, 2 * preset.latent, key=keys[-1])
        self.prior_mean = jnp.zeros(preset.latent)
        self.prior_log_precision = jnp.zeros(preset.latent)

    def potential(self, image: Float[Array, "c s s"], camera: Float[Array, "13"]) -> tuple[Array, Array]:
        """(mu_j, tau_j) of one view."""
        h = image
        for convolution in self.convolutions:
            h = jax.nn.relu(convolution(h))
        # pooled: features encode positions in the object frame, not in the picture
        parts = [jnp.mean(h, axis=(1, 2)), jnp.max(h, axis=(1, 2)), jax.nn.relu(self.camera(camera))]
        h = jax.nn.relu(self.hidden(jnp.concatenate(parts)))
        mean, log_precision = jnp.split(self.output(h), 2)
        # starts at precision 20: with unit noise, the decoder would learn to ignore z
        return mean, jnp.exp(3.0 + 6.0 * jnp.tanh(log_precision / 6.0))

    def __call__(
        self, images: Float[Array, "j c s s"], cameras: Float[Array, "j 13"], used: Float[Array, "j"]
    ) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
        """Mean and precision of q(z | views): precisions add and weight the means. `used` is 0 for a missing view."""
        mean, precision = jax.vmap(self.potential)(images, cameras)
        precision = precision * used[:, None]
        prior = jnp.exp(self.prior_log_precision)
        total = prior + jnp.sum(precision, axis=0)
        return (prior * self.prior_mean + jnp.sum(precision * mean, axis=0)) / total, total


class Recognition(eqx.Module):
    """q(z | the object's exact description). It is used only in training and discarded afterwards.

    The paper trains the decoder through the picture encoder. Here the exact description of a procedural object is
    known. A decoder trained with z from this description learns several times faster. The picture encoder then learns
    to predict the same z.
    """

    hidden: TwoLayer
    output: eqx.nn.Linear
    prior_log_precision: Float[Array, "k"]

    def __init__(self, inputs: int, latent: int, hidden: int, key: PRNGKeyArray):
        k0, k1 = jax.random.split(key)
        self.hidden = TwoLayer(inputs, hidden, hidden, k0)
        self.output = eqx.nn.Linear(hidden, 2 * latent, key=k1)
        self.prior_log_precision = jnp.zeros(latent)

    def __call__(self, description: Float[Array, "p"]) -> tuple[Float[Array, "k"], Float[Array, "k"]]:
        """Mean and precision of z."""
        mean, log_precision = jnp.split(self.output(jax.nn.relu(self.hidden(description))), 2)
        precision = jnp.exp(3.0 + 6.0 * jnp.tanh(log_precision / 6.0))
        total = precision + jnp.exp(self.prior_log_precision)
        return precision * mean / total, total


class ProbNeRF(eqx.Module):
    """The generative model with its encoder. `preset` fixes every size."""

    flow: RealNVP
    hyper: HyperNetwork
    encoder: Encoder
    preset: Preset = eqx.field(static=True)

    def __init__(self, preset: Preset, key: PRNGKeyArray):
        k0, k1, k2 = jax.random.split(key, 3)
        self.preset = preset
        self.flow = RealNVP(preset.latent, preset.flow_hidden, k0, preset.pairs)
        self.hyper = HyperNetwork(preset.latent, preset.hyper_hidden, preset.field, preset.smooth, k1)
        self.encoder = Encoder(preset, k2)

    @property
    def field(self) -> MLPField:
        """The field that takes `decode`'s weights."""
        return self.preset.field

    @property
    def latent(self) -> int:
        """K, the length of z~."""
        return self.preset.latent

    def decode(self, z_tilde: Float[Array, "k"]) -> Float[Array, "d"]:
        """w = h(m(z~)) (paper eq. 1)."""
        return self.hyper(self.flow.forward(z_tilde)[0])
