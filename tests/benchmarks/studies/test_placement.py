"""Errors of place and size in widths: what is counted, and what the prior's tails are worth."""

import jax
import numpy as np
import pytest

from benchmarks.studies.placement import CONDITIONS, Options, gain, main, summary
from probnerf.likelihood.position import stretched
from probnerf.settings import InferConfig


def test_tails_are_worth_something_where_errors_have_them_and_cost_little_where_not() -> None:
    normal = jax.random.normal(jax.random.key(0), (4000, 3))
    tailed = np.asarray(stretched(normal, InferConfig().pose_tails), np.float64)
    assert gain(tailed).mean() > 0.3
    assert -0.6 < gain(np.asarray(normal, np.float64)).mean() < 0.0  # what their log-ratio is under the Gaussian


def test_errors_are_counted_by_their_size_and_sign() -> None:
    errors = np.zeros((100, 3))
    errors[:10, 2], errors[10:13, 2] = 5.0, -2.5
    found = summary({CONDITIONS[0]: errors})
    values = {(r.method, r.metric): r.value for r in found.rows}
    assert values["perception, log-scale", "larger"] == 0.1 and values["perception, log-scale", "smaller"] == 0.03
    assert values["perception, log-scale", "within_0.99"] == pytest.approx(5.0)
    assert values["perception, x", "larger"] == 0.0
    assert "+" in found.tables[1].lines[0][1] and found.picture is not None and len(found.picture().axes) == 3


@pytest.mark.slow
def test_a_few_objects_are_placed_in_every_condition(tmp_path) -> None:
    pytest.importorskip("embreex")
    pytest.importorskip("igl")
    found = main(Options(tmp_path, quick=True, n=3))
    assert {row.condition for row in found.rows} == set(CONDITIONS)
