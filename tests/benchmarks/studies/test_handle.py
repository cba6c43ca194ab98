"""Whether a shape has a handle is read off the shape; what was said of it is scored, and never made twice."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.measures.scores import Answer
from benchmarks.scenes.conditions import unseen_handle
from benchmarks.studies import handle
from benchmarks.studies.handle import (
    BASE,
    FROM_PRIOR,
    OWN,
    REACH,
    Options,
    base_share,
    has_handle,
    log_score,
    main,
    reach,
)
from perception.simulation.simulated_camera import PlacedObject
from probnerf.objects.tabletop import TEST_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, part_distances
from probnerf.objects.tabletop_sampler import MUG, PITCHER
from probnerf.rendering.occupancy import voxel_centres


def test_of_the_family_s_shapes_those_with_a_handle_are_told_from_those_without() -> None:
    points = voxel_centres(32).reshape(-1, 3).astype(np.float32)
    parts = jax.jit(part_distances)
    found: dict[bool, list[float]] = {False: [], True: []}
    for seed in TRAIN_SEEDS[:50]:
        shape = PlacedObject(seed, 0.0, 0.0, 0.0).shape
        body, handle = (np.asarray(d).reshape(32, 32, 32) <= 0 for d in parts(shape, points))
        found[bool(shape.has_handle)].append(reach((body | handle)[None], body, np.zeros_like(body))[0])
    assert len(found[True]) > 10 and min(found[True]) > REACH
    assert len(found[False]) > 10 and max(found[False]) == 0.0


def test_a_block_beside_a_can_counts_by_its_reach_where_nobody_saw() -> None:
    ticks = np.arange(32) + 0.5 - 16
    x, y, z = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    can = (np.hypot(x, y) < 8) & (abs(z) < 10)
    block = (abs(x - 10) < 3) & (abs(y) < 2) & (abs(z) < 4)
    shapes = np.stack([can, can | block, can | block[::-1], np.zeros_like(can)])
    assert reach(shapes, can, np.zeros_like(can)).tolist() == [0.0, 5.0, 5.0, 0.0]
    assert reach(shapes, can, x > 0).tolist() == [0.0, 0.0, 5.0, 0.0]
    view = SimpleNamespace(body=can, seen=x > 0)
    assert has_handle(view, shapes).tolist() == [False, False, True, False]


def test_the_base_rate_is_the_share_of_unseen_handles() -> None:
    kinds = [p.shape.has_handle for p in map(unseen_handle, VALIDATION_SEEDS[:40]) if p is not None]
    assert len(kinds) > 5 and base_share(40) == np.mean(kinds)


def test_what_is_said_is_scored() -> None:
    p, true = np.array([0.0, 1.0, 0.5, 0.0]), np.array([False, True, True, True])
    sure, wrong = -np.log(64.5 / 65), -np.log(0.5 / 65)
    np.testing.assert_allclose(log_score(p, true, 64), [sure, sure, np.log(2.0), wrong])


def test_answers_are_kept_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []
    seeds = [s for s in TEST_SEEDS[:200] if PlacedObject(s, 0.0, 0.0, 0.0).shape.kind in (MUG, PITCHER)][:3]

    def views(_: str, n: int, known: Any) -> Iterator[tuple[int, Any]]:
        for seed in seeds[:n]:
            view = SimpleNamespace(seed=seed, seen=np.zeros((32,) * 3, bool))
            yield seed, None if known(seed) else view

    def answer(method: Any, question: Any) -> tuple[Answer, Any, Any]:
        asked.append((method.name, question.view.seed))
        weights = np.array([0.75, 0.25])
        return Answer(np.zeros((2, 32, 32, 32), bool), weights, 1.0, "converged"), SimpleNamespace(point_gradients=9), 0

    monkeypatch.setattr(handle, "views", views)
    monkeypatch.setattr(handle, "answer", answer)
    monkeypatch.setattr(handle, "base_rate", lambda *_, **__: np.full((32,) * 3, 0.5))
    monkeypatch.setattr(handle, "has_handle", lambda *_: np.array([True, False]))
    monkeypatch.setattr(handle, "base_share", lambda _: 0.5)
    monkeypatch.setattr(handle, "score", lambda *_: SimpleNamespace(values={"hidden_nll": 0.2}))
    kept = tmp_path / "kept.jsonl"
    settings = {"n": 3, "slow": 2, "methods": f"{OWN};{FROM_PRIOR.name}", "results": kept}
    summary = main(Options(tmp_path, **settings))
    rows = summary.rows
    assert asked == [(OWN, s) for s in seeds] + [(FROM_PRIOR.name, s) for s in seeds[:2]]
    value = {(r.method, r.metric): (r.value, r.n) for r in rows}
    truth = np.mean([bool(PlacedObject(s, 0.0, 0.0, 0.0).shape.has_handle) for s in seeds])
    assert value[OWN, "p"] == (0.75, 3) and value[OWN, "share"] == (pytest.approx(truth), 3)
    assert value[FROM_PRIOR.name, "log_score_above_controller"] == (0.0, 2) and value[BASE, "p"][0] == 0.5
    assert value[OWN, "p where p is 0.6 to 1"] == (0.75, 3) and (OWN, "p where p is 0 to 0.05") not in value
    assert value[BASE, "log_score_above_controller"][1] == 3 and summary.picture().axes
    assert main(Options(tmp_path, **settings)).rows == rows and len(asked) == 5
    assert main(Options(tmp_path, **settings, only_chart=True)).rows == rows
    with pytest.raises(ValueError, match=r"no method \['magic'\]; there are: controller"):
        main(Options(tmp_path, methods="magic"))
    with pytest.raises(ValueError, match="omit --only-chart"):
        main(Options(tmp_path, results=tmp_path / "none.jsonl", only_chart=True))
