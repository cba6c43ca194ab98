"""Errors of place and size in widths: what is counted."""

import numpy as np
import pytest

from benchmarks.studies.placement import CONDITIONS, Options, main, summary


def test_errors_are_counted_by_their_size_and_sign() -> None:
    errors = np.zeros((100, 3))
    errors[:10, 2], errors[10:13, 2] = 5.0, -2.5
    found = summary({CONDITIONS[0]: errors})
    values = {(r.method, r.metric): r.value for r in found.rows}
    assert values["perception, log-scale", "larger"] == 0.1 and values["perception, log-scale", "smaller"] == 0.03
    assert values["perception, log-scale", "within_0.99"] == pytest.approx(5.0)
    assert values["perception, x", "larger"] == 0.0
    assert found.picture is not None and len(found.picture().axes) == 3


@pytest.mark.slow
def test_a_few_objects_are_placed_in_every_condition(tmp_path) -> None:
    pytest.importorskip("embreex")
    pytest.importorskip("igl")
    found = main(Options(tmp_path, quick=True, n=3))
    assert {row.condition for row in found.rows} == set(CONDITIONS)
