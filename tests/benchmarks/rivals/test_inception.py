"""Inception's features: the structure as published, each operation beside a second implementation, random weights."""

from collections.abc import Callable
from math import prod
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from benchmarks.rivals import inception
from benchmarks.rivals.inception import BLOCKS, FEATURES, inception_features, load_inception, shapes, through_block

Arrays = dict[str, np.ndarray]
INPUTS = dict(zip(BLOCKS, (192, 256, 288, 288, 768, 768, 768, 768, 768, 1280, 2048), strict=True))
LAST = "branch3x3dbl_3a", "branch3x3dbl_3b", "branch_pool"
DOUBLE = ("branch3x3dbl_1", "branch3x3dbl_2")
BRANCHES = {  # of pytorch-fid's blocks, in the order in which their outputs are concatenated
    "A": ("branch1x1", "branch5x5_1", "branch5x5_2", *DOUBLE, "branch3x3dbl_3", "branch_pool"),
    "B": ("branch3x3", *DOUBLE, "branch3x3dbl_3"),
    "C": ("branch1x1", *(f"branch7x7_{i}" for i in "123"), *(f"branch7x7dbl_{i}" for i in "12345"), "branch_pool"),
    "D": ("branch3x3_1", "branch3x3_2", *(f"branch7x7x3_{i}" for i in "1234")),
    "E": ("branch1x1", *(f"branch3x3_{i}" for i in ("1", "2a", "2b")), *DOUBLE, *LAST),
}
STEM = ("Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "Conv2d_3b_1x1", "Conv2d_4a_3x3")
KINDS = dict(zip(BLOCKS, "AAABCCCCDEE", strict=True))


def random_arrays(names: Callable[[str], bool] = lambda name: True) -> Arrays:
    """Of the network's shapes, so that outputs keep the size of inputs."""
    rng, found = np.random.default_rng(3), {}
    for name, shape in shapes().items():
        if not names(name):
            continue
        spread = (2.0 / prod(shape[1:])) ** 0.5 if len(shape) == 4 else 0.2
        values = spread * rng.standard_normal(shape, np.float32)
        found[name] = 1.0 + np.abs(values) if name.endswith(("bn.weight", "running_var")) else values
    return found


def test_names_are_those_of_the_published_network() -> None:
    names = [*STEM, *(f"{block}.{branch}" for block, kind in KINDS.items() for branch in BRANCHES[kind])]
    parts = ("conv.weight", "bn.weight", "bn.bias", "bn.running_mean", "bn.running_var")
    assert list(shapes()) == [f"{name}.{part}" for name in names for part in parts]


def test_sizes_are_those_of_the_published_network() -> None:
    """94 convolutions of 17,216 channels; Keras counts 21,802,784 numbers without gammas and classifier."""
    kernels = [shape for name, shape in shapes().items() if name.endswith("conv.weight")]
    channels = sum(shape[0] for shape in kernels)
    assert len(kernels) == 94 and channels == 17_216
    assert sum(map(prod, kernels)) + 3 * channels == 21_802_784
    assert shapes()["Mixed_6b.branch7x7_2.conv.weight"] == (128, 128, 1, 7)
    assert shapes()["Mixed_7c.branch3x3dbl_3b.conv.weight"] == (384, 384, 3, 1)
    assert {name: shapes()[f"{name}.{BRANCHES[KINDS[name]][0]}.conv.weight"][1] for name in BLOCKS} == INPUTS


def convolved(x: np.ndarray, name: str, arrays: Arrays, stride: int = 1, padded: bool = True) -> np.ndarray:
    """Convolution, batch normalisation and ReLU of one picture, pixel by pixel."""
    kernel, (height, width) = arrays[f"{name}.conv.weight"].astype(np.float64), x.shape[1:]
    h, w = kernel.shape[2:]
    x = np.pad(x, ((0, 0), (h // 2,) * 2, (w // 2,) * 2)) if padded else x
    rows, columns = ((x.shape[1] - h) // stride + 1, (x.shape[2] - w) // stride + 1)
    y = np.empty((len(kernel), rows, columns))
    for i in range(rows):
        for j in range(columns):
            window = x[:, stride * i : stride * i + h, stride * j : stride * j + w]
            y[:, i, j] = np.tensordot(kernel, window, 3)
    assert not padded or stride > 1 or y.shape[1:] == (height, width)
    scale, shift, mean, variance = (
        arrays[f"{name}.bn.{part}"][:, None, None] for part in ("weight", "bias", "running_mean", "running_var")
    )
    return np.maximum((y - mean) / np.sqrt(variance + 0.001) * scale + shift, 0.0)


def pooled(x: np.ndarray, by: Callable, stride: int = 1) -> np.ndarray:
    """3 x 3; with stride 1 the windows at the border are cut, so that what pads is not counted."""
    _, height, width = x.shape
    if stride == 2:
        starts = [(i, j) for i in range(0, height - 2, 2) for j in range(0, width - 2, 2)]
        each = [by(x[:, i : i + 3, j : j + 3], axis=(1, 2)) for i, j in starts]
        return np.stack(each, axis=1).reshape(len(x), (height - 1) // 2, (width - 1) // 2)
    y = np.empty_like(x)
    for i in range(height):
        for j in range(width):
            y[:, i, j] = by(x[:, max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2], axis=(1, 2))
    return y


def second(block: str, x: np.ndarray, arrays: Arrays) -> np.ndarray:
    """The same block, written branch by branch."""

    def through(x: np.ndarray, *names: str) -> np.ndarray:
        for name in names:
            x = convolved(x, f"{block}.{name}", arrays)
        return x

    def halved(x: np.ndarray, name: str) -> np.ndarray:
        return convolved(x, f"{block}.{name}", arrays, 2, False)

    kind = KINDS[block]
    if kind == "B":
        double = through(x, "branch3x3dbl_1", "branch3x3dbl_2")
        parts = [halved(x, "branch3x3"), halved(double, "branch3x3dbl_3"), pooled(x, np.max, 2)]
    elif kind == "D":
        seven = through(x, *(f"branch7x7x3_{i}" for i in "123"))
        parts = [halved(through(x, "branch3x3_1"), "branch3x3_2"), halved(seven, "branch7x7x3_4"), pooled(x, np.max, 2)]
    else:
        middle = {"A": [("branch5x5", 2), ("branch3x3dbl", 3)], "C": [("branch7x7", 3), ("branch7x7dbl", 5)], "E": []}
        parts = [through(x, "branch1x1")]
        parts += [through(x, *(f"{name}_{i + 1}" for i in range(n))) for name, n in middle[kind]]
        if kind == "E":
            for stem, last in ((through(x, "branch3x3_1"), "branch3x3_2"), (None, "branch3x3dbl_3")):
                stem = through(x, "branch3x3dbl_1", "branch3x3dbl_2") if stem is None else stem
                parts += [through(stem, f"{last}a"), through(stem, f"{last}b")]
        parts.append(through(pooled(x, np.max if block == "Mixed_7c" else np.mean), "branch_pool"))
    return np.concatenate(parts)


@pytest.mark.parametrize("block", ["Mixed_5b", "Mixed_6a", "Mixed_6b", "Mixed_7a", "Mixed_7b", "Mixed_7c"])
def test_a_block_is_its_second_implementation(block: str) -> None:
    """One of each kind; the last two differ in how they pool."""
    arrays = random_arrays(lambda name: name.startswith(f"{block}."))
    x = np.random.default_rng(4).standard_normal((INPUTS[block], 5, 4)).astype(np.float32)
    made = through_block(block, BLOCKS[block], jnp.asarray(x), {name: jnp.asarray(a) for name, a in arrays.items()})
    expected = second(block, x.astype(np.float64), arrays)
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(np.asarray(made), expected, atol=2e-4 * np.abs(expected).max())


def test_a_picture_is_resized_between_its_pixels_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """As PyTorch's `interpolate(mode="bilinear", align_corners=False)`, then [-1, 1]."""
    rng, side = np.random.default_rng(5), inception.SIDE
    rgb = rng.uniform(0.0, 1.0, (7, 7, 3))
    at = np.clip((np.arange(side) + 0.5) * 7 / side - 0.5, 0.0, 6.0)
    low = np.minimum(at.astype(int), 5)
    share = at - low
    rows = rgb[low] * (1.0 - share)[:, None, None] + rgb[low + 1] * share[:, None, None]
    expected = rows[:, low] * (1.0 - share)[:, None] + rows[:, low + 1] * share[:, None]
    seen: list[np.ndarray] = []

    def through(prefix, branch, x, weights):
        seen.append(np.asarray(x))
        return x

    monkeypatch.setattr(inception, "_through", through)
    monkeypatch.setattr(inception, "BLOCKS", {})
    mean = inception.features_of_one({}, jnp.asarray(rgb))
    np.testing.assert_allclose(seen[0], 2.0 * np.moveaxis(expected, 2, 0) - 1.0, atol=1e-5)
    np.testing.assert_allclose(mean, seen[0].mean(axis=(1, 2)), atol=1e-6)


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_weights_are_read_and_what_is_wrong_with_them_is_said(suffix: str, tmp_path: Path) -> None:
    def written(arrays: Arrays) -> Path:
        path = tmp_path / f"inception{suffix}"
        np.savez(path, **arrays) if suffix == ".npz" else save_file(arrays, path)
        return path

    arrays = {name: np.zeros(shape, np.float16) for name, shape in shapes().items()}
    whole = arrays | {"fc.bias": np.zeros(1008, np.float16)}
    assert list(load_inception(written(whole))) == list(arrays)
    for wrong, message in (
        (
            {name: a for name, a in arrays.items() if name != "Mixed_7c.branch_pool.bn.bias"},
            "has no array 'Mixed_7c.bra",
        ),
        (arrays | {"Conv2d_1a_3x3.bn.bias": np.zeros(3, np.float16)}, r"has shape \(3,\), not \(32,\)"),
        (arrays | {"fc.bias": np.zeros(1000, np.float16)}, "tells 1000 classes, not 1008"),
    ):
        with pytest.raises(ValueError, match=message):
            load_inception(written(wrong))
    (tmp_path / f"inception{suffix}").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="is no readable"):
        load_inception(tmp_path / f"inception{suffix}")
    with pytest.raises(FileNotFoundError, match="no such weights"):
        load_inception(tmp_path / f"none{suffix}")


@pytest.mark.nightly
def test_whole_pictures_have_features(optimised: None) -> None:
    weights = {name: jax.numpy.asarray(a) for name, a in random_arrays().items()}
    rgb = np.random.default_rng(6).uniform(0.0, 1.0, (3, 64, 64, 3)).astype(np.float32)
    found = inception_features(weights, rgb)
    assert found.shape == (3, FEATURES) and np.isfinite(found).all() and (found >= 0).all()
    np.testing.assert_allclose(found[1], inception.features_of_one(weights, jnp.asarray(rgb[1])), rtol=1e-3, atol=1e-4)
    assert np.abs(found[0] - found[1]).max() > 1e-3
