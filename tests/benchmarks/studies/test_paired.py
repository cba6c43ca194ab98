"""Two revisions' rows are paired object by object, of one prior each."""

import json
import subprocess
from pathlib import Path

import pytest

from benchmarks.harness.results import FOLDER, Line, Results
from benchmarks.studies import paired


def line(number: int, seed: int = 0, prior: str = "new+network", **values: object) -> Line:
    own = {"prior": prior, "method": "m", "settings": {}, "condition": "any", "object": number, "seed": seed}
    return {**own, **values}


def write(path: Path, lines: list[Line]) -> Path:
    results = Results(path)
    for each in lines:
        results.add(each)
    return path


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Rows of today of three objects, two seeds of the first; the file of before lacks the last object."""
    today = [line(0, score=1.0, flagged=True), line(0, 1, score=2.0, flagged=True), line(1, score=4.0, flagged=False)]
    old = [line(0, prior="old", score=0.5, flagged=False), line(0, 1, "old", score=1.5, flagged=False)]
    write(tmp_path / "s.jsonl", [line(0, prior="other", score=99.0), *today, line(2, score=50.0, flagged=True)])
    monkeypatch.setattr(paired, "FOLDER", tmp_path)
    return write(tmp_path / "before.jsonl", [*old, line(1, prior="old", score=3.0, flagged=False)])


def test_seeds_count_as_one_and_only_what_both_have_is_compared(files: Path) -> None:
    summary = paired.main(paired.Options(study="s", before=str(files)))
    value = {row.metric: (row.value, row.n) for row in summary.rows}
    assert value["score, before"] == (2.0, 2) and value["score, after"] == (2.75, 2)  # 1 and 3; 1.5 and 4
    assert value["score, difference"] == (0.75, 2)
    assert value["flagged, difference"] == (0.5, 2)
    (table,) = summary.tables
    assert next(cells[2:6] for cells in table.lines) == ["score", "2", "2.000", "2.750"]


def test_columns_and_priors_are_chosen(files: Path, tmp_path: Path) -> None:
    options = paired.Options(study="s", before=str(tmp_path / "s.jsonl"), columns="score", prior_before="other")
    rows = paired.main(options).rows
    assert {row.metric.partition(",")[0] for row in rows} == {"score"} and rows[0].value == 99.0


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"study": "nothing"}, "rows are kept of before, s"),
        ({"before": "no-such-revision"}, "no file, and as a revision"),
        ({"columns": "colour"}, "no row of .* has a partner"),
    ],
)
def test_what_is_wrong_is_named(files: Path, given: dict[str, str], why: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=why):
        paired.main(paired.Options(**{"study": "s", "before": str(files), **given}))


def test_the_project_s_own_rows_are_found_by_revision() -> None:
    there = subprocess.run(["git", "rev-parse", "HEAD"], cwd=FOLDER, capture_output=True, check=False)
    if there.returncode:
        pytest.skip("this copy has no history")
    rows = paired.main(paired.Options(study="handle", before="HEAD")).rows
    gaps = [row for row in rows if row.metric.endswith("difference")]
    assert gaps and json.dumps([row.value for row in gaps]) == json.dumps([0.0] * len(gaps))
