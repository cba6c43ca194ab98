"""Training examples of the posterior network: pictures with what stands in them, and what training does to them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from foundation.whole_file import whole_file
from probnerf.prior.networks import Recognition
from probnerf.prior.posterior_network import EncoderPicture
from probnerf.training.settings import PosteriorTrainConfig
from probnerf.types import BASE_Z, on_device


@dataclass(frozen=True)
class PictureSet:
    """N pictures, S x S pixels each, in the view frame (cube units), and their latents.

    `mean` and `sd` tell z~ as a Gaussian, from which each step draws (sd 0: exactly known); they tell z instead if
    `posterior_flow.train` is given the prior's flow. Fields of a loaded set lie on disk until they are read.
    """

    rgb: np.ndarray  # u8 [N, S, S, 3]
    distance: np.ndarray  # f16 [N, S, S], along the ray; 0: not the object, -1: the object at an unknown range
    unknown: np.ndarray  # u8 [N, S, S], 1 if the pixel is not informative
    T_view_camera: np.ndarray  # f32 [N, 4, 4]
    tan_half_fov: np.ndarray  # f32 [N]
    pose_sigma: np.ndarray  # f32 [N, 5], perception's (`Observation`)
    yaw: np.ndarray  # f32 [N], radians
    pose: np.ndarray  # f32 [N, 4]: x, y, log-scale and z in units of `pose_sigma`
    mean: np.ndarray  # f32 [N, K]
    sd: np.ndarray  # f32 [N, K]
    object_id: np.ndarray  # int [N]
    kind: np.ndarray  # u8 [N], index into KINDS

    def __post_init__(self) -> None:
        sizes = {field.name: len(getattr(self, field.name)) for field in fields(self)}
        if len(set(sizes.values())) != 1:
            raise ValueError(f"a picture set's arrays have different lengths: {sizes}")

    def __len__(self) -> int:
        return len(self.rgb)

    def save(self, folder: Path) -> None:
        """Write one `.npy` file for each array. Each appears whole or not at all."""
        for field in fields(self):
            with whole_file(folder / f"{field.name}.npy") as part, part.open("wb") as file:
                np.save(file, getattr(self, field.name), allow_pickle=False)

    @classmethod
    def load(cls, folder: Path) -> "PictureSet":
        """A saved set. Raises FileNotFoundError with the missing file."""
        arrays = {}
        for field in fields(cls):
            path = folder / f"{field.name}.npy"
            if not path.is_file():
                raise FileNotFoundError(f"{path}: no such array of a picture set; draw the pictures again")
            arrays[field.name] = np.load(path, mmap_mode="r", allow_pickle=False)
        return cls(**arrays)


def recognised(recognition: Recognition, descriptions: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Mean and standard deviation of z ([n, K] each) of the objects of each array of descriptions [n, d]."""
    every = eqx.filter_jit(eqx.filter_vmap(recognition))
    told = (every(on_device(each)) for each in descriptions)
    return [(np.asarray(mean), 1.0 / np.sqrt(np.asarray(precision))) for mean, precision in told]


class Examples(eqx.Module):
    """A batch of changed examples. `known` is 1 where the pose is given; yaw and pose are then 0."""

    picture: EncoderPicture  # rgb as u8 and distance as f16, to be converted on the device
    pose_sigma: Float[Array, "b 5"]
    known: Float[Array, "b"]
    yaw: Float[Array, "b"]
    pose: Float[Array, "b 3"]
    mean: Float[Array, "b k"]
    sd: Float[Array, "b k"]
    kind: Int[Array, "b"]


def split(pictures: PictureSet, config: PosteriorTrainConfig) -> tuple[np.ndarray, np.ndarray]:
    """Rows to train on, and rows of held-out objects."""
    names = np.unique(pictures.object_id)
    held = np.random.default_rng([config.seed, 1]).permutation(names)[: round(config.validation * len(names))]
    out = np.isin(pictures.object_id, held)
    return np.flatnonzero(~out), np.flatnonzero(out)


def changed(pictures: PictureSet, rows: np.ndarray, rng: np.random.Generator, config: PosteriorTrainConfig) -> Examples:
    """These rows, some of them without depth, at a known pose or behind an occluder."""
    distance = np.asarray(pictures.distance[rows], np.float32)
    unknown = np.asarray(pictures.unknown[rows]).astype(bool)
    T = np.asarray(pictures.T_view_camera[rows])
    sigma, pose = np.asarray(pictures.pose_sigma[rows]), np.asarray(pictures.pose[rows])
    yaw = np.asarray(pictures.yaw[rows])
    flat, known, behind = rng.uniform(size=(3, len(rows))) < np.array(
        [[config.without_depth], [config.known_pose], [config.occluded]]
    )
    share = rng.uniform(0.0, config.most_hidden, len(rows)) * behind
    unknown |= occluders(rng, (distance != 0.0) & ~unknown, share)
    T_known, scale = _at_known_pose(T, yaw, pose, sigma)
    distance = np.where(known[:, None, None] & (distance > 0), distance * scale[:, None, None], distance)
    distance = np.where(flat[:, None, None] & (distance > 0), -1.0, distance)
    return Examples(
        picture=EncoderPicture(
            on_device(pictures.rgb[rows], np.uint8),
            on_device(distance, np.float16),
            on_device(unknown, np.bool_),
            on_device(np.where(known[:, None, None], T_known, T)),
            on_device(pictures.tan_half_fov[rows]),
        ),
        pose_sigma=on_device(sigma),
        known=on_device(known),
        yaw=on_device(np.where(known, 0.0, yaw)),
        pose=on_device(np.where(known[:, None], 0.0, pose[:, :3])),
        mean=on_device(pictures.mean[rows]),
        sd=on_device(pictures.sd[rows]),
        kind=on_device(pictures.kind[rows], np.int32),
    )


def occluders(rng: np.random.Generator, seen: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Masks [b, s, s] that hide so much of the object in `seen` (bool [b, s, s]): a share [b] of its pixels.

    Each is an ellipse or a box at a random place, as large as needed: from a thing in front of the object's middle to a
    straight edge beside it. Where the share is 0 the mask is empty.
    """
    size = seen.shape[1]
    pixels = np.round(share * seen.sum(axis=(1, 2))).astype(int)
    chosen = np.flatnonzero(pixels)
    count = len(chosen)
    axis = (np.arange(size, dtype=np.float32) + 0.5) / (0.5 * size) - 1.0
    grid = np.stack(np.meshgrid(axis, axis, indexing="xy"), axis=-1).reshape(-1, 2)
    angle, turn = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    far = np.exp(rng.uniform(np.log(0.2), np.log(10.0), count))
    stretch = np.exp(rng.normal(0.0, 0.5, count))
    box = rng.uniform(size=count) < 0.5
    centre = far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    c, s = np.cos(turn), np.sin(turn)
    T = np.stack([np.stack([c, s], axis=1), stretch[:, None] * np.stack([-s, c], axis=1)], axis=1)
    local = np.abs((grid - centre[:, None].astype(np.float32)) @ T.astype(np.float32).swapaxes(1, 2))
    reach = np.where(box[:, None], local.max(axis=-1), np.hypot(local[..., 0], local[..., 1]))
    order = np.sort(np.where(seen[chosen].reshape(count, size * size), reach, np.inf), axis=1)
    hidden = np.zeros(seen.shape, bool)
    hidden[chosen] = (reach <= order[np.arange(count), pixels[chosen] - 1, None]).reshape(count, size, size)
    return hidden


def _at_known_pose(
    T: np.ndarray, yaw: np.ndarray, pose: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Camera poses in the canonical object frame, and the factor of all distances (`Pose.to_object`)."""
    x, y, log_scale, z = (pose * sigma[:, [0, 1, 2, 4]]).T
    scale = np.exp(-log_scale)
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.zeros((len(T), 3, 3))
    rotation[:, 0, 0], rotation[:, 0, 1], rotation[:, 1, 0], rotation[:, 1, 1], rotation[:, 2, 2] = c, s, -s, c, 1.0
    base = np.array([0.0, 0.0, BASE_Z])
    place = T[:, :3, 3] - base - np.stack([x, y, z], axis=1)
    known = np.tile(np.eye(4), (len(T), 1, 1))
    known[:, :3, :3] = rotation @ T[:, :3, :3]
    known[:, :3, 3] = scale[:, None] * np.einsum("bij,bj->bi", rotation, place) + base
    return known, scale
