"""Strangers: what a file of rows is summed up to, and one object's way from mesh to rows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.harness.intervals import Figures
from benchmarks.harness.results import Results
from benchmarks.measures.point_scores import point_scores
from benchmarks.scenes.strangers import BULLET, GSO
from benchmarks.studies.strangers import (
    ALONE,
    BEFORE,
    FIRST,
    METHODS,
    QUERIED,
    RIVAL,
    Options,
    main,
    summary,
)
from probnerf.prior.checkpoint import load_prior

OCCUPIED = np.array([True, True, False, False])
P = {ALONE: [0.9, 0.8, 0.01, 0.2], QUERIED: [0.9, 0.9, 0.4, 0.4], RIVAL: [0.6, 0.6, 0.4, 0.4], FIRST: [0.5] * 4}


def line(method: str, name: str, p: list[float], prior: str = "p") -> dict:
    told = {"points": 4, "occupied": 2, **point_scores(np.array(p), OCCUPIED)}
    state = {"out_of_model": False, "outside": 0.1, "seconds": 1.0} if method != RIVAL else {}
    same = {"prior": prior, "settings": {}, "seed": 0, "condition": GSO}
    return {"revision": "r", "machine": "m", **same, "method": method, "object": name, **told, **state}


def rows() -> list[dict]:
    lines = [line(method, name, P[method]) for name in ("a", "b", "c") for method in METHODS]
    refused = {
        k: v for k, v in line(ALONE, "thin", P[ALONE]).items() if k in ("prior", "condition", "method", "settings")
    }
    return [*lines, {**refused, "object": "thin", "seed": 0, "refused": "too thin"}]


def test_rows_are_summed_up_and_paired() -> None:
    found = summary(rows(), Options())
    of = Figures(found.rows)
    ours, half = -0.25 * np.log([0.9, 0.8, 0.99, 0.8]).sum(), np.log(2.0)
    assert of(GSO, ALONE, "balanced") == pytest.approx(ours)
    assert of(GSO, ALONE, "balanced_over_one_half") == pytest.approx(ours - half)
    assert of(GSO, ALONE, "balanced_over_hilbert_map") == pytest.approx(ours + np.log(0.6))
    assert of(GSO, ALONE, "better_than_hilbert_map") == 1.0 and of(GSO, ALONE, "free") == 0.25
    assert of(GSO, ALONE, "outside") == pytest.approx(0.1) and np.isnan(of(GSO, RIVAL, "outside"))
    assert (of(GSO, ALONE, "refused"), of.count(GSO, ALONE, "refused")) == (1.0, 4)
    assert of(GSO, FIRST, "balanced") == pytest.approx(half)
    assert len(found.tables[0].lines) == 4 and "1 of 4 refused" in found.tables[1].lines[-1][0]
    assert found.picture().axes and summary([], Options()) is None


def test_older_rows_are_compared_on_the_same_points_only(tmp_path: Path) -> None:
    kept = Results(tmp_path / "before.jsonl")
    for name in ("a", "b"):
        kept.add(line(ALONE, name, P[RIVAL], prior="older"))
    options = Options(before=kept.path)
    of = Figures(summary(rows(), options).rows)
    assert of(GSO, ALONE, f"balanced_over_{BEFORE}") == pytest.approx(of(GSO, ALONE, "balanced_over_hilbert_map"))
    assert of.count(GSO, ALONE, f"balanced_over_{BEFORE}") == 2
    kept.add({**line(ALONE, "c", P[RIVAL], prior="older"), "points": 5})
    with pytest.raises(ValueError, match="c: rows of before are of other points"):
        summary(rows(), options)


def test_an_object_that_hides_nothing_is_left_out_by_all_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "meshes" / "bullet3").mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "meshes" / "bullet3" / "mug.obj")
    nothing = np.zeros((0, 3)), np.zeros(0, bool)
    monkeypatch.setattr("benchmarks.studies.strangers.hidden_points", lambda *_: nothing)
    options = Options(tmp_path, set="bullet", data=tmp_path, results=tmp_path / "rows.jsonl")
    with pytest.raises(ValueError, match="no results"):
        main(options)
    kept = Results(options.results).lines
    assert {each["method"]: each["refused"] for each in kept} == dict.fromkeys(METHODS, "no point about it is hidden")


@pytest.mark.slow
def test_an_object_goes_from_mesh_to_rows_once(tmp_path: Path) -> None:
    folder = tmp_path / "meshes" / "bullet3"
    folder.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.12, 0.005)).export(folder / "mug.obj")  # perception refuses what is so flat
    options = Options(tmp_path, set="bullet", stages=1, data=tmp_path, results=tmp_path / "rows.jsonl")
    with pytest.raises(ValueError, match="no results"):
        main(options)
    kept = {each["method"]: each for each in Results(options.results).lines}
    assert set(kept) == set(METHODS) and kept[ALONE]["condition"] == BULLET
    assert "2 cm high" in kept[ALONE]["refused"] and 0.0 < kept[RIVAL]["balanced"] < 2.0
    assert kept[ALONE]["prior"] == load_prior().identity
    size = options.results.stat().st_size
    with pytest.raises(ValueError, match="no results"):
        main(replace(options, n=1))
    assert options.results.stat().st_size == size


@pytest.mark.slow
def test_a_scan_is_answered_with_and_without_caution(shared_data: Path, tmp_path: Path) -> None:
    found = main(Options(tmp_path, n=2, stages=10, results=tmp_path / "rows.jsonl", data=shared_data))
    of = Figures(found.rows)
    assert of.methods(GSO) == list(METHODS) and of.count(GSO, ALONE, "balanced") == 2
    assert all(0.0 < of(GSO, method, "balanced") < 2.0 for method in METHODS)
