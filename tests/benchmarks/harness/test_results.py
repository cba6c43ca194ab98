"""A study's file: a run that was cut goes on where it ended, and every row says where it is from."""

from pathlib import Path

import pytest

from benchmarks.harness import results as module
from benchmarks.harness.results import Results, digest, key, newest, read_lines

LINE = {"prior": "p", "method": "m", "settings": {"a": 1, "b": 2}, "condition": "c", "object": 3, "seed": 0}


@pytest.fixture(autouse=True)
def known_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "revision", lambda: "abc1234")
    monkeypatch.setattr(module, "machine", lambda: "a computer")


def test_a_row_comes_back_with_the_revision_and_the_machine(tmp_path: Path) -> None:
    results = Results(tmp_path / "new" / "results.jsonl")
    added = results.add({**LINE, "value": 0.5, "each": (1, 2)})
    assert added == read_lines(results.path)[0] == results.lines[0]
    assert added == {**LINE, "value": 0.5, "each": [1, 2], "revision": "abc1234", "machine": "a computer"}
    assert LINE in results and {**LINE, "object": 4} not in results and LINE in Results(results.path)


def test_what_rows_have_in_common_is_stored_once(tmp_path: Path) -> None:
    results = Results(tmp_path / "results.jsonl")
    for number in range(3):
        results.add({**LINE, "object": number})
    Results(results.path).add({**LINE, "object": 4})
    assert results.path.read_text().count('"settings"') == 1
    results.add({**LINE, "object": 5, "another": "column"})
    assert results.path.read_text().count('"settings"') == 2 and len(read_lines(results.path)) == 5


def test_a_last_line_that_was_cut_is_dropped_and_another_one_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    assert read_lines(file) == []
    Results(file).add(LINE)
    Results(file).add({**LINE, "object": 4})
    whole = file.read_bytes()
    for cut in (1, 5, len(whole.splitlines()[-1])):
        file.write_bytes(whole[:-cut])
        assert [line["object"] for line in read_lines(file)] == [3]
        Results(file).add({**LINE, "object": 4})
        assert file.read_bytes() == whole
    for damage in (b"{\n" + whole, whole[: whole.index(b"\n") + 1][::-1] + whole):
        file.write_bytes(damage)
        with pytest.raises(ValueError, match="is damaged"):
            read_lines(file)


def test_an_answer_that_was_cut_is_not_kept(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    results = Results(tmp_path / "results.jsonl")
    with pytest.raises(KeyboardInterrupt):
        results.add({**LINE, "result": "interrupted"})
    assert not list(tmp_path.iterdir()) and not results.lines
    results.fill(lambda: results.add({**LINE, "result": "interrupted"}))
    assert "keeps what is done" in capsys.readouterr().err


def test_the_order_of_settings_makes_no_other_result() -> None:
    assert key(LINE) == key({**LINE, "settings": {"b": 2, "a": 1}})
    assert key(LINE) != key({**LINE, "settings": {"b": 2, "a": 2}})
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1}) != digest({"b": 2, "a": 1}, quick=True)


def test_the_newest_rows_are_those_of_the_last_settings_of_each_method() -> None:
    lines = [
        {**LINE, "value": 1},
        {**LINE, "value": 2},  # made twice: the last one counts
        {**LINE, "method": "n", "settings": {"old": 1}},
        {**LINE, "method": "n", "settings": {"new": 1}},
        {**LINE, "prior": "another"},
        {**LINE, "seed": 1},
    ]
    chosen = newest(lines, "p", 0)
    assert [line.get("value") for line in chosen] == [2, None] and chosen[1]["settings"] == {"new": 1}
    assert {line["seed"] for line in newest(lines, "p")} == {0, 1}
