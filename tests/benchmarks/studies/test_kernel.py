"""The kernel's measurement counts the work as it is, and its rows are what it timed."""

from pathlib import Path

import pytest

from benchmarks.studies import kernel
from probnerf.kernel import library
from probnerf.prior.networks import PRESETS


def test_the_networks_sizes_are_their_weights_without_biases() -> None:
    field = PRESETS["paper"].field
    biases = sum(shape[0] for shape in field.shapes if len(shape) == 1)
    direction = 3 * (1 + 2 * field.direction_octaves) * field.width  # once a ray, not once a point
    assert kernel._density_size(field) + kernel._colour_size(field) == field.size - biases - direction


@pytest.mark.nightly
def test_rows_and_a_picture_come_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel, "SIDE", 64)
    if not library.available():
        with pytest.raises(ValueError, match="install a C\\+\\+ compiler"):
            kernel.main(kernel.Options(tmp_path))
        return
    summary = kernel.main(kernel.Options(tmp_path, quick=True, repeats=1))
    rows = {(row.method, row.metric): row for row in summary.rows}
    assert rows["work", "points"].value > rows["work", "coloured_points"].value > 0
    operations, peak = rows["work", "operations"], rows["matrix product", "speed"]
    share = operations.value / (1e-3 * rows["kernel", "time"].value) / peak.value
    assert rows["kernel", "share_of_peak"].value == pytest.approx(share)
    assert rows["kernel with hypernetwork", "ratio"].value > 0
    assert summary.picture().axes
    with pytest.raises(ValueError, match="repeats is 0; give 1 or more"):
        kernel.main(kernel.Options(tmp_path, repeats=0))
