"""The study of crowded scenes: its points are what they are called, and its gap is paired."""

import numpy as np
import pytest

from benchmarks.scenes.crowded import crowd, hidden_points
from benchmarks.studies.scene import Options, summary


def test_points_of_a_crowd_are_hidden_and_its_solids_do_not_meet() -> None:
    made = crowd(3, count=3)
    again = crowd(3, count=3)
    np.testing.assert_array_equal(made.frame.depth, again.frame.depth)
    assert made.frame.label is not None
    shown = np.unique(made.frame.label)[1:]
    assert len(shown) >= 2
    points, occupied = zip(*(hidden_points(made, int(i)) for i in shown), strict=True)
    camera = made.frame.camera
    for p, solid in zip(points, occupied, strict=True):
        u, v = np.round(camera.project(p)).astype(int).T
        assert (p[:, 2] >= made.depth[v, u] + 0.005).all()
        assert 0.02 < solid.mean() < 0.95
    heights = [(p @ made.T_world_camera[2, :3] + made.T_world_camera[2, 3]).min() for p in points]
    assert min(heights) > -1e-6
    middle = [p[solid].mean(axis=0) for p, solid in zip(points, occupied, strict=True)]
    assert np.linalg.norm(middle[0] - middle[1]) > 0.04


def test_the_gap_is_of_the_same_scenes() -> None:
    options = Options(budget=20.0)
    line = {"seconds": 20.0, "objects": 10, "without_run": 0, "refused": 0}
    lines = [
        {**line, "method": method, "object": scene, "first": first, "log_score": score}
        for method, scene, first, score in (
            ("rounds, 20 s", 0, 2.0, 0.20), ("rounds, 20 s", 1, 2.5, 0.50), ("rounds, 20 s", 2, 2.2, 0.90),
            ("rounds, 80 s", 0, 2.0, 0.19), ("rounds, 80 s", 1, 2.5, 0.48),
        )
    ]  # fmt: skip
    found = summary(lines, options)
    assert found is not None
    values = {(row.method, row.metric): row.value for row in found.rows}
    assert values["rounds, 20 s", "gap"] == pytest.approx(0.015)
    assert values["rounds, 20 s", "first"] == 2.5 and ("rounds, 80 s", "gap") not in values
    assert "FAIL" in found.tables[0].lines[0][2] and "pass" in found.tables[0].lines[0][3]
    assert summary([], options) is None
