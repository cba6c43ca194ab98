"""Whether a rival is healthy alone: how well it shows what it has seen, and a picture to look at."""

import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from benchmarks.rivals.model import Conditioned, DiffusionGenerator, Generator
from benchmarks.rivals.picture_set import PictureSet
from foundation.whole_file import write_whole

EXAMINED = 8  # objects
GIVEN, SHOWN = 0, (1, 2)  # views
SAMPLES = 2 * (1 + len(SHOWN))  # of a row
GREY = 160


def psnr(rgb: Float[np.ndarray, "*n"], truth: UInt8[np.ndarray, "*n"]) -> float:
    """Peak signal to noise ratio, dB, of colours in [0, 1]."""
    return float(-10.0 * np.log10(np.mean((rgb - truth / 255.0) ** 2)))


def examine(model: Any, learnt: PictureSet, new: PictureSet) -> tuple[dict[str, float], UInt8[np.ndarray, "h w 3"]]:
    """Mean psnr, dB, of the given view and of others, for objects that were learnt and for new ones; and a picture.

    A row of it is an object: the given view and two others, each beside the model's. Then come
    two rows of samples of each prior.
    """
    figures, rows = {}, []
    size, key = learnt.rgb.shape[2], jax.random.key(0)
    if isinstance(model, Conditioned):
        for name, objects in (("learnt", learnt), ("new", new)):
            given, others, views = [], [], [GIVEN, *SHOWN]
            pictures, poses = objects.rgb[:EXAMINED], objects.T_object_camera[:EXAMINED]
            states = _answers(model, jnp.asarray(pictures[:, GIVEN]), jnp.asarray(poses[:, GIVEN]), key)
            for i, (rgb, T) in enumerate(zip(pictures, poses, strict=True)):
                shown = _shown(model, _nth(states, i), T[views], size)
                given.append(psnr(shown[0], rgb[GIVEN]))
                others += [psnr(shown[v], rgb[view]) for v, view in enumerate(views) if v > 0]
                pairs = zip(rgb[views], np.round(255.0 * shown).astype(np.uint8), strict=True)
                rows.append(np.concatenate([half for pair in pairs for half in pair], axis=1))
            figures[f"psnr_given_{name}"] = round(float(np.mean(given)), 2)
            figures[f"psnr_others_{name}"] = round(float(np.mean(others)), 2)
    samplers = [model.sample] if isinstance(model, Generator) else []
    samplers += [model.sample_diffusion] if isinstance(model, DiffusionGenerator) else []
    for sampler in samplers:
        states = sampler(key, 2 * SAMPLES)
        for start in (0, SAMPLES):
            each = [_shown(model, _nth(states, start + i), learnt.T_object_camera[0, :1], size) for i in range(SAMPLES)]
            rows.append(np.round(255.0 * np.concatenate([rgb[0] for rgb in each], axis=1)).astype(np.uint8))
    return figures, np.concatenate([np.pad(row, ((0, 1), (0, 0), (0, 0)), constant_values=GREY) for row in rows])


def write_png(path: Path, rgb: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write a picture atomically."""
    height, width, _ = rgb.shape
    lines = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], axis=1)  # 0: not filtered
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines.tobytes())),
        (b"IEND", b""),
    )
    whole = (struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks)
    write_whole(path, b"\x89PNG\r\n\x1a\n" + b"".join(whole))


def _shown(model: Any, state: Any, T_object_camera: np.ndarray, size: int) -> Float[np.ndarray, "v s s 3"]:
    return np.asarray(_rendered(model, state, jnp.asarray(T_object_camera), size))


@partial(jax.jit, static_argnums=3)
def _rendered(model, state, T_object_camera, size):
    return model.render(state, T_object_camera, size)


def _nth(states: Any, n: int) -> Any:
    return jax.tree.map(lambda array: array[n], states)


@jax.jit
def _answers(model, pictures, poses, key):
    return jax.vmap(lambda picture, T: _nth(model.condition(picture, T, key, 1), 0))(pictures, poses)
