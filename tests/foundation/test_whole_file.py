"""A file is there whole, or what was there before is."""

import errno
import os
from pathlib import Path

import pytest

from foundation.one_line import one_line
from foundation.whole_file import check_folder, whole_file, write_whole


def test_a_file_and_its_folder_appear(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_whole(path, "½\n")
    assert path.read_bytes() == "½\n".encode()
    write_whole(path, b"\x00")
    assert path.read_bytes() == b"\x00" and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("old", [None, b"old"])
def test_an_error_leaves_what_was_there_and_nothing_else(tmp_path: Path, old: bytes | None) -> None:
    path = tmp_path / "a.bin"
    if old is not None:
        path.write_bytes(old)
    before = list(tmp_path.iterdir())

    def interrupted() -> None:
        with whole_file(path) as part:
            part.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == before and (old is None or path.read_bytes() == old)


def test_a_reader_never_sees_half_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_whole(path, b"old")
    with whole_file(path) as part:
        part.write_bytes(b"half")
        assert path.read_bytes() == b"old"
        part.write_bytes(b"half and half")
    assert path.read_bytes() == b"half and half"


def test_an_error_is_one_line() -> None:
    assert one_line(ValueError("a\n  b\tc ")) == "a b c"
    assert one_line(TimeoutError()) == "TimeoutError"


def test_a_folder_is_tried_and_left_as_it_was(tmp_path: Path) -> None:
    check_folder(tmp_path / "new" / "deep")
    assert not list(tmp_path.iterdir())
    (tmp_path / "old").mkdir()
    check_folder(tmp_path / "old")
    assert not list((tmp_path / "old").iterdir())


@pytest.mark.parametrize("name", ["file", "file/under", "full/of"])
def test_a_place_that_holds_no_folder_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("x")
    folder = Path("/proc/self/full/of") if name == "full/of" else tmp_path / name
    with pytest.raises(ValueError, match=r"give a(nother)? folder") as caught:
        check_folder(folder)
    assert str(folder) in str(caught.value) and "\n" not in str(caught.value)


def test_a_full_disk_is_named_with_the_file_whatever_a_library_makes_of_it(tmp_path: Path) -> None:
    def write(code: int) -> None:
        with whole_file(tmp_path / "a.png"):
            try:
                raise OSError(code, os.strerror(code))
            finally:
                raise RuntimeError("a stream was not flushed")

    for code in (errno.ENOSPC, errno.EFBIG):
        with pytest.raises(OSError, match=r"a\.png cannot be written \(.*\); make room"):
            write(code)
    with pytest.raises(RuntimeError):
        write(errno.EIO)
    assert not list(tmp_path.iterdir())
