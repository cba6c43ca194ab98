"""Uncertainty of least squares whose errors are alike within a group, such as one picture or one pose of a robot."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_MOST_LEVERAGE = 0.98  # of a group; what one group alone determines has no other to be compared with


def covariance(
    jacobians: Sequence[Float[np.ndarray, "m q"]],
    residuals: Sequence[Float[np.ndarray, "m"]],
    scale: Float[np.ndarray, "q"],
    prior: Float[np.ndarray, "k q"],
    noise: float,
) -> Float[np.ndarray, "q q"]:
    """Covariance of the q parameters at a solution, from the derivatives and residuals of each group.

    Errors within a group may be correlated in any way: of corners in one picture by blur, by the detector's bias and
    by the board's shape. The estimate is the jackknife that leaves out one group at a time, to first order (the
    sandwich CR3 of Bell and McCaffrey, 2002). No deviation is less than that for independent errors of size `noise`.
    `scale` is the size of each parameter's column before anything was fitted out of it. `prior` are the rows, in the
    units of the residuals, that least squares had besides. A parameter that is not determined gets a very large value.
    """
    U, s, Vt = np.linalg.svd(np.concatenate([*jacobians, prior]) / scale, full_matrices=False)
    white = (Vt / np.maximum(s, 1e-12)[:, None]).T / scale[:, None]  # jacobian @ white has orthonormal columns
    ends = np.cumsum([len(r) for r in residuals])
    scores = []
    for rows, r in zip(np.split(U[: ends[-1]], ends[:-1]), residuals, strict=True):
        leverage, axes = np.linalg.eigh(rows.T @ rows)
        scores.append(axes @ ((axes.T @ (rows.T @ r)) / (1.0 - np.minimum(leverage, _MOST_LEVERAGE))))
    held = U[ends[-1] :]
    groups = len(residuals)
    spread = (groups - 1) / groups * np.einsum("gi,gj->ij", scores, scores) + noise**2 * held.T @ held
    robust = white @ (spread + (1e-3 * noise) ** 2 * np.eye(len(spread))) @ white.T  # without scores: as independent
    wider = np.maximum(noise * np.linalg.norm(white, axis=1) / np.sqrt(np.diag(robust)), 1.0)
    return robust * np.outer(wider, wider)
