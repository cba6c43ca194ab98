"""Pictures with the latents of their objects, which a prior's recognition tells."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from perception.simulation.training_pictures import PicturePart
from probnerf.prior.networks import Recognition
from probnerf.training.picture_set import PictureSet


def told_pictures(parts: list[PicturePart], recognition: Recognition, latent: int, chunk: int = 4096) -> PictureSet:
    """The parts' pictures with the latents of their objects, which recognition tells many at a time."""
    described = np.concatenate([part.description for part in parts])
    every = eqx.filter_jit(eqx.filter_vmap(recognition))
    mean, sd = np.zeros((len(described), latent), np.float32), np.zeros((len(described), latent), np.float32)
    for start in range(0, len(described), chunk):
        rows = np.arange(start, min(start + chunk, len(described)))
        told, precision = every(jnp.asarray(described[np.resize(rows, chunk)], jnp.float32))
        mean[rows], sd[rows] = np.asarray(told)[: len(rows)], np.asarray(1.0 / jnp.sqrt(precision))[: len(rows)]
    offset = np.cumsum([0, *(len(part.description) for part in parts)])
    row = np.concatenate([part.row + offset[k] for k, part in enumerate(parts)])
    owner = np.concatenate([(part.family.astype(np.int64) << 40) + part.seed for part in parts])
    names = ("rgb", "distance", "unknown", "T_view_camera", "tan_half_fov", "pose_sigma", "yaw", "pose")
    return PictureSet(
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        mean=mean[row],
        sd=sd[row],
        object_id=owner[row],
        kind=np.concatenate([part.kind for part in parts])[row],
    )
