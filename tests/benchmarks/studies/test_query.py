"""Free boxes by whole shapes and by voxels: where the two part, and what is counted."""

import numpy as np
import pytest

from benchmarks.studies.query import ALONE, INDEPENDENT, JOINT, p_free_by_way, scores


def test_one_part_that_is_somewhere_and_one_place_that_is_doubtful() -> None:
    somewhere = np.eye(20, dtype=bool)  # each shape has it in another voxel
    said = p_free_by_way(somewhere, np.full(20, 0.05), np.ones(20, bool))
    assert said[JOINT] == 0.0 and said[INDEPENDENT] == pytest.approx(0.95**20) and said[ALONE] == 1.0
    doubtful = np.zeros((20, 20), bool)
    doubtful[0] = True  # one shape has all of it
    said = p_free_by_way(doubtful, np.full(20, 0.05), np.ones(20, bool))
    assert said[JOINT] == pytest.approx(0.95) and said[INDEPENDENT] == pytest.approx(0.95**20)
    nothing = p_free_by_way(doubtful, np.full(20, 0.05), np.zeros(20, bool))
    assert list(nothing.values()) == pytest.approx([1.0, 1.0, 1.0])


def test_scores_of_boxes() -> None:
    free = np.array([True, True, False, False])
    perfect, worst, even = (scores(p, free) for p in (free.astype(float), 1.0 - free, np.full(4, 0.5)))
    assert perfect["brier"] == 0.0 and worst["brier"] == 1.0 and even["brier"] == 0.25
    assert perfect["log_score"] == pytest.approx(-np.log(0.995)) and worst["log_score"] == pytest.approx(-np.log(0.005))
    assert (perfect["called_free"], perfect["wrong"]) == (0.5, 0.0) and worst["wrong"] == 0.5
    assert even["called_free"] == 0.0
