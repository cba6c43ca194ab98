"""Metrics, one definition each. NumPy arrays in, Python floats out.

Symbols: S hypotheses with weights w_s (sum 1), p probabilities of occupancy, y true occupancy, G voxels per axis. A
metric of an empty set (a stratum without voxels, no box called free) is NaN, which `paired_interval` leaves out.
"""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.spatial import cKDTree
from scipy.stats import binom

BASE_RATE_SHARE = 0.02  # the share of the base rate that smoothing mixes into every method's probabilities
SCORED_RATES = (0.02, 0.98)  # voxels whose training-set frequency lies inside are scored; the others are known to all
ECE_BINS = 15
LOG_SCORE_CLIP = 0.001


# Images


def psnr(image: Float[np.ndarray, "..."], reference: Float[np.ndarray, "..."]) -> float:
    """Peak signal-to-noise ratio in dB of images in [0, 1]: -10 log10 of the mean squared error over all entries."""
    error = np.mean(np.square(np.asarray(image, np.float64) - reference))
    return float(-10.0 * np.log10(error)) if error > 0 else float("inf")


def energy_score(
    samples: Float[np.ndarray, "S ..."], weights: Float[np.ndarray, "S"], truth: Float[np.ndarray, "..."]
) -> float:
    """E|X - y| - E|X - X'| / 2 with the root-mean-square norm over entries; proper, smaller is better."""
    flat = np.asarray(samples, np.float64).reshape(len(samples), -1)
    to_truth = np.sqrt(np.mean(np.square(flat - np.ravel(truth)), axis=-1))
    square = np.sum(flat * flat, axis=-1)
    between = np.sqrt(np.maximum(square[:, None] + square - 2.0 * flat @ flat.T, 0.0) / flat.shape[1])
    return float(weights @ to_truth - 0.5 * weights @ between @ weights)


# Probabilities of hidden space


def smooth_probability(p: Float[np.ndarray, "..."], base_rate: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """(1 - l) p + l b, l = 0.02: the same smoothing for every method before a log score.

    b is the training-set frequency of occupancy at each voxel. Without it a method with S hypotheses is sure (0 or 1)
    wherever they agree, and one voxel would decide the score.
    """
    return (1.0 - BASE_RATE_SHARE) * np.asarray(p, np.float64) + BASE_RATE_SHARE * np.asarray(base_rate, np.float64)


def scored_voxels(seen: Bool[np.ndarray, "G G G"], base_rate: Float[np.ndarray, "G G G"]) -> Bool[np.ndarray, "G G G"]:
    """The fixed set that hidden_* are taken over: truly unseen, training-set frequency in (0.02, 0.98)."""
    return ~seen & (base_rate > SCORED_RATES[0]) & (base_rate < SCORED_RATES[1])


def hidden_nll(
    p: Float[np.ndarray, "..."],
    base_rate: Float[np.ndarray, "..."],
    truth: Bool[np.ndarray, "..."],
    scored: Bool[np.ndarray, "..."],
) -> float:
    """Mean -log of the smoothed probability of the true occupancy over the `scored` voxels, nats.

    `scored` is `scored_voxels`, or its intersection with a stratum (the handle's voxels).
    """
    q = smooth_probability(p, base_rate)[scored]
    return _mean(-np.log(np.where(truth[scored], q, 1.0 - q)))


def hidden_brier(p: Float[np.ndarray, "..."], truth: Bool[np.ndarray, "..."], scored: Bool[np.ndarray, "..."]) -> float:
    """Mean squared difference between probability and truth over the `scored` voxels."""
    return _mean(np.square(np.asarray(p, np.float64)[scored] - truth[scored]))


def hidden_ece(p: Float[np.ndarray, "..."], truth: Bool[np.ndarray, "..."], scored: Bool[np.ndarray, "..."]) -> float:
    """Expected calibration error over the `scored` voxels: 15 bins of equal width, weighted by count."""
    q, y = np.asarray(p, np.float64)[scored], truth[scored]
    if not len(q):
        return float("nan")
    bins = np.minimum((q * ECE_BINS).astype(int), ECE_BINS - 1)
    # sum_b n_b / n |mean y - mean q| = sum_b |sum (y - q)| / n
    return float(np.abs(np.bincount(bins, weights=y - q, minlength=ECE_BINS)).sum() / len(q))


def hidden_log_score(p_surface: Float[np.ndarray, "n"], p_free: Float[np.ndarray, "m"]) -> float:
    """Half the mean -log p_occupied over hidden surface points plus half the mean -log(1 - p_occupied) over unseen free
    points, probabilities clipped at 0.001, nats."""
    occupied = np.clip(p_surface, LOG_SCORE_CLIP, 1.0 - LOG_SCORE_CLIP)
    free = np.clip(p_free, LOG_SCORE_CLIP, 1.0 - LOG_SCORE_CLIP)
    return 0.5 * _mean(-np.log(occupied)) + 0.5 * _mean(-np.log1p(-free))


# Shapes


def iou(a: Bool[np.ndarray, "... G G G"], b: Bool[np.ndarray, "... G G G"]) -> Float[np.ndarray, "..."]:
    """Intersection over union of occupancies, over the last three axes; two empty shapes agree (1)."""
    both = np.count_nonzero(a & b, axis=(-3, -2, -1))
    either = np.count_nonzero(a | b, axis=(-3, -2, -1))
    return np.where(either > 0, both / np.maximum(either, 1), 1.0)


def mean_iou(
    occupied: Bool[np.ndarray, "S G G G"], weights: Float[np.ndarray, "S"], truth: Bool[np.ndarray, "G G G"]
) -> float:
    """Weighted mean over hypotheses of the IoU with the truth."""
    return float(weights @ iou(occupied, truth))


def best_of_k_iou(
    occupied: Bool[np.ndarray, "S G G G"], weights: Float[np.ndarray, "S"], truth: Bool[np.ndarray, "G G G"], k: int
) -> float:
    """Expected best IoU of k independent draws from the weighted hypotheses (exact: sum_i v_i (F_i^k - F_{i-1}^k))."""
    values = iou(occupied, truth)
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order]) / np.sum(weights)
    return float(values[order] @ np.diff(cumulative**k, prepend=0.0))


def recall(occupied: Bool[np.ndarray, "..."], part: Bool[np.ndarray, "..."]) -> float:
    """Share of the part's voxels (a handle, the hidden side) that are occupied: completeness."""
    return _mean(occupied[part].astype(np.float64))


def symmetric_chamfer(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> float:
    """Mean of the two directed mean nearest-neighbour distances (not squared, not summed), in the points' unit.

    For a voxel shape pass the points of `occupancy.voxel_surface`.
    """
    if not len(a) or not len(b):
        return float("inf")  # an empty shape is no answer, however small the other
    return 0.5 * float(cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean())


# Calibration of volumes and boxes


def ess_of_weights(weights: Float[np.ndarray, "S"]) -> float:
    """Effective sample size (sum w)^2 / sum w^2 of weights that need not be normalised."""
    return float(np.square(np.sum(weights)) / np.sum(np.square(weights)))


def randomised_rank(
    values: Float[np.ndarray, "S"],
    weights: Float[np.ndarray, "S"],
    truth: float,
    rng: np.random.Generator,
    truth_weight: float | None = None,
) -> float:
    """Randomised probability-integral-transform rank in [0, 1] of the truth among weighted values.

    (P(v < y) + U (P(v = y) + e)) / (1 + e), U ~ Uniform(0, 1): uniform for a calibrated sampler also where values have
    atoms (volumes at zero). The truth counts as one more draw of weight `e` = `truth_weight`, by default 1 / ESS:
    exactly uniform when the values are equally weighted independent draws. Pass 0 when the weighted values are the law
    itself.
    """
    w = np.asarray(weights, np.float64) / np.sum(weights)
    extra = 1.0 / ess_of_weights(w) if truth_weight is None else truth_weight
    below, equal = w @ (values < truth), w @ (values == truth)
    return float((below + rng.uniform() * (equal + extra)) / (1.0 + extra))


def coverage(ranks: Float[np.ndarray, "n"], level: float = 0.9) -> float:
    """Share of ranks in the central interval of `level`; calibrated: `level`."""
    return _mean(np.abs(np.asarray(ranks) - 0.5) <= 0.5 * level)


def ks_distance(ranks: Float[np.ndarray, "n"]) -> float:
    """Kolmogorov-Smirnov distance between the ranks' distribution and the uniform one."""
    u = np.sort(ranks)
    if not len(u):
        return float("nan")
    steps = np.arange(len(u) + 1) / len(u)
    return float(max(np.max(steps[1:] - u), np.max(u - steps[:-1])))


def uniform_band(
    n: int, level: float = 0.95, points: int = 50, simulations: int = 4000
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"], Float[np.ndarray, "points"]]:
    """Where the distribution function of n uniform ranks is evaluated, and its lowest and highest values there.

    The band is simultaneous: `level` of all uniform samples stay inside at every point (Sailynoja, Buerkner and Vehtari
    2022, with the coverage by simulation).
    """
    at = np.arange(1, points) / points
    drawn = np.random.default_rng(0).random((simulations, n))
    below = np.stack([(drawn <= a).sum(axis=1) for a in at], axis=1)
    tail = np.minimum(binom.cdf(below, n, at), binom.sf(below - 1, n, at))  # of the less likely side, at each point
    each = np.quantile(tail.min(axis=1), 1.0 - level)
    return at, binom.ppf(each, n, at) / n, binom.isf(each, n, at) / n


def falsely_free(p_free: Float[np.ndarray, "n"], occupied: Bool[np.ndarray, "n"], threshold: float = 0.95) -> float:
    """Share of truly occupied boxes among those given p_free > threshold."""
    return _mean(np.asarray(occupied)[np.asarray(p_free) > threshold])


def _mean(values: Shaped[np.ndarray, "n"]) -> float:
    return float(np.mean(values)) if np.size(values) else float("nan")
