"""Files in a .tar.gz archive, read without unpacking it to disk."""

import gzip
import re
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from foundation.one_line import one_line

SUFFIXES = (".tar.gz", ".tgz")
LARGEST_MEMBER, LARGEST_ARCHIVE, MOST_MEMBERS = 1 << 28, 1 << 33, 10_000  # bytes when unpacked; and their number


class _Bounded(gzip.GzipFile):
    """Refuses to read more at once than a member may have: a header may claim any size."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= LARGEST_MEMBER:
            raise ValueError(f"it says that a part of it unpacks to more than {LARGEST_MEMBER >> 20} MB")
        return super().read(size)


def is_archive(path: Path) -> bool:
    """Whether the file's name is an archive's."""
    return path.name.lower().endswith(SUFFIXES)


def members(path: Path, name: re.Pattern[str]) -> Iterator[tuple[str, bytes]]:
    """Names and contents of the regular files at the top of an archive whose whole name matches, in their order there.

    Links, folders and what lies in folders are passed over. Raises FileNotFoundError, or ValueError naming the file.
    """
    try:
        with _Bounded(path) as unpacked, tarfile.open(fileobj=unpacked, mode="r:") as archive:
            for number, info in enumerate(archive):
                if number >= MOST_MEMBERS:
                    raise ValueError(f"it holds more than {MOST_MEMBERS} files")
                if info.size > LARGEST_MEMBER or info.offset_data + info.size > LARGEST_ARCHIVE:
                    raise ValueError(
                        f"it unpacks to more than {LARGEST_ARCHIVE >> 20} MB, or a file of it to more than"
                        f" {LARGEST_MEMBER >> 20}"
                    )
                plain = info.name.removeprefix("./")
                if info.type in (tarfile.REGTYPE, tarfile.AREGTYPE) and name.fullmatch(plain):
                    file = archive.extractfile(info)
                    assert file is not None  # as it is regular
                    yield plain, file.read(info.size)
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path}: no such archive") from None
    except (tarfile.TarError, zlib.error, EOFError, OSError, OverflowError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as a .tar.gz ({one_line(error)[:200]}); copy it again") from None
