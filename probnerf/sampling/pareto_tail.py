"""How heavy the tail of importance weights is: the shape k of a generalised Pareto distribution fitted to it.

The weights have finite moments up to order 1 / k. Estimates converge at a practical rate where k < 0.7 (Vehtari,
Simpson, Gelman, Yao and Gabry, 2024: Pareto smoothed importance sampling). Nothing is smoothed here.
"""

import numpy as np
from jaxtyping import Float

_PRIOR_SIZE = 10  # observations that the weak prior on k counts for; it has mean 1/2


def pareto_k(log_weights: Float[np.ndarray, "n"]) -> float:
    """k of the largest min(n / 5, 3 sqrt n) weights, which need not be normalised.

    NaN if it is not defined: fewer than 5 weights in the tail, or a quarter of these as large as the largest weight
    outside of it.
    """
    size = min(len(log_weights) // 5, int(np.ceil(3.0 * np.sqrt(len(log_weights)))))
    if size < 5:
        return float("nan")
    largest = np.sort(np.asarray(log_weights, np.float64))[-size - 1 :]
    if not np.isfinite(largest[-1]):
        return float("nan")
    weights = np.exp(largest - largest[-1])
    return _fitted(weights[1:] - weights[0])


def _fitted(excess: Float[np.ndarray, "n"]) -> float:
    """k of ascending excesses over a threshold: an empirical Bayes estimate (Zhang and Stephens, 2009), and then the
    weak prior of Vehtari et al., section 3.
    """
    count = len(excess)
    quartile = excess[int(count / 4 + 0.5) - 1]
    if not quartile > 0.0:
        return float("nan")
    grid = 30 + int(np.sqrt(count))
    theta = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(grid) + 0.5))) / (3.0 * quartile)
    k = np.log1p(-theta[:, None] * excess).mean(axis=1)
    profile = count * (np.log(-theta / k) - k - 1.0)
    share = np.exp(profile - profile.max())
    mean = float(share @ theta / share.sum())
    found = float(np.log1p(-mean * excess).mean())
    return (count * found + 0.5 * _PRIOR_SIZE) / (count + _PRIOR_SIZE)
