"""`farside bench`: a measurement is a module with a `main`, its keywords are options, its rows a table and JSON."""

import json
import sys
from pathlib import Path

import pytest

import node.commands.bench
from benchmarks.rows import Row, write_rows
from node.__main__ import main

TOY = '''
"""A toy: how large is a number.

More about it.
"""
from pathlib import Path
from benchmarks.rows import Row

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
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of measurements of its own."""
    folder = tmp_path / "measurements"
    folder.mkdir()
    (folder / "rows.py").touch()
    (folder / "toy.py").write_text(TOY)
    monkeypatch.setattr(node.commands.bench, "FOLDER", folder)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "measurements.toy", raising=False)
    monkeypatch.delitem(sys.modules, "measurements", raising=False)
    return folder


def test_a_measurement_runs(checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, rows = tmp_path / "new" / "bench", tmp_path / "rows" / "toy.json"
    assert main(["bench", "toy", "--scale", "2", "--quick", "--out", str(out), "--json", str(rows)]) == 0
    said = capsys.readouterr().out
    assert "by hand" in said and " 6 " in said and str(rows) in said and str(out / "toy.png") in said
    assert json.loads(rows.read_text()) == [
        {"name": "toy", "method": "by hand", "condition": "quick", "metric": "size", "value": 6.0, "unit": "m", "n": 7}
    ]
    assert list(rows.parent.iterdir()) == [rows]


def test_help_lists_measurements_and_their_options(checkout: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "--help"])
    text = capsys.readouterr().out
    assert "toy" in text and "A toy: how large is a number." in text and "rows" not in text
    with pytest.raises(SystemExit):
        main(["bench", "toy", "--help"])
    text = capsys.readouterr().out
    assert "what it is multiplied by (default: 1.0)" in text and "Measures a number." in text
    assert "--quick" in text and "--json FILE" in text and "--out DIR" in text


def test_what_is_wrong_is_said(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["bench", "toy", "--scale", "-1", *out]) == 1
    assert capsys.readouterr().err == "farside: error: scale is -1.0; give a positive number\n"
    assert main(["bench", "toy", "--json", str(tmp_path), *out]) == 1
    assert "is a folder; give a file for --json" in capsys.readouterr().err
    monkeypatch.setattr(node.commands.bench, "FOLDER", tmp_path / "elsewhere")
    assert main(["bench", "toy"]) == 1
    assert "measurements run from a checkout" in capsys.readouterr().err


def test_the_checkouts_own_measurements_fit() -> None:
    """Each has a one-line help, and none is hidden by another module's name."""
    assert all(text.strip() and "\n" not in text for text in node.commands.bench.names().values())
    assert "rows" not in node.commands.bench.names()


def test_rows_that_fail_leave_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        write_rows(tmp_path / "a.json", [Row("a", "b", "c", "d", object(), "", 1)])
    assert not list(tmp_path.iterdir())
