"""A frame as arrays in one .npz file: rgb, depth (m), K and, where there is one, a label map."""

from pathlib import Path

import numpy as np

from perception.sources.frame import Frame, known_counts
from perception.sources.image_files import read_npz
from perception.sources.label_map import NAMES as LABELS
from perception.sources.label_map import as_labels

_RGB, _DEPTH = ("rgb", "color", "colour", "image"), ("depth",)
_K, _POSE = ("k", "camera_matrix", "intrinsics", "cam_k"), ("t_world_camera",)


def read_frame_arrays(path: Path) -> Frame:
    """The frame in a .npz file.

    Arrays, whatever the case of their names: `rgb` (h x w x 3; uint8, or 0 to 1), `depth` (h x w; m, or millimetres if
    integer), `K` (3 x 3, px), and optionally `segmap` (see `read_label_map`) and `T_world_camera` (4 x 4, m). Raises
    `FileNotFoundError` or `ValueError` naming the file and the remedy.
    """
    arrays = read_npz(path, (*_RGB, *_DEPTH, *_K, *_POSE, *LABELS))

    def one(names: tuple[str, ...]) -> np.ndarray | None:
        return next((arrays[name] for name in names if name in arrays), None)

    rgb, depth, K, label, pose = map(one, (_RGB, _DEPTH, _K, LABELS, _POSE))
    if rgb is None or K is None:
        missing = "rgb" if rgb is None else "K"
        raise ValueError(f"{path} has no array {missing}; a frame has rgb, depth (m), K and perhaps segmap")
    if rgb.dtype.kind == "f" and ((rgb >= 0.0) & (rgb <= 1.0)).all():
        rgb = np.rint(255.0 * rgb).astype(np.uint8)
    if depth is not None:
        depth = np.squeeze(depth)
        if depth.dtype.itemsize == 1:
            raise ValueError(f"{path}: depth holds {depth.dtype}; save metres, or millimetres in 16 bits")
        if depth.dtype.kind in "iu":  # as in depth images (REP 118)
            depth = known_counts(depth).astype(np.float32) * np.float32(1e-3)
    if rgb.ndim != 3:
        raise ValueError(f"{path}: rgb is {list(rgb.shape)}; give height x width x 3")
    if K.shape != (3, 3) or (pose is not None and pose.shape != (4, 4)):
        raise ValueError(f"{path}: K is {list(K.shape)} (3x3 wanted), T_world_camera 4x4 if given; save them again")
    try:
        if label is not None:
            label = as_labels("the label map", label, (int(rgb.shape[0]), int(rgb.shape[1])))
        return Frame(rgb, depth, K.astype(np.float64), label, T_world_camera=pose)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
