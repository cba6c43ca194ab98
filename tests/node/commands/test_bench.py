"""`farside bench` finds the studies of a checkout, and says in one line where it has none."""

from pathlib import Path

import pytest

import node.commands.bench
from node.__main__ import main


def test_a_checkout_lists_its_studies(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as end:
        main(["bench", "--help"])
    assert end.value.code == 0 and "calibration" in capsys.readouterr().out


def test_an_installed_package_says_that_it_needs_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(node.commands.bench, "CHECKOUT", tmp_path)
    assert main(["bench", "calibration"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "runs from a checkout of the repository" in said
