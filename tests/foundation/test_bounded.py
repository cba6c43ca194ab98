"""What comes from outside is refused before it is built, whatever size it claims."""

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from foundation.bounded import MOST_VALUES, check_arrays, check_size, parse_json


def npz(path: Path, shape: tuple[int, ...], held: int, dtype: str = "|u1") -> Path:
    """An archive whose array says it has a shape, and has so many bytes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", header.getvalue() + bytes(held))
        archive.writestr("readme.txt", "not an array")
    return path


def test_an_array_must_be_as_large_as_it_says(tmp_path: Path) -> None:
    check_arrays(npz(tmp_path / "good.npz", (3, 4), 12))
    check_arrays(npz(tmp_path / "floats.npz", (3, 4), 96, "<f8"))
    for shape, held in (((10**12,), 0), ((3, 4), 11), ((3, 4), 13), ((10**6, 10**6, 10**6), 8)):
        with pytest.raises(ValueError, match=r"a\.npy says"):
            check_arrays(npz(tmp_path / "bad.npz", shape, held))


def test_an_archive_that_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unpacks to 0 MB"):
        check_arrays(npz(tmp_path / "bomb.npz", (1001,), 1001), most=1000)
    check_arrays(npz(tmp_path / "bomb.npz", (1001,), 1001), ["b"], most=1000)  # only what is asked for


def test_nested_text_is_an_error_and_no_crash() -> None:
    assert parse_json(b'{"a": [1, 2.5]}') == {"a": [1, 2.5]}
    with pytest.raises(ValueError, match="too deep"):
        parse_json("[" * 100_000 + "]" * 100_000)
    with pytest.raises(ValueError, match="Expecting"):
        parse_json("{")


def test_aliases_count_as_often_as_they_are_used() -> None:
    check_size({"a": [1, 2, {"b": "text"}], "c": list(range(MOST_VALUES // 2))})
    laughs: object = "ha"
    for _ in range(9):
        laughs = [laughs] * 10
    tracemalloc.start()
    with pytest.raises(ValueError, match="aliases"):
        check_size({"it": laughs})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
