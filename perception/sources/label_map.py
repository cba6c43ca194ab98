"""Label maps from outside: what any instance segmenter writes."""

from pathlib import Path

import numpy as np
from jaxtyping import Int32, Shaped

from perception.sources.image_files import read_npy, read_npz, read_png

NAMES = ("label", "labels", "segmap", "seg", "segmentation", "masks", "mask")


def read_label_map(path: Path, size: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """Object ids (0: none) of a picture of `size` (height, width) from a PNG, .npy or .npz file.

    A PNG of one channel holds ids. An array of ids is h x w; of masks, n x h x w: these become ids 1 to n, a later one
    over an earlier one. Raises `FileNotFoundError` or `ValueError` naming the file and the remedy.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return as_labels(str(path), read_npy(path), size)
    if suffix == ".npz":
        arrays = read_npz(path, NAMES)
        if not arrays:
            raise ValueError(f"{path} has no array named {', '.join(NAMES)}; name the label map so")
        return as_labels(str(path), next(arrays[name] for name in NAMES if name in arrays), size)
    return as_labels(str(path), read_png(path), size)


def as_labels(name: str, values: Shaped[np.ndarray, "..."], size: tuple[int, int]) -> Int32[np.ndarray, "h w"]:
    """`values` as object ids. `name` stands in the error."""
    if values.ndim == 3 and values.shape[1:] == size and values.shape[0] not in (size[0], 0):
        over = np.zeros(size, np.int32)
        for number, mask in enumerate(values, start=1):
            over[mask > 0] = number
        return over
    if values.ndim == 3 and values.shape[:2] == size and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.shape != size:
        shape = "x".join(map(str, values.shape))
        raise ValueError(
            f"{name} is {shape}, the picture {size[0]}x{size[1]} (height x width); give one id a pixel, or masks"
            " n x height x width"
        )
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if finite.size != values.size or (finite != np.floor(finite)).any() or finite.min(initial=0) < 0:
        raise ValueError(f"{name} holds values that are no ids; give whole numbers, 0 for none")
    if finite.max(initial=0) > 1_000_000_000:
        raise ValueError(f"{name} holds id {int(finite.max())}; give ids below a thousand million")
    return values.astype(np.int32)
