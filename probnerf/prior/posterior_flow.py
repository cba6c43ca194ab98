"""The posterior network: q(z~, pose | picture) with exact density and draws, for any picture that perception makes.

q = q(yaw) q(x, y, log-scale | yaw) q(z~ | yaw, x, y, log-scale), each given the picture: a mixture on the circle, a
small Gaussian mixture, a conditional flow. The yaw's latents (a, b) = r (cos yaw, sin yaw) keep the law of their
length: q(a, b) = q(yaw) exp(-r^2 / 2). The range offset and the plane's height keep their priors. If the pose is
known, the position is z~ alone, and the density is q(z~ | pose). Everything is a density over positions, whose prior
is N(0, I) (`probnerf.likelihood.position`).

Internally the frame is turned so that the camera's azimuth is 0. So a picture at a known pose looks like any other, and
the known yaw is a number that the flow is given.

Beside q stands what kind of thing it is: probabilities of `KINDS`, given the picture alone.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from probnerf.prior.conditional_densities import ConditionalFlow, TripleMixture, YawMixture, zeroed
from probnerf.prior.picture_summary import PictureSummary, affine, harmonics, turned, turned_moments
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.types import KINDS, POSE_SIZE

_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class NetworkSizes:
    """All sizes of a posterior network."""

    latent: int  # K
    image_size: int = 32  # pixels
    patch: int = 4  # pixels
    channels: int = 64  # of each patch
    blocks: int = 2  # of the mixer, before and after it merges patches
    context: int = 256  # features of a picture
    harmonics: int = 6  # highest angular frequency of the points' moments and of the yaw
    point_channels: int = 16
    trunk: int = 256  # hidden units between picture and pose on one side and the flow on the other
    condition: int = 128  # what the flow's couplings are given
    couplings: int = 8
    hidden: int = 256  # of each coupling
    yaw_components: int = 16
    pose_components: int = 4


class PictureFeatures(eqx.Module):
    """What the densities need of one picture, computed once."""

    azimuth: Float[Array, ""]  # of the camera in the picture's frame, radians
    yaw: YawMixture  # of yaw - azimuth
    moments: Float[Array, "m c"]
    pose: Float[Array, "t"]  # the picture's part of the first layer that leads to x, y and log-scale
    shape: Float[Array, "t"]  # and to z~
    log_kinds: Float[Array, "kinds"]  # logarithms of the probabilities of `KINDS`
    known: bool = eqx.field(static=True)  # the pose is known: positions are z~ alone


class PosteriorNetwork(eqx.Module):
    """q(position | picture). Positions are [z~ | a, b, x, y, log-scale, range offset, z]; only z~ at a known pose."""

    summary: PictureSummary
    yaw: eqx.nn.Linear
    pose_picture: eqx.nn.Linear
    pose_yaw: eqx.nn.Linear
    pose_output: eqx.nn.Linear
    shape_picture: eqx.nn.Linear
    shape_pose: eqx.nn.Linear
    shape_hidden: eqx.nn.Linear
    shape_output: eqx.nn.Linear
    flow: ConditionalFlow
    kind: eqx.nn.Linear
    sizes: NetworkSizes = eqx.field(static=True)

    def __init__(self, sizes: NetworkSizes, key: PRNGKeyArray):
        self.sizes = s = sizes
        keys = jax.random.split(key, 11)
        self.summary = PictureSummary(
            s.image_size, s.patch, s.channels, s.blocks, s.harmonics, s.point_channels, s.context, keys[0]
        )
        at_yaw = (1 + 2 * s.harmonics) * s.point_channels + 2 * s.harmonics
        self.yaw = zeroed(eqx.nn.Linear(s.context, YawMixture.outputs(s.yaw_components), key=keys[1]))
        self.pose_picture = eqx.nn.Linear(s.context, s.trunk // 2, key=keys[2])
        self.pose_yaw = eqx.nn.Linear(at_yaw, s.trunk // 2, use_bias=False, key=keys[3])
        output = eqx.nn.Linear(s.trunk // 2, TripleMixture.outputs(s.pose_components), key=keys[4])
        # small, but not zero: equal components would stay equal
        self.pose_output = jax.tree.map(lambda a: 0.1 * a, output)
        self.shape_picture = eqx.nn.Linear(s.context, s.trunk, key=keys[5])
        self.shape_pose = eqx.nn.Linear(at_yaw + 3, s.trunk, use_bias=False, key=keys[6])
        self.shape_hidden = eqx.nn.Linear(s.trunk, s.trunk, key=keys[7])
        self.shape_output = eqx.nn.Linear(s.trunk, s.condition, key=keys[8])
        self.flow = ConditionalFlow(s.latent, s.condition, s.hidden, s.couplings, keys[9])
        self.kind = zeroed(eqx.nn.Linear(s.context, len(KINDS), key=keys[10]))

    def features(
        self,
        picture: EncoderPicture,
        pose_sigma: Float[Array, "5"],
        known: bool = False,
        given: Float[Array, ""] | None = None,
    ) -> PictureFeatures:
        """Features of one picture. `pose_sigma` is the observation's; it is not read if the pose is known.

        `known`: positions are z~ alone. `given` tells the network that the pose is known (default: as `known`);
        training, where it varies from picture to picture, sets it.
        """
        size = picture.rgb.shape[0]
        if size != self.sizes.image_size:
            raise ValueError(f"the picture has {size} pixels a side; the network wants {self.sizes.image_size}")
        T = picture.T_view_camera
        azimuth = jnp.arctan2(T[1, 3], T[0, 3])
        told = jnp.asarray(known, jnp.float32) if given is None else given
        context, moments = self.summary(replace(picture, T_view_camera=turned(T, -azimuth)), pose_sigma, told)
        return PictureFeatures(
            azimuth=azimuth,
            yaw=YawMixture.of(affine(self.yaw, context)),
            moments=moments,
            pose=affine(self.pose_picture, context),
            shape=affine(self.shape_picture, context),
            log_kinds=jax.nn.log_softmax(affine(self.kind, context)),
            known=known,
        )

    def log_density(self, features: PictureFeatures, positions: Float[Array, "n d"]) -> Float[Array, "n"]:
        """log q(position | picture), nats, with respect to the position's coordinates."""
        k = self.sizes.latent
        self._check(features, positions.shape[-1])
        z_tilde = positions[:, :k]
        if features.known:
            return self._shape_density(features, *self._known_pose(features, len(positions)), z_tilde)
        a, b = positions[:, k], positions[:, k + 1]
        # atan2 has no gradient at the origin, which has measure zero but can occur in float32
        yaw = jnp.arctan2(b, jnp.where(a * a + b * b < 1e-12, 1.0, a))
        parts = self.log_density_parts(features, yaw, positions[:, k + 2 : k + 5], z_tilde)
        others = positions[:, k + 5 :]  # range offset and height
        rest = 0.5 * (a * a + b * b) + jnp.sum(0.5 * others**2 + 0.5 * _LOG_2PI, axis=-1)
        return sum(parts) - rest

    def log_density_parts(
        self,
        features: PictureFeatures,
        yaw: Float[Array, "n"],
        pose: Float[Array, "n 3"],
        z_tilde: Float[Array, "n k"],
    ) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
        """Logarithms of q(yaw), q(x, y, log-scale | yaw) and q(z~ | yaw, x, y, log-scale), given the picture.

        `yaw` is in radians; `pose` (x, y, log-scale) is in units of the prior's widths.
        """
        around = yaw - features.azimuth
        at_yaw, mixture = self._pose_mixture(features, around)
        shape = self._shape_density(features, at_yaw, pose, z_tilde)
        return features.yaw.log_density(around), mixture.log_density(pose), shape

    def draw(self, key: PRNGKeyArray, features: PictureFeatures, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        return self.draw_with_density(key, features, count)[0]

    def draw_with_density(
        self, key: PRNGKeyArray, features: PictureFeatures, count: int
    ) -> tuple[Float[Array, "count d"], Float[Array, "count"]]:
        """Independent draws and their log-densities: cheaper than asking for the densities afterwards."""
        noise, yaw_key, pose_key, length_key, rest_key = jax.random.split(key, 5)
        u = jax.random.normal(noise, (count, self.sizes.latent))
        log_u = jnp.sum(-0.5 * u**2 - 0.5 * _LOG_2PI, axis=-1)
        if features.known:
            at_yaw, pose = self._known_pose(features, count)
            z_tilde, log_det = self.flow.forward(u, self._condition(features, at_yaw, pose))
            return z_tilde, log_u - log_det
        around = features.yaw.draw(yaw_key, count)
        at_yaw, mixture = self._pose_mixture(features, around)
        pose = mixture.draw(pose_key)
        z_tilde, log_det = self.flow.forward(u, self._condition(features, at_yaw, pose))
        length = jnp.sqrt(2.0 * jax.random.exponential(length_key, (count,)))  # of two standard normal values
        yaw = around + features.azimuth
        rest = jax.random.normal(rest_key, (count, POSE_SIZE - 5))
        direction = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=1)
        positions = jnp.concatenate([z_tilde, length[:, None] * direction, pose, rest], axis=1)
        log_rest = -0.5 * length**2 - jnp.sum(0.5 * rest**2 + 0.5 * _LOG_2PI, axis=-1)
        return positions, (log_u - log_det + features.yaw.log_density(around) + mixture.log_density(pose) + log_rest)

    def _check(self, features: PictureFeatures, dim: int) -> None:
        wanted = self.sizes.latent + POSE_SIZE * (not features.known)
        if dim != wanted:
            raise ValueError(f"a position has {dim} numbers; the posterior network wants {wanted}")

    def _known_pose(self, features: PictureFeatures, count: int) -> tuple[Array, Float[Array, "count 3"]]:
        """What the flow is told of yaw 0, and x = y = log-scale = 0."""
        at_yaw = self._at_yaw(features, -features.azimuth[None])
        return jnp.broadcast_to(at_yaw, (count, at_yaw.shape[1])), jnp.zeros((count, 3))

    def _at_yaw(self, features: PictureFeatures, around: Float[Array, "n"]) -> Float[Array, "n f"]:
        """The seen points' moments in the canonical frame, and the yaw's harmonics."""
        cosine, sine = harmonics(jnp.cos(around), jnp.sin(around), self.sizes.harmonics)
        return jnp.concatenate([turned_moments(features.moments, cosine, sine), cosine, sine], axis=1)

    def _pose_mixture(self, features: PictureFeatures, around: Float[Array, "n"]) -> tuple[Array, TripleMixture]:
        at_yaw = self._at_yaw(features, around)
        hidden = jax.nn.silu(features.pose + affine(self.pose_yaw, at_yaw))
        return at_yaw, TripleMixture.of(affine(self.pose_output, hidden))

    def _condition(
        self, features: PictureFeatures, at_yaw: Float[Array, "n f"], pose: Float[Array, "n 3"]
    ) -> Float[Array, "n c"]:
        given = jnp.concatenate([at_yaw, pose], axis=1)
        hidden = jax.nn.silu(features.shape + affine(self.shape_pose, given))
        hidden = jax.nn.silu(affine(self.shape_hidden, hidden))
        return jax.nn.silu(affine(self.shape_output, hidden))

    def _shape_density(
        self, features: PictureFeatures, at_yaw: Array, pose: Array, z_tilde: Float[Array, "n k"]
    ) -> Float[Array, "n"]:
        u, log_det = self.flow.inverse(z_tilde, self._condition(features, at_yaw, pose))
        return jnp.sum(-0.5 * u**2 - 0.5 * _LOG_2PI, axis=-1) + log_det


class PictureDensity(eqx.Module):
    """The network's density for one picture: what a sampler needs (`probnerf.sampling.defensive_mixture`)."""

    network: PosteriorNetwork
    features: PictureFeatures

    def log_density(self, position: Float[Array, "n d"]) -> Float[Array, "n"]:
        """log q(position | picture), nats."""
        return self.network.log_density(self.features, position)

    def draw(self, key: PRNGKeyArray, count: int) -> Float[Array, "count d"]:
        """Independent draws."""
        return self.network.draw(key, self.features, count)
