"""`python -m benchmarks`: a study's keywords are its options, its rows a table and JSON."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as command
from benchmarks.harness.rows import Row, write_rows

TOY = '''
"""A toy: how large is a number.

More about it.
"""
from pathlib import Path
from benchmarks.harness.rows import Row

def main(out: Path, quick: bool = False, scale: float = 1.0, shape: Path | None = None) -> list[Row]:
    """Measures a number.

    Args:
        scale: what it is multiplied by
    """
    if scale < 0:
        raise ValueError(f"scale is {scale}; give a positive number")
    (out / "toy.png").write_bytes(b"")
    return [Row("toy", "by hand", "quick" if quick else "full", "size", 3.0 * scale, "m", 7)]
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


def test_a_study_runs(toy: None, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, rows = tmp_path / "new" / "bench", tmp_path / "rows" / "toy.json"
    assert command.main(["toy", "--scale", "2", "--quick", "--out", str(out), "--json", str(rows)]) == 0
    said = capsys.readouterr().out
    assert "by hand" in said and " 6 " in said and str(rows) in said and str(out / "toy.png") in said
    assert json.loads(rows.read_text()) == [
        {"name": "toy", "method": "by hand", "condition": "quick", "metric": "size", "value": 6.0, "unit": "m", "n": 7}
    ]
    assert list(rows.parent.iterdir()) == [rows]


def test_help_lists_studies_and_their_options(toy: None, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        command.main(["--help"])
    text = capsys.readouterr().out
    assert "toy" in text and "A toy: how large is a number." in text and "no_study" not in text
    with pytest.raises(SystemExit):
        command.main(["toy", "--help"])
    text = capsys.readouterr().out
    assert "what it is multiplied by (default: 1.0)" in text and "Measures a number." in text
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
