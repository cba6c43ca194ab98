"""How far two sets of pictures are apart: the Fréchet distance of Gaussians fitted to their features."""

import numpy as np
from jaxtyping import Float


def frechet_distance(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> float:
    """|mean_a - mean_b|^2 + tr(C_a + C_b - 2 (C_a C_b)^(1/2)) (Heusel et al. 2017, eq. 6), in the features' units.

    It is biased upwards: two sets of n draws of one distribution are apart by about c / n (0 for n without end). So
    only distances at equal n are compared, beside that of two sets of true pictures. Raises ValueError for fewer than
    two rows.
    """
    if min(len(a), len(b)) < 2:
        raise ValueError(f"sets of {len(a)} and {len(b)} have no covariance; give 2 pictures or more of each")
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    gap = a.mean(axis=0) - b.mean(axis=0)
    covariance_a, covariance_b = np.atleast_2d(np.cov(a, rowvar=False)), np.atleast_2d(np.cov(b, rowvar=False))
    values, vectors = np.linalg.eigh(covariance_a)
    root = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    between = np.linalg.eigvalsh(root @ covariance_b @ root)  # those of C_a C_b, but symmetric
    trace = np.trace(covariance_a) + np.trace(covariance_b) - 2.0 * np.sqrt(np.maximum(between, 0.0)).sum()
    return float(gap @ gap + max(trace, 0.0))
