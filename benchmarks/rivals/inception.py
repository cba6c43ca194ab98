"""Inception features of pictures, from a weights file that the user gives: those that most papers' FID is of.

The network is InceptionV3 of 2015-12-05 as pytorch-fid has it (names of its arrays, too): average pooling does not
count what pads, and the last block pools by maximum. The weights are not part of this project. They are written once
into a file that cannot execute code, where PyTorch is installed:

    python -c "import safetensors.torch as s, torch; s.save_file({k: v.contiguous() for k, v in torch.load(
    'pt_inception-2015-12-05-6726825d.pth', weights_only=True).items()}, 'inception.safetensors')"

An .npz of the same arrays serves, too. Without the weights, what is tested is the structure: names and shapes, and
each operation beside a second implementation, on random weights.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open

FEATURES, SIDE, CHUNK = 2048, 299, 8  # of a picture; px a side that it sees; pictures at a time
EPSILON = 0.001  # of the batch normalisation
OF_EACH = {"conv.weight": 4, "bn.weight": 1, "bn.bias": 1, "bn.running_mean": 1, "bn.running_var": 1}  # axes
CLASSES = 1008  # that the classifier tells, which features do not need; torchvision's own InceptionV3 tells 1000
Weights = dict[str, Array]


class Convolution(NamedTuple):
    """Without bias, then batch normalisation and ReLU."""

    name: str
    outputs: int
    kernel: tuple[int, int] = (1, 1)
    stride: int = 1
    padded: bool = True  # to the same size, if the stride is 1


class Pool(NamedTuple):
    """Of 3 x 3: padded with stride 1, else valid with stride 2."""

    by: str  # "mean" or "max"
    stride: int = 1


class Split(NamedTuple):
    """Convolutions of the same input, concatenated."""

    parts: tuple[Convolution, ...]


Step = Convolution | Pool | Split
Branch = tuple[Step, ...]
Block = tuple[Branch, ...]  # outputs are concatenated


def _a(pooled: int) -> Block:
    return (
        (Convolution("branch1x1", 64),),
        (Convolution("branch5x5_1", 48), Convolution("branch5x5_2", 64, (5, 5))),
        (
            Convolution("branch3x3dbl_1", 64),
            Convolution("branch3x3dbl_2", 96, (3, 3)),
            Convolution("branch3x3dbl_3", 96, (3, 3)),
        ),
        (Pool("mean"), Convolution("branch_pool", pooled)),
    )


def _c(inner: int) -> Block:
    return (
        (Convolution("branch1x1", 192),),
        (
            Convolution("branch7x7_1", inner),
            Convolution("branch7x7_2", inner, (1, 7)),
            Convolution("branch7x7_3", 192, (7, 1)),
        ),
        (
            Convolution("branch7x7dbl_1", inner),
            Convolution("branch7x7dbl_2", inner, (7, 1)),
            Convolution("branch7x7dbl_3", inner, (1, 7)),
            Convolution("branch7x7dbl_4", inner, (7, 1)),
            Convolution("branch7x7dbl_5", 192, (1, 7)),
        ),
        (Pool("mean"), Convolution("branch_pool", 192)),
    )


def _e(pool: str) -> Block:
    def split(name: str) -> Split:
        return Split((Convolution(f"{name}a", 384, (1, 3)), Convolution(f"{name}b", 384, (3, 1))))

    return (
        (Convolution("branch1x1", 320),),
        (Convolution("branch3x3_1", 384), split("branch3x3_2")),
        (Convolution("branch3x3dbl_1", 448), Convolution("branch3x3dbl_2", 384, (3, 3)), split("branch3x3dbl_3")),
        (Pool(pool), Convolution("branch_pool", 192)),
    )


_B: Block = (
    (Convolution("branch3x3", 384, (3, 3), 2, False),),
    (
        Convolution("branch3x3dbl_1", 64),
        Convolution("branch3x3dbl_2", 96, (3, 3)),
        Convolution("branch3x3dbl_3", 96, (3, 3), 2, False),
    ),
    (Pool("max", 2),),
)
_D: Block = (
    (Convolution("branch3x3_1", 192), Convolution("branch3x3_2", 320, (3, 3), 2, False)),
    (
        Convolution("branch7x7x3_1", 192),
        Convolution("branch7x7x3_2", 192, (1, 7)),
        Convolution("branch7x7x3_3", 192, (7, 1)),
        Convolution("branch7x7x3_4", 192, (3, 3), 2, False),
    ),
    (Pool("max", 2),),
)
STEM: Branch = (
    Convolution("Conv2d_1a_3x3", 32, (3, 3), 2, False),
    Convolution("Conv2d_2a_3x3", 32, (3, 3), 1, False),
    Convolution("Conv2d_2b_3x3", 64, (3, 3)),
    Pool("max", 2),
    Convolution("Conv2d_3b_1x1", 80),
    Convolution("Conv2d_4a_3x3", 192, (3, 3), 1, False),
    Pool("max", 2),
)
BLOCKS: dict[str, Block] = {
    "Mixed_5b": _a(32), "Mixed_5c": _a(64), "Mixed_5d": _a(64), "Mixed_6a": _B, "Mixed_6b": _c(128),
    "Mixed_6c": _c(160), "Mixed_6d": _c(160), "Mixed_6e": _c(192), "Mixed_7a": _D, "Mixed_7b": _e("mean"),
    "Mixed_7c": _e("max"),
}  # fmt: skip


def shapes() -> dict[str, tuple[int, ...]]:
    """Of all arrays that the features need, by name."""
    found: dict[str, tuple[int, ...]] = {}
    channels = _branch_shapes("", STEM, 3, found)
    for name, block in BLOCKS.items():
        channels = sum(_branch_shapes(f"{name}.", branch, channels, found) for branch in block)
    assert channels == FEATURES
    return found


def _branch_shapes(prefix: str, branch: Branch, channels: int, found: dict[str, tuple[int, ...]]) -> int:
    """Adds the branch's shapes; how many channels leave it."""
    for step in branch:
        parts = _convolutions(step)
        for part in parts:
            whole = (part.outputs, channels, *part.kernel)
            found |= {f"{prefix}{part.name}.{name}": whole[:axes] for name, axes in OF_EACH.items()}
        channels = sum(part.outputs for part in parts) or channels
    return channels


def _convolutions(step: Step) -> tuple[Convolution, ...]:
    return step.parts if isinstance(step, Split) else () if isinstance(step, Pool) else (step,)


def load_inception(path: Path) -> Weights:
    """The arrays of a .safetensors or .npz file, in single precision.

    Raises FileNotFoundError if there is no file. Raises ValueError if it cannot be read, lacks an array or has one of
    another shape, or has the classifier of torchvision's own InceptionV3, whose features are others.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights; `benchmarks/rivals/inception.py` says how to make them")
    try:
        arrays = dict(_arrays(path))
    except (SafetensorError, BadZipFile, ValueError, OSError) as error:
        raise ValueError(
            f"{path} is no readable .safetensors or .npz file ({error});"
            " write it as `benchmarks/rivals/inception.py` says"
        ) from None
    remedy = "give the weights of pytorch-fid's InceptionV3"
    for name, shape in shapes().items():
        if name not in arrays:
            raise ValueError(f"{path} has no array '{name}'; {remedy}")
        if arrays[name].shape != shape:
            raise ValueError(f"{path}: array '{name}' has shape {arrays[name].shape}, not {shape}; {remedy}")
    if (told := arrays.get("fc.bias")) is not None and len(told) != CLASSES:
        raise ValueError(f"{path} tells {len(told)} classes, not {CLASSES}: it is another InceptionV3; {remedy}")
    return {name: jnp.asarray(arrays[name], jnp.float32) for name in shapes()}


def _arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    if path.suffix == ".npz":
        with np.load(path) as file:
            yield from ((name, file[name]) for name in file.files)
        return
    with safe_open(path, framework="np") as file:
        yield from ((name, file.get_tensor(name)) for name in file.keys())


def inception_features(weights: Weights, rgb: Float[np.ndarray, "n s s 3"]) -> Float[np.ndarray, "n f"]:
    """The last average pool of pictures in [0, 1], which are resized to 299 x 299 as pytorch-fid does."""
    return np.asarray(_features_of(weights, jnp.asarray(rgb, jnp.float32)))


@jax.jit
def _features_of(weights: Weights, rgb: Float[Array, "n s s 3"]) -> Float[Array, "n f"]:
    return lax.map(lambda one: features_of_one(weights, one), rgb, batch_size=CHUNK)


def features_of_one(weights: Weights, rgb: Float[Array, "s s 3"]) -> Float[Array, "f"]:
    """Of one picture in [0, 1]; bilinear between pixels' centres, no filter, then [-1, 1]."""
    seen = jax.image.resize(rgb, (SIDE, SIDE, 3), "bilinear", antialias=False)
    x = _through("", STEM, 2.0 * jnp.moveaxis(seen, 2, 0) - 1.0, weights)
    for name, block in BLOCKS.items():
        x = through_block(name, block, x, weights)
    return x.mean(axis=(1, 2))


def through_block(name: str, block: Block, x: Float[Array, "i h w"], weights: Weights) -> Float[Array, "o h2 w2"]:
    """What its branches make of x, concatenated."""
    return jnp.concatenate([_through(f"{name}.", branch, x, weights) for branch in block])


def _through(prefix: str, branch: Branch, x: Float[Array, "i h w"], weights: Weights) -> Float[Array, "o h2 w2"]:
    for step in branch:
        if isinstance(step, Pool):
            x = _pooled(step, x)
        else:
            x = jnp.concatenate([_convolved(prefix, part, x, weights) for part in _convolutions(step)])
    return x


def _convolved(prefix: str, step: Convolution, x: Float[Array, "i h w"], weights: Weights) -> Float[Array, "o h2 w2"]:
    kernel, scale, shift, mean, variance = (weights[f"{prefix}{step.name}.{name}"] for name in OF_EACH)
    padding = [(k // 2, k // 2) if step.padded else (0, 0) for k in step.kernel]
    y = lax.conv_general_dilated(x[None], kernel, (step.stride, step.stride), padding)[0]
    scale = scale * lax.rsqrt(variance + EPSILON)
    return jax.nn.relu(y * scale[:, None, None] + (shift - mean * scale)[:, None, None])


def _pooled(step: Pool, x: Float[Array, "c h w"]) -> Float[Array, "c h2 w2"]:
    padding = "SAME" if step.stride == 1 else "VALID"
    window, strides = (1, 3, 3), (1, step.stride, step.stride)
    if step.by == "max":
        return lax.reduce_window(x, -jnp.inf, lax.max, window, strides, padding)
    counted = lax.reduce_window(jnp.ones_like(x[:1]), 0.0, lax.add, window, strides, padding)
    return lax.reduce_window(x, 0.0, lax.add, window, strides, padding) / counted
