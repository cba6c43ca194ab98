"""`python -m benchmarks`: a study's keywords are its options, its rows a table and JSON."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.harness import study
from benchmarks.harness.rows import Row, write_rows

TOY = '''
"""A toy: how large is a number.

More about it.
"""
from dataclasses import dataclass
from matplotlib.figure import Figure
from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions

@dataclass(frozen=True)
class Options(TableOptions):
    """Measures a number."""

    scale: float = 1.0
    """Factor of the number."""

def main(options: Options) -> Summary:
    if options.scale < 0:
        raise ValueError(f"scale is {options.scale}; give a positive number")
    row = Row("toy", "by hand", "quick" if options.quick else "full", "size", 3.0 * options.scale, "m", 7)
    return Summary([row], picture=Figure)
'''


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder of studies of its own, beside the module that it is imported from."""
    import benchmarks.studies as package

    folder = tmp_path / "studies"
    folder.mkdir()
    (folder / "no_study.py").touch()
    (folder / "toy.py").write_text(TOY)
    monkeypatch.setattr(command, "STUDIES", folder)
    monkeypatch.setattr(package, "__path__", [str(folder)])
    monkeypatch.delitem(sys.modules, "benchmarks.studies.toy", raising=False)


def test_a_study_runs(
    toy: None, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, rows = tmp_path / "new" / "bench", tmp_path / "rows" / "toy.json"
    monkeypatch.setattr(study, "FOLDER", tmp_path / "kept")
    options = ["--scale", "2", "--quick", "--keep", "--out", str(out), "--json", str(rows)]
    assert command.main(["toy", *options]) == 0
    said = capsys.readouterr().out
    assert "by hand" in said and " 6 " in said and str(rows) in said and str(out / "toy.png") in said
    assert json.loads(rows.read_text()) == [
        {"name": "toy", "method": "by hand", "condition": "quick", "metric": "size", "value": 6.0, "unit": "m", "n": 7}
    ]
    assert list(rows.parent.iterdir()) == [rows]
    kept = study.kept_tables("toy")
    assert kept is not None and "| by hand | quick | size | 6 | m | 7 |" in kept[2][0].markdown()


def test_help_lists_studies_and_their_options(toy: None, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        command.main(["--help"])
    text = capsys.readouterr().out
    assert "toy" in text and "A toy: how large is a number." in text and "no_study" not in text
    with pytest.raises(SystemExit):
        command.main(["toy", "--help"])
    text = capsys.readouterr().out
    assert "Factor of the number. (default: 1.0)" in text and "Measures a number." in text
    assert "--quick" in text and "--json FILE" in text and "--out DIR" in text


def test_wrong_options_are_refused(toy: None, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "out")]
    with pytest.raises(ValueError, match="give a positive number"):
        command.main(["toy", "--scale", "-1", *out])
    with pytest.raises(ValueError, match="is a folder; give a file for --json"):
        command.main(["toy", "--json", str(tmp_path), *out])


def test_each_study_has_a_help_of_one_line() -> None:
    assert all(text.strip() and "\n" not in text for text in command.studies().values())
    assert "frontier_chart" not in command.studies()


def test_rows_that_fail_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        write_rows(tmp_path / "a.json", [Row("a", "b", "c", "d", object(), "", 1)])
    assert not list(tmp_path.iterdir())
