"""Pictures that the rivals learn from, on disk: one .npz, with arrays only."""

import zipfile
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float16, Int64, UInt8

from foundation.whole_file import whole_file


@dataclass(frozen=True, eq=False)
class PictureSet:
    """N objects, V views each, S x S pixels. Cameras have OpenCV axes; the object frame is the canonical cube's."""

    rgb: UInt8[np.ndarray, "n v s s 3"]  # white outside the object
    range: Float16[np.ndarray, "n v s s"]  # distance along the ray, cube units; 0: a miss
    T_object_camera: Float[np.ndarray, "n v 4 4"]
    tan_half_fov: Float[np.ndarray, ""]  # of all cameras
    seed: Int64[np.ndarray, "n"]  # of each object
    family: np.ndarray = field(default_factory=lambda: np.asarray(""))  # a text: what the objects are

    def save(self, path: Path) -> None:
        """Write atomically."""
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **{f.name: getattr(self, f.name) for f in fields(self)})


def load_pictures(path: Path) -> PictureSet:
    """Read what `PictureSet.save` wrote. Raises ValueError if the file is none, FileNotFoundError if there is none."""
    try:
        with np.load(path) as file:
            return PictureSet(**{f.name: file[f.name] for f in fields(PictureSet)})
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} holds no pictures ({error}); draw some with `python -m benchmarks.rivals.pictures`"
        ) from None
