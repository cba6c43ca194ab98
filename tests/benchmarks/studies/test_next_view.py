"""Who chooses the second picture, and what it is judged by."""

import numpy as np
import pytest

from benchmarks.studies.next_view import CHOICES, FARTHEST, NONE, RANDOM, SUGGESTED, Options, places, summary
from perception.answers.next_view import rank_views, ring_of_views
from tests.perception.answers.test_next_view import HIDDEN


def test_the_suggested_place_gains_most_and_the_farthest_is_opposite() -> None:
    found = places(HIDDEN, np.random.default_rng(0))
    assert set(found) == {SUGGESTED, RANDOM, FARTHEST}
    ring = ring_of_views(HIDDEN)
    best = rank_views([HIDDEN], ring, count=1)
    assert found[SUGGESTED][1] == pytest.approx(best.gain_nats[0]) and found[SUGGESTED][1] >= found[RANDOM][1]
    present = np.linalg.inv(HIDDEN.object_frame.T_camera_object)[:3, 3]
    cosines = ring[:, :3, 3] @ present
    assert found[FARTHEST][0][:3, 3] @ present == pytest.approx(cosines.min()) and cosines.min() < 0
    assert any(np.allclose(found[RANDOM][0], T) for T in ring)


def test_only_objects_with_every_answer_count() -> None:
    def line(who: str, number: int, value: float) -> dict:
        return {"method": who, "object": number, "hidden_nll": value, "change": "view"}

    lines = [line(who, number, 0.1 * number + k) for k, who in enumerate(CHOICES) for number in (2, 1)]
    rows = summary([*lines, line(NONE, 3, 9.0)], Options()).rows
    value = {(r.method, r.metric): r.value for r in rows}
    assert [value[who, "hidden_nll"] for who in CHOICES] == pytest.approx([0.15 + k for k in range(len(CHOICES))])
    assert {r.n for r in rows} == {2} and summary(lines[:2], Options()) is None
    assert value[RANDOM, "hidden_nll_above_suggested"] == pytest.approx(1.0)
    assert value[SUGGESTED, "hidden_nll_above_suggested"] == 0.0
