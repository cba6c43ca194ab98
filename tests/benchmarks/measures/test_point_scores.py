"""The scores of points are what their names say, on values known by hand."""

import numpy as np
import pytest

from benchmarks.measures.point_scores import point_scores, pooled_ece


def test_known_values() -> None:
    p = np.array([0.9, 0.2, 0.0, 0.05, 1.0])
    told = point_scores(p, np.array([True, True, True, False, False]))
    occupied, free = -np.log([0.9, 0.2, 0.001]), -np.log([0.95, 0.001])
    assert told["balanced"] == pytest.approx(0.5 * occupied.mean() + 0.5 * free.mean())
    assert told["log_score"] == pytest.approx((occupied.sum() + free.sum()) / 5)
    assert (told["free"], told["free_occupied"]) == (2, 1)
    # bins: {0.9, 1.0} would be 13 and 14; {0.0, 0.05} is one; {0.2} alone
    assert told["ece"] == pytest.approx((0.1 + 1.0 + 0.95 + 0.8) / 5)
    assert pooled_ece([told["errors"]]) == pytest.approx(told["ece"])


def test_one_half_everywhere_scores_log_two() -> None:
    told = point_scores(np.full(10, 0.5), np.arange(10) < 3)
    assert told["balanced"] == told["log_score"] == pytest.approx(np.log(2.0))
    assert told["ece"] == pytest.approx(0.2) and told["free"] == 0


def test_errors_of_opposite_sign_cancel_when_objects_are_pooled() -> None:
    one, other = (point_scores(np.full(4, 0.5), np.full(4, y)) for y in (True, False))
    assert one["ece"] == other["ece"] == 0.5 and pooled_ece([one["errors"], other["errors"]]) == 0.0
    assert np.isnan(one["balanced"])  # it has no free points
