"""What comes from outside is refused before it is built, whatever size it claims."""

import io
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from foundation.bounded import LARGEST_YAML, MOST_VALUES, check_arrays, check_size, parse_json, parse_yaml, read_text


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


def test_arrays_that_unpack_to_too_much_together_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "many.npz", **{f"a{i}": np.zeros(900, np.uint8) for i in range(9)})
    check_arrays(tmp_path / "many.npz", most=8100)
    check_arrays(tmp_path / "many.npz", ["a1", "a2"], most=1800)
    with pytest.raises(ValueError, match="its arrays unpack to more than 0 MB"):
        check_arrays(tmp_path / "many.npz", most=8099)


def test_a_long_text_is_no_json() -> None:
    with pytest.raises(ValueError, match="more than 16384 kB"):
        parse_json(b"[" + 9_000_000 * b"0," + b"0]")


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


MERGED = "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 12))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (f"a0: &a0 {{k: v}}\n{MERGED}", "merged"),
        ("[" * 90_000, "too deep"),
        ("a: 1\n" * LARGEST_YAML, "kB"),
        (f"a: &a {{{', '.join(f'k{i}: 0' for i in range(3000))}}}\nb: {{<<: [{', '.join(['*a'] * 6000)}]}}", "merged"),
        (
            f"a: &a {{{', '.join(f'k{i}: 0' for i in range(3000))}}}\n"
            + "\n".join(f"b{i}: {{<<: [{', '.join(['*a'] * 30)}]}}" for i in range(500)),
            "merged",
        ),
        ("!!timestamp x", "does not fit its tag"),
    ],
)
def test_yaml_that_cannot_be_read_soon_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why) as caught:
        parse_yaml(text)
    assert "\n" not in str(caught.value)


def test_merged_keys_are_read() -> None:
    assert parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}")["b"] == {"x": 1, "y": 2}


def test_no_more_is_read_than_may_be(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfabc")
    assert read_text(tmp_path / "a") == "abc"
    for endless in (tmp_path / "a", Path("/dev/zero")):
        with pytest.raises(ValueError, match="more than 0 kB"):
            read_text(endless, 2)
