"""The scores of probabilities at single points whose truth is known. NumPy arrays in, numbers out."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.measures.metrics import ECE_BINS, LOG_SCORE_CLIP, hidden_ece, hidden_log_score

CALLED_FREE = 0.05  # p_occupied up to which a point is called free


def point_scores(p: Float[np.ndarray, "n"], occupied: Bool[np.ndarray, "n"]) -> dict[str, Any]:
    """Scores of one object's points; NaN where a side is empty. p is clipped to 0.001 ... 0.999 in log scores.

    - log_score: mean -log of the probability of the truth, nats.
    - balanced: half the mean -log p over occupied points and half the mean -log(1 - p) over free ones, nats.
    - ece: expected calibration error in 15 bins of equal width.
    - free, free_occupied: how many points have p <= 0.05, and how many of these are occupied.
    - errors: of each bin sum (y - p) / n, with which the bins of several objects are pooled (`pooled_ece`).
    """
    q = np.clip(p, LOG_SCORE_CLIP, 1.0 - LOG_SCORE_CLIP)
    free = p <= CALLED_FREE
    bins = np.minimum((p * ECE_BINS).astype(int), ECE_BINS - 1)
    return {
        "log_score": float(np.mean(-np.log(np.where(occupied, q, 1.0 - q)))),
        "balanced": hidden_log_score(p[occupied], p[~occupied]),
        "ece": hidden_ece(p, occupied, np.ones(len(p), bool)),
        "free": int(free.sum()),
        "free_occupied": int((free & occupied).sum()),
        "errors": (np.bincount(bins, weights=occupied - p, minlength=ECE_BINS) / len(p)).tolist(),
    }


def pooled_ece(errors: Sequence[Sequence[float]]) -> float:
    """Expected calibration error of several objects' points in common bins, every object with the same weight."""
    return float(np.abs(np.mean(errors, axis=0)).sum())
