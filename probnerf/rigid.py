"""Rigid transforms: what a pose must be, whoever gives it."""

import numpy as np
from jaxtyping import Bool, Float


def rigid(T: Float[np.ndarray, "*n 4 4"]) -> Bool[np.ndarray, "*n"]:
    """Whether each is a rotation R (R R^T = I to 1e-3, det R > 0) beside a translation, 0 0 0 1 below; all finite."""
    finite = np.isfinite(T).all(axis=(-2, -1))
    T = np.where(finite[..., None, None], T, 0.0)
    R = T[..., :3, :3]
    turns = (np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)) < 1e-3).all(axis=(-2, -1)) & (np.linalg.det(R) > 0)
    return finite & turns & (np.abs(T[..., 3, :] - [0, 0, 0, 1]) < 1e-6).all(axis=-1)
