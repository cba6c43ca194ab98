"""Files at a URL that fsspec reads: a folder of this machine, `s3://bucket/folder`, `gs://...`, `sftp://...`.

Credentials and end points come from fsspec's own configuration (`~/.config/fsspec`, `FSSPEC_*`) or the backend's.
"""

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import fsspec
from fsspec.implementations.local import LocalFileSystem

from foundation.one_line import one_line
from foundation.whole_file import check_folder, write_whole

_AT_ONCE = 16  # requests under way; a store of objects answers each in tens of milliseconds
# What shows an object when all of it has come. Elsewhere a file is written beside its place, and then moved there.
_PUT_WHOLE = {"memory", "s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss", "hf"}


class StoreError(OSError):
    """A file of a store could not be written or read, in one line: the network, rights, or room."""


class WriteError(StoreError):
    """A file could not be written, in one line: rights, room, or the network."""


class Store:
    """Files by their names (`a/b.json`) under one URL. Raises `ValueError`, one line, for a URL that cannot be."""

    def __init__(self, url: str) -> None:
        self._files, self._root = _opened(url)
        self.local = isinstance(self._files, LocalFileSystem)
        self.url = self._root if self.local else self._files.unstrip_protocol(self._root)

    @property
    def in_memory(self) -> bool:
        """Whether it ends with this process, and no other one sees it."""
        return "memory" in _protocols(self._files)

    def path(self, name: str) -> str:
        """Where a file is, for people: a path, or a URL."""
        return f"{self.url.rstrip('/')}/{name}"

    def check(self) -> None:
        """Raises `ValueError` if no file can be written there. Leaves nothing."""
        if self.local:
            check_folder(Path(self._root))
            return
        name = f".check-{os.getpid()}"
        try:
            self.write(name, b"farside")
            self.remove(name)
        except OSError as error:
            raise ValueError(f"{self.url} cannot be written to ({one_line(error)}); give another place") from None

    def write(self, name: str, content: bytes) -> None:
        """Write a file whole or not at all. Raises `WriteError`."""
        place = self._place(name)
        try:
            if self.local:
                write_whole(Path(place), content)
            elif _PUT_WHOLE & _protocols(self._files):
                self._files.pipe_file(place, content)
            else:
                part = f"{place}.{os.getpid()}.part"
                self._files.makedirs(str(PurePosixPath(place).parent), exist_ok=True)
                self._files.pipe_file(part, content)
                self._files.mv(part, place)
        except Exception as error:  # each backend has its own
            line, path = one_line(error), self.path(name)
            raise WriteError(line if path in line else f"{path} cannot be written ({line})") from None

    def read(self, names: Iterable[str]) -> dict[str, bytes]:
        """The contents of files that are there. Raises `StoreError`."""

        def content(name: str) -> tuple[str, bytes]:
            try:
                return name, self._files.cat_file(self._place(name))
            except Exception as error:
                raise StoreError(f"{self.path(name)} cannot be read ({one_line(error)})") from None

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            return dict(pool.map(content, names))

    def has(self, name: str) -> bool:
        """Whether a file is there now. Raises `StoreError`."""
        try:
            self._files.invalidate_cache()
            return self._files.exists(self._place(name))
        except Exception as error:
            raise StoreError(f"{self.path(name)} cannot be read ({one_line(error)})") from None

    def sizes(self) -> dict[str, int]:
        """The files that are there now, by name in order, with their bytes. Raises `StoreError`."""
        try:
            self._files.invalidate_cache()
            found = self._files.find(self._root, detail=True) if self._files.exists(self._root) else {}
        except Exception as error:
            raise StoreError(f"{self.url} cannot be listed ({one_line(error)})") from None
        start = len(self._root.rstrip("/")) + 1
        return {path[start:]: int(info["size"] or 0) for path, info in sorted(found.items())}

    def remove(self, name: str) -> None:
        """Remove a file, unless another process did. Raises `StoreError`."""
        try:
            self._files.rm_file(self._place(name))
        except FileNotFoundError:
            return
        except Exception as error:
            raise StoreError(f"{self.path(name)} cannot be removed ({one_line(error)})") from None

    def _place(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"


def matches(pattern: str) -> list[str]:
    """The paths or URLs that a path, URL or glob names, in order; local ones are absolute. Empty: there is none.

    What is there under the very name is no glob. Raises `ValueError` for an unknown scheme, `StoreError`.
    """
    files, path = _opened(pattern)
    try:
        found = [path] if files.exists(path) else sorted(files.glob(path)) if set("*?[") & set(path) else []
    except Exception as error:
        raise StoreError(f"{pattern} cannot be read ({one_line(error)})") from None
    return [_named(files, each) for each in found]


def entries(url: str) -> dict[str, bool] | None:
    """What is in a folder, by path or URL in order, and whether that is a folder, too; None for a file."""
    files, path = _opened(url)
    try:
        if not files.isdir(path):
            return None
        kinds = {each["name"]: each["type"] for each in files.ls(path, detail=True)}  # "other": behind a link
        found = {name: kind == "directory" or (kind == "other" and files.isdir(name)) for name, kind in kinds.items()}
    except Exception as error:
        raise StoreError(f"{url} cannot be listed ({one_line(error)})") from None
    return {_named(files, each): found[each] for each in sorted(found)}


def bytes_of(urls: Iterable[str]) -> dict[str, int]:
    """How many bytes each file, or all of a folder, has. Raises `StoreError`."""

    def size(url: str) -> tuple[str, int]:
        files, path = _opened(url)
        try:
            if files.isdir(path):
                return url, sum(int(info["size"] or 0) for info in files.find(path, detail=True).values())
            return url, int(files.size(path) or 0)
        except Exception as error:
            raise StoreError(f"{url} cannot be read ({one_line(error)})") from None

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        return dict(pool.map(size, urls))


@contextmanager
def local_copy(url: str) -> Iterator[Path]:
    """A file or folder as a path of this machine: itself, or a copy that ends with the block. Raises `StoreError`."""
    files, path = _opened(url)
    if isinstance(files, LocalFileSystem):
        yield Path(path)
        return
    folder = Path(tempfile.mkdtemp(prefix="farside-"))
    try:
        here = folder / PurePosixPath(path).name
        try:
            for each in files.find(path):  # `get` would take names with [ for patterns
                to = here / each[len(path) :].strip("/")
                if ".." in to.parts:  # keys of a store may be any text
                    raise ValueError(f"it holds {each}")
                to.parent.mkdir(parents=True, exist_ok=True)
                files.get_file(each, str(to))
        except Exception as error:
            raise StoreError(f"{url} cannot be read ({one_line(error)})") from None
        yield here
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _opened(url: str) -> tuple[Any, str]:
    """fsspec's file system, and the path in it."""
    try:
        return fsspec.core.url_to_fs(url)
    except ImportError as error:  # a backend that is not installed
        raise ValueError(f"{url}: {one_line(error)}") from None
    except Exception as error:
        remedy = "give a path, or a URL that fsspec reads, such as s3://bucket/folder"
        raise ValueError(f"{url} cannot be opened ({one_line(error)}); {remedy}") from None


def _protocols(files: Any) -> set[str]:
    return {files.protocol} if isinstance(files.protocol, str) else set(files.protocol)


def _named(files: Any, path: str) -> str:
    return path if isinstance(files, LocalFileSystem) else files.unstrip_protocol(path)
