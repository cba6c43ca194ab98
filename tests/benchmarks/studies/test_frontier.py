"""The frontier: a run that was cut goes on where it ended, and methods are compared on the same vessels."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.rivals.methods import CONDITIONS, FULL, METHODS
from benchmarks.scenes.vessels import base_rate
from benchmarks.studies import frontier
from benchmarks.studies.frontier_chart import draw_frontier


def _found(nll: float) -> dict:
    metrics = dict.fromkeys(("psnr_heldout", "psnr_heldout_of_mean", "psnr_given", "psnr_given_of_mean"), 20.0)
    costs = {"seconds": 2.0, "gflops": 50.0, "point_gradients": 1e6, "point_evaluations": 0.0}
    boxes = {"ranks": [0.2, 0.99], "p_free": [0.99, 0.1], "occupied": [0, 1]}
    return {"hidden_nll": nll, **metrics, **costs, **boxes, "result": "stages"}


def test_a_run_goes_on_where_it_was_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One vessel of two has no informative view and perception refuses another's colour; Ctrl-C comes in between."""
    made: list[tuple] = []

    def picture(seed, handle):
        return None if (seed, handle) == (11, "informative") else seed

    def view(seed, depth):
        if seed == 10 and not depth:
            raise ValueError("its foot is hidden")
        return seed

    def one(method, question, *_):
        if len(made) == 7:
            made.append(())
            raise KeyboardInterrupt
        made.append((question.view, method.name))
        return _found(0.3 if method.name == FULL else 0.4 + 0.01 * question.view)

    monkeypatch.setattr(frontier, "TEST_SEEDS", range(10, 99))
    monkeypatch.setattr(frontier, "vessel_picture", picture)
    monkeypatch.setattr(frontier, "vessel_view", view)
    monkeypatch.setattr(frontier, "_one", one)
    monkeypatch.setattr(frontier, "base_rate", lambda **_: None)
    out, file = tmp_path / "out", tmp_path / "results.jsonl"

    def run(**options):
        asked = frontier.Options(out, n=2, methods="map;paper 100x100;fixed*", results=file, **options)
        return frontier.main(asked).rows

    run()
    assert len(made) == 8 and made[-1] == ()  # cut
    file.write_bytes(file.read_bytes()[:-9])
    rows = run()
    assert made.count((10, "map")) == 2 and made.count((12, "map")) == 4 and made.count((12, FULL)) == 5
    assert len(made) == 8 + 8  # what was cut off the file, and what was left
    assert repr(run(only_chart=True)) == repr(run()) == repr(rows) and len(made) == 16
    value = {(r.condition, r.method, r.metric): r for r in rows}
    gap = value["hidden, RGB-D", "map", "hidden_nll_above_paper"]
    assert gap.value == pytest.approx(0.21) and gap.n == 2
    assert value["hidden, colour only", "map", "hidden_nll"].n == 1  # the other one was refused
    assert {r.condition for r in rows if r.method == "fixed 20x100"} == {CONDITIONS[0]}
    assert value["hidden, RGB-D", "map", "coverage90"].value == 0.5
    assert value["hidden, RGB-D", "map", "work"].value == pytest.approx(0.1)
    overall = {r.metric: r for r in rows if (r.condition, r.method) == (frontier.OVER_ALL, "map")}
    assert overall["hidden_nll_above_paper"].value == pytest.approx(0.22)  # of the vessel that all answered
    assert overall["hidden_nll"].n == 1 and overall["fewer_point_gradients"].value == overall["less_work"].value == 1.0
    assert not any(r.condition == frontier.OVER_ALL and r.method == "fixed 20x100" for r in rows)
    assert len(draw_frontier([row for row in rows if row.condition == CONDITIONS[0]]).axes) == 4
    with pytest.raises(ValueError, match="no method 'nothing'"):
        frontier.main(frontier.Options(out, methods="nothing", results=file))


def test_every_method_is_another_one():
    assert len({m.name for m in METHODS}) == len(METHODS)
    assert all(set(m.conditions) <= set(CONDITIONS) for m in METHODS)


@pytest.mark.slow
def test_two_methods_answer_one_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = replace(frontier.ControllerConfig(), hypotheses=4)
    monkeypatch.setattr(frontier, "ControllerConfig", lambda: config)
    monkeypatch.setattr(frontier, "base_rate", lambda **_: base_rate(24))
    rows = frontier.main(frontier.Options(tmp_path, quick=True, methods="encoder;paper 10x10")).rows
    value = {(r.method, r.metric): r.value for r in rows}
    for method in ("encoder alone", "paper 10x10"):
        assert 0.0 < value[method, "hidden_nll"] < 3.0 and 5.0 < value[method, "psnr_heldout"] < 40.0
        assert value[method, "psnr_heldout_of_mean"] >= value[method, "psnr_heldout"]  # the mean square is convex
        assert value[method, "seconds"] > 0.0
    assert value["encoder alone", "point_gradients"] == 0.0 < value["paper 10x10", "point_gradients"]
