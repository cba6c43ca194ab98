"""Whether a shape has a handle is read off the shape; what was said of it is scored, and never made twice."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from benchmarks.measures.scores import Answer
from benchmarks.studies import handle
from benchmarks.studies.handle import FROM_PRIOR, OWN, PRIOR, REACH, Options, has_handle, log_score, main, reach
from perception.simulation.simulated_camera import PlacedObject
from probnerf.objects.tabletop import TEST_SEEDS, TRAIN_SEEDS, signed_distance
from probnerf.objects.tabletop_sampler import MUG, PITCHER
from probnerf.prior.checkpoint import load_prior
from probnerf.rendering.occupancy import voxel_centres
from tests.priors import TABLETOP


def test_of_the_family_s_shapes_those_with_a_handle_are_told_from_those_without() -> None:
    points = voxel_centres(32).reshape(-1, 3).astype(np.float32)
    found: dict[bool, list[float]] = {False: [], True: []}
    for seed in TRAIN_SEEDS[:50]:
        shape = PlacedObject(seed, 0.0, 0.0, 0.0).shape
        solid = np.asarray(signed_distance(shape, points)).reshape(1, 32, 32, 32) <= 0
        found[bool(shape.has_handle)].append(reach(solid)[0])
    assert len(found[True]) > 10 and min(found[True]) > REACH + 1.0
    assert len(found[False]) > 10 and max(found[False]) < REACH - 1.0


def test_a_can_with_a_block_beside_it_has_one_only_at_plus_x() -> None:
    ticks = np.arange(32) + 0.5 - 16
    x, y, z = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    can = (np.hypot(x, y) < 8) & (abs(z) < 10)
    block = (abs(x - 10) < 3) & (abs(y) < 2) & (abs(z) < 4)
    assert reach(np.stack([can, can | block, can | block[::-1], np.zeros_like(can)])).tolist() == [0.0, 5.0, 0.0, 0.0]


def test_the_prior_s_shapes_have_handles_as_often_as_the_family() -> None:
    """And seldom something between: the threshold decides next to nothing."""
    model = load_prior(TABLETOP).model
    drawn = jax.random.normal(jax.random.key(1), (300, model.latent))
    share = np.mean([bool(PlacedObject(seed, 0.0, 0.0, 0.0).shape.has_handle) for seed in TRAIN_SEEDS[:300]])
    assert has_handle(model, drawn).mean() == pytest.approx(share, abs=0.08)


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
    monkeypatch.setattr(handle, "has_handle", lambda _, positions: np.array([True, False]))
    monkeypatch.setattr(handle, "score", lambda *_: SimpleNamespace(values={"hidden_nll": 0.2}))
    kept = tmp_path / "kept.jsonl"
    settings = {"n": 3, "slow": 2, "methods": f"{OWN};{FROM_PRIOR.name}", "results": kept}
    summary = main(Options(tmp_path, **settings))
    rows = summary.rows
    assert asked == [(OWN, s) for s in seeds] + [(FROM_PRIOR.name, s) for s in seeds[:2]]
    value = {(r.method, r.metric): (r.value, r.n) for r in rows}
    truth = np.mean([bool(PlacedObject(s, 0.0, 0.0, 0.0).shape.has_handle) for s in seeds])
    assert value[OWN, "p"] == (0.75, 3) and value[OWN, "share"] == (pytest.approx(truth), 3)
    assert value[FROM_PRIOR.name, "log_score_above_controller"] == (0.0, 2) and value[PRIOR, "p"][0] == 0.5
    assert value[OWN, "p where p is 0.6 to 1"] == (0.75, 3) and (OWN, "p where p is 0 to 0.05") not in value
    assert value[PRIOR, "log_score_above_controller"][1] == 3 and summary.picture().axes
    assert main(Options(tmp_path, **settings)).rows == rows and len(asked) == 5
    assert main(Options(tmp_path, **settings, only_chart=True)).rows == rows
    with pytest.raises(ValueError, match=r"no method \['magic'\]; there are: controller"):
        main(Options(tmp_path, methods="magic"))
    with pytest.raises(ValueError, match="omit --only-chart"):
        main(Options(tmp_path, results=tmp_path / "none.jsonl", only_chart=True))
