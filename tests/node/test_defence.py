"""What no reader expected still ends in one line that names the input; files that lie about their size are refused."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

import node.__main__
from node.__main__ import main

BOX = ["--box", "0", "0", "0", "0.1", "0.1", "0.1"]


def one_line(capsys: pytest.CaptureFixture) -> str:
    error = capsys.readouterr().err
    assert error.startswith("farside: error: ") and error.count("\n") == 1 and error.endswith("\n")
    return error


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (MemoryError(), "not enough memory"),
        (RecursionError("maximum recursion\ndepth"), "RecursionError: maximum recursion depth"),
        (TypeError("x" * 10_000), "TypeError: xxx"),
        (AttributeError("no field"), "AttributeError: no field"),
    ],
)
def test_an_unexpected_error_is_one_line_that_names_the_input(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, error: Exception, says: str
) -> None:
    def fails(args: list[str]) -> int:
        raise error

    monkeypatch.setitem(node.__main__.COMMANDS, "query", fails)
    path = tmp_path / "a.npz"
    path.write_bytes(b"")
    assert main(["query", str(path), *BOX]) == 1
    line = one_line(capsys)
    assert says in line and f"query {path}" in line and "--debug" in line and len(line) < 1000
    with pytest.raises(type(error)):
        main(["--debug", "query", str(path), *BOX])


def hypotheses_that_say(path: Path, header: bytes, size: int) -> Path:
    """A hypotheses file of this header, whose opacity says it has so many voxels and has none."""
    array = io.BytesIO()
    np.lib.format.write_array_header_1_0(array, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
    with zipfile.ZipFile(path, "w") as archive:
        text = io.BytesIO()
        np.save(text, np.frombuffer(header, np.uint8))
        archive.writestr("header.npy", text.getvalue())
        archive.writestr("opacity.npy", array.getvalue())
    return path


@pytest.mark.parametrize(
    ("header", "size", "says"),
    [
        (b"{}", 10**12, "opacity.npy says it has 1000000000000 bytes"),
        (b"[" * 50_000 + b"]" * 50_000, 0, "is not a hypotheses file"),
        (b"[1, 2]", 0, "is not a hypotheses file"),
    ],
)
def test_a_hypotheses_file_that_lies_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, header: bytes, size: int, says: str
) -> None:
    path = hypotheses_that_say(tmp_path / "object_1.npz", header, size)
    assert main(["query", str(path), *BOX]) == 1
    line = one_line(capsys)
    assert says in line and str(path) in line


@pytest.mark.parametrize("story", ["[" * 50_000 + "]" * 50_000, "[1]", "{"])
def test_a_prior_whose_metadata_is_none_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture, story: str) -> None:
    path = tmp_path / "p.safetensors"
    save_file({"a": np.zeros(3, np.float32)}, path, {"farside": story})
    assert main(["replay", "--prior", str(path), "--out", str(tmp_path / "out")]) == 1
    assert f"{path} is not a readable prior" in one_line(capsys)
