"""The schedule entry of an answer, and digests that tell whether a repeat has the same result."""

import hashlib
import json
from dataclasses import asdict
from typing import Any

import numpy as np

from perception.answers.hypotheses import Hypotheses
from perception.sources.schedule_entry import Scheduled, StartedFrom


def scheduled(h: Hypotheses, config_hash: str, started_from: StartedFrom = "fresh") -> Scheduled:
    """The schedule entry of new hypotheses."""
    return Scheduled(
        h.stamp_ns, h.object_id, h.stage, h.seed, h.prior_hash, config_hash, digest(h), started_from=started_from
    )


def config_hash(*configs: Any) -> str:
    """16 hexadecimal digits that identify configurations (dataclasses) by the values of their fields."""
    text = json.dumps([asdict(config) for config in configs], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def digest(h: Hypotheses) -> str:
    """16 hexadecimal digits that identify the arrays of hypotheses: opacity, pose and weights, bit for bit."""
    state = hashlib.blake2b(digest_size=8)
    for array, dtype in ((h.opacity, np.uint8), (h.pose, np.float32), (h.weights, np.float64)):
        state.update(np.ascontiguousarray(array, dtype).data)
    return state.hexdigest()
