"""The measurement of recording: few frames of every encoding, and sizes in the order that they must have."""

from pathlib import Path

from benchmarks.studies.record import Options, main


def test_every_encoding_is_measured(tmp_path: Path) -> None:
    summary = main(Options(tmp_path, quick=True, frames=5))
    rows = summary.rows
    value = {(row.method, row.metric): row.value for row in rows}
    size = {method: v for (method, metric), v in value.items() if metric == "bytes_per_frame"}
    assert len(size) == 9 and {row.n for row in rows} == {5} and all(v > 0 for v in value.values())
    assert size["raw, none"] > 640 * 480 * (3 + 2) > size["raw, lz4"] > size["raw, zstd"] > size["png, zstd"]
    assert size["png, zstd"] > size["jpeg, zstd"] and size["jpeg, none"] > 640 * 480 * 2
    assert not list(tmp_path.iterdir()) and summary.picture().axes
