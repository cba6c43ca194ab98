"""What a picture tells the posterior network: a context vector, and moments of the seen points that turn with the yaw.

The context comes from an MLP-Mixer (Tolstikhin et al., 2021) over patches of the picture, first small, then 2 x 2 of
them merged. It has only matrix products, which a CPU does many times faster than small convolutions. Nothing is pooled:
the output layer sees every merged patch at its place.

The moments describe the seen points for any yaw at once. Each point at azimuth phi adds g_m e^(i m phi), m = 0 ... M,
and g_m is a network's function of its height, its distance from the axis and its colour. In a frame that is turned by
a yaw, the moment is the same times e^(-i m yaw) (circular harmonics; Worrall et al., 2017). So the view from the
canonical frame costs one complex product for each yaw.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.fields.mlp import encode, encoded_size
from probnerf.prior.encoder_input import camera_features, encoder_image, pixel_directions
from probnerf.prior.networks import CAMERA_FEATURES, IMAGE_CHANNELS
from probnerf.prior.posterior_network import EncoderPicture

SCALARS = CAMERA_FEATURES + 5 + 3  # and pose_sigma; pose known, depth exists, share of the picture that is unknown
_OCTAVES = 2  # of the encoding of a point's distance from the axis and height
_POINT_INPUTS = encoded_size(_OCTAVES, 2) + 4  # and colour, and whether there is a range


def affine(linear: eqx.nn.Linear, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
    """The layer applied to the last axis."""
    y = x @ linear.weight.T
    return y if linear.bias is None else y + linear.bias


class Perceptron(eqx.Module):
    """Linear, SiLU, linear, on the last axis."""

    first: eqx.nn.Linear
    last: eqx.nn.Linear

    def __init__(self, inputs: int, hidden: int, outputs: int, key: PRNGKeyArray):
        k0, k1 = jax.random.split(key)
        self.first = eqx.nn.Linear(inputs, hidden, key=k0)
        self.last = eqx.nn.Linear(hidden, outputs, key=k1)

    def __call__(self, x: Float[Array, "... i"]) -> Float[Array, "... o"]:
        return affine(self.last, jax.nn.silu(affine(self.first, x)))


def _normalised(x: Float[Array, "... c"]) -> Float[Array, "... c"]:
    """Mean 0 and variance 1 over the last axis."""
    centred = x - jnp.mean(x, axis=-1, keepdims=True)
    return centred * jax.lax.rsqrt(jnp.mean(centred**2, axis=-1, keepdims=True) + 1e-5)


class MixerBlock(eqx.Module):
    """Residual perceptrons, first across the patches of each channel, then across the channels of each patch."""

    across_patches: Perceptron
    across_channels: Perceptron

    def __init__(self, patches: int, channels: int, key: PRNGKeyArray):
        k0, k1 = jax.random.split(key)
        self.across_patches = Perceptron(patches, patches, patches, k0)
        self.across_channels = Perceptron(channels, 2 * channels, channels, k1)

    def __call__(self, x: Float[Array, "t c"]) -> Float[Array, "t c"]:
        x = x + self.across_patches(_normalised(x).T).T
        return x + self.across_channels(_normalised(x))


def turned(T: Float[Array, "4 4"], angle: Float[Array, ""]) -> Float[Array, "4 4"]:
    """R_z(angle) T."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.eye(4).at[:2, :2].set(jnp.array([[c, -s], [s, c]])) @ T


def seen_points(picture: EncoderPicture) -> tuple[Float[Array, "p 3"], Float[Array, "p 4"], Float[Array, "p"]]:
    """(places, [colour - 1/2, share with a range], weights) of the object's points: one for each 2 x 2 pixels.

    An object pixel without a range counts as the point of its ray nearest to the cube's centre.
    """
    size = picture.rgb.shape[0]
    origin = picture.T_view_camera[:3, 3]
    rays = pixel_directions(size, picture.T_view_camera, picture.tan_half_fov)
    ranged = picture.distance > 0.0
    place = origin + jnp.where(ranged, picture.distance, -(rays @ origin))[..., None] * rays
    weight = jnp.where((picture.distance != 0.0) & (picture.unknown < 0.5), 1.0, 0.0)
    each = jnp.concatenate([place, picture.rgb - 0.5, ranged[..., None]], axis=-1) * weight[..., None]

    def pooled(x: Array) -> Array:
        return jnp.mean(x.reshape(size // 2, 2, size // 2, 2, -1), axis=(1, 3)).reshape(size * size // 4, -1)

    share = pooled(weight)
    mean = pooled(each) / jnp.maximum(share, 1e-6)
    return mean[:, :3], mean[:, 3:], share[:, 0]


class PictureSummary(eqx.Module):
    """Picture -> (context vector, moments of the seen points)."""

    patches: eqx.nn.Linear
    scalars: eqx.nn.Linear
    place: Float[Array, "t c"]
    fine: tuple[MixerBlock, ...]
    merge: eqx.nn.Linear  # of 2 x 2 patches
    coarse: tuple[MixerBlock, ...]
    points: Perceptron
    output: Perceptron
    patch: int = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)

    def __init__(
        self,
        image_size: int,
        patch: int,
        channels: int,
        blocks: int,
        harmonics: int,
        point_channels: int,
        context: int,
        key: PRNGKeyArray,
    ):
        if image_size % (2 * patch):
            raise ValueError(f"a picture of {image_size} pixels does not divide into pairs of patches of {patch}")
        keys = jax.random.split(key, 2 * blocks + 6)
        self.patch, self.harmonics = patch, harmonics
        count = (image_size // patch) ** 2
        self.patches = eqx.nn.Linear(IMAGE_CHANNELS * patch**2, channels, use_bias=False, key=keys[0])
        self.scalars = eqx.nn.Linear(SCALARS, channels, key=keys[1])
        self.place = 0.1 * jax.random.normal(keys[2], (count, channels))
        self.fine = tuple(MixerBlock(count, channels, k) for k in keys[6 : 6 + blocks])
        self.merge = eqx.nn.Linear(4 * channels, 2 * channels, key=keys[3])
        self.coarse = tuple(MixerBlock(count // 4, 2 * channels, k) for k in keys[6 + blocks :])
        moments = (1 + 2 * harmonics) * point_channels
        self.points = Perceptron(_POINT_INPUTS, 48, (1 + harmonics) * point_channels, keys[4])
        self.output = Perceptron(count // 2 * channels + moments + SCALARS, context, context, keys[5])

    def __call__(
        self, picture: EncoderPicture, pose_sigma: Float[Array, "5"], known: Float[Array, ""]
    ) -> tuple[Float[Array, "h"], Float[Array, "m c"]]:
        """Context, and moments: the mean, then the cosine parts m = 1 ... M, then the sine parts.

        The camera's azimuth in the picture's frame is 0 (`turned`). `known` is 1 if the pose is given.
        """
        scalars = self._scalars(picture, pose_sigma, known)
        size, patch, T = picture.rgb.shape[0], self.patch, picture.T_view_camera
        image = encoder_image(picture.rgb, picture.distance, picture.unknown, T, picture.tan_half_fov)
        side = size // patch
        tokens = image.reshape(-1, side, patch, side, patch).transpose(1, 3, 0, 2, 4).reshape(side * side, -1)
        x = affine(self.patches, tokens) + self.place + affine(self.scalars, scalars)
        for block in self.fine:
            x = block(x)
        x = x.reshape(side // 2, 2, side // 2, 2, -1).transpose(0, 2, 1, 3, 4).reshape(side * side // 4, -1)
        x = affine(self.merge, _normalised(x))
        for block in self.coarse:
            x = block(x)
        moments = self.moments(picture)
        context = self.output(jnp.concatenate([_normalised(x).reshape(-1), moments.reshape(-1), scalars]))
        return jax.nn.silu(context), moments

    def moments(self, picture: EncoderPicture) -> Float[Array, "m c"]:
        """Circular moments of the seen points, averaged over them; zeros where nothing is seen."""
        place, others, weight = seen_points(picture)
        radius = jnp.sqrt(place[:, 0] ** 2 + place[:, 1] ** 2 + 1e-4)
        inputs = encode(jnp.stack([radius, place[:, 2]]), _OCTAVES).T
        hidden = jax.nn.silu(affine(self.points.first, jnp.concatenate([inputs, others], axis=-1)))
        cosine, sine = harmonics(place[:, 0] / radius, place[:, 1] / radius, self.harmonics)
        angular = jnp.concatenate([jnp.ones_like(cosine[:, :1]), cosine, sine], axis=1) * weight[:, None]
        # sum over points before the linear layer, which commutes with it: ten times cheaper to train
        total = jnp.concatenate([angular.T @ hidden, jnp.sum(angular, axis=0)[:, None]], axis=1)
        total = total / (jnp.sum(weight) + 1e-3 * len(weight))
        assert self.points.last.bias is not None
        last = jnp.concatenate([self.points.last.weight, self.points.last.bias[:, None]], axis=1)
        last = last.reshape(1 + self.harmonics, -1, last.shape[1])
        return jnp.einsum("mh,mch->mc", total, jnp.concatenate([last, last[1:]]))

    def _scalars(
        self, picture: EncoderPicture, pose_sigma: Float[Array, "5"], known: Float[Array, ""]
    ) -> Float[Array, "s"]:
        camera = camera_features(picture.T_view_camera, picture.tan_half_fov)
        widths = (1.0 - known) * jnp.log(10.0 * pose_sigma + 1e-3)
        depth = jnp.any((picture.distance > 0.0) & (picture.unknown < 0.5))
        return jnp.concatenate([camera, widths, jnp.stack([known, depth, jnp.mean(picture.unknown)])])


def harmonics(
    cosine: Float[Array, "n"], sine: Float[Array, "n"], count: int
) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """(cos m phi, sin m phi) for m = 1 ... `count`, from cos phi and sin phi."""
    c, s = [cosine], [sine]
    for _ in range(count - 1):
        c, s = [*c, c[-1] * cosine - s[-1] * sine], [*s, s[-1] * cosine + c[-1] * sine]
    return jnp.stack(c, axis=-1), jnp.stack(s, axis=-1)


def turned_moments(
    moments: Float[Array, "m c"], cosine: Float[Array, "n h"], sine: Float[Array, "n h"]
) -> Float[Array, "n m_c"]:
    """The moments in frames turned by yaws with these harmonics, one row for each."""
    count = cosine.shape[1]
    c, s = moments[1 : 1 + count], moments[1 + count :]
    along = cosine[..., None] * c + sine[..., None] * s
    across = cosine[..., None] * s - sine[..., None] * c
    mean = jnp.broadcast_to(moments[:1], (len(cosine), *moments[:1].shape))
    return jnp.concatenate([mean, along, across], axis=1).reshape(len(cosine), -1)
