"""The kernel is built once into the user's cache; without a compiler, or with a broken one, all goes on without it."""

from pathlib import Path

import pytest

from probnerf.kernel import build


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(build, "library_path", lambda: tmp_path / "farside" / "kernel-x" / "farside_kernel.so")
    return tmp_path / "farside" / "kernel-x"


def a_compiler(folder: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> Path:
    """A stand-in for the C++ compiler; the file that counts its calls."""
    path, calls = folder / "cxx", folder / "calls"
    path.write_text(f"#!/bin/sh\necho >> {calls}\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setenv("CXX", str(path))
    return calls


def test_without_a_compiler_there_is_no_kernel_and_nothing_is_written(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "compiler", lambda: None)
    assert build.built_library() is None
    assert not cache.exists()


def test_a_compiler_that_fails_is_asked_once_and_its_words_are_kept(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    calls = a_compiler(tmp_path, monkeypatch, "echo no such instruction >&2; exit 1")
    assert build.built_library() is None
    assert "no such instruction" in (cache / "failed.txt").read_text()
    before = calls.read_text()
    assert build.built_library() is None
    assert calls.read_text() == before
    build.main()  # by hand it is tried again
    assert calls.read_text() != before
    assert f"could not build the kernel ({cache / 'failed.txt'})" in capsys.readouterr().err


def test_what_was_built_is_taken_as_it_is(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = a_compiler(tmp_path, monkeypatch, 'for last; do :; done; echo built > "$last"')
    assert build.built_library() == cache / "farside_kernel.so"
    assert sorted(p.name for p in cache.iterdir()) == ["farside_kernel.so", "lock"]  # and no scratch
    before = calls.read_text()
    assert build.built_library() == cache / "farside_kernel.so"
    assert calls.read_text() == before
