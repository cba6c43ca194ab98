"""The measurement of a batch: rates, sizes and messages that are there, and what follows from them."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.studies import batch
from benchmarks.studies.batch import Options, computed, main
from node.commands.batch_options import BatchConfig
from perception.sources.settings import SHIPPED_LOG


def test_a_hundred_machines_are_computed() -> None:
    kept = {"unit_bytes": 1e5, "log_bytes": 0.0, "read_bytes": 2e6}
    table = computed(Options(units=1000), kept, {"messages": 10.0, "message_bytes": 1e6, "seconds": 0.06})
    found = {what: value for what, value in table.lines}
    assert found["files of results"] == "2,500" and found["bytes of results"] == "0.1 GB"
    assert found["logs to read, each once"] == "1 GB" and found["files written by a machine"] == "25"
    assert found["scheduler's messages (Dask)"] == "15,000" and found["scheduler's bytes (Dask)"] == "1.50 GB"
    assert found["scheduler's time, at most (Dask)"] == "2 min"  # of 1000 units and 500 logs


def test_the_plain_loop_infers_each_object_of_each_copy(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[int]()
    monkeypatch.setattr(batch, "estimate", lambda frame, found, *args, **how: seen.append(found.id))
    assert batch._plain_rate(2, BatchConfig(stages=1)) > 0
    assert len(seen) == 4 and seen[:2] == seen[2:]


def test_rates_stand_beside_the_first_and_the_plain_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"logs/a/seed_0/object_1.npz": 100, "logs/a/seed_0/object_1.json": 10, "logs/a/log.json": 5}
    monkeypatch.setattr(batch, "_plain_rate", lambda logs, config: 80.0)
    monkeypatch.setattr(batch, "_run", lambda *args, **how: SimpleNamespace(sizes=lambda: sizes))
    monkeypatch.setattr(batch, "_rate", lambda store, workers: 60.0 * workers)
    monkeypatch.setattr(batch, "_messages", lambda: nullcontext({"messages": 40, "bytes": 4000}))
    summary = main(Options(tmp_path, quick=True))
    rows = {(row.condition, row.metric): row.value for row in summary.rows}
    assert rows["2 workers", "ratio_to_first"] == 2.0 and rows["2 workers", "ratio_to_loop"] == 1.5
    assert rows["1 workers", "ratio_to_loop"] == 0.75 and rows["empty logs", "task_messages"] == 2.0
    assert summary.tables[0].lines[0] == ["plain loop", "4", "80", "1.33", "1.00"]


@pytest.mark.nightly
def test_a_batch_is_measured(tmp_path: Path) -> None:
    rows = {(row.condition, row.metric): row.value for row in main(Options(tmp_path, quick=True)).rows}
    loop, one, two = (rows[by, "units_per_hour"] for by in ("plain loop", "1 workers", "2 workers"))
    assert min(loop, one, two) > 0 and rows["2 workers", "ratio_to_first"] == two / one
    assert rows["2 workers", "ratio_to_loop"] == two / loop and rows["plain loop", "ratio_to_loop"] == 1.0
    assert rows["shipped recording", "read_bytes"] == SHIPPED_LOG.stat().st_size
    assert 1e4 < rows["shipped recording", "unit_bytes"] < 3e6
    assert 4 <= rows["empty logs", "task_messages"] < 100 and rows["empty logs", "task_message_bytes"] < 1e5
