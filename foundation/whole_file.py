"""Files that appear whole or not at all: written beside their place, then moved there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import NamedTemporaryFile


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the place to write the file at; it is moved to `path` when the block ends without an error.

    After an error `path` is as it was before, and nothing else is left. Makes the folder where there is none.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.uname().nodename}.{os.getpid()}.part")  # a folder may be of many machines
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all; text is written as UTF-8."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def check_folder(folder: Path) -> None:
    """Raises `ValueError`, one line with the remedy, if no file can be written into a folder. Leaves nothing there.

    To be asked before long work, whose results would have no place.
    """
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with NamedTemporaryFile(dir=folder):
            pass
    except NotADirectoryError:
        raise ValueError(f"{folder} is a file, or in one; give a folder for the results") from None
    except FileExistsError:
        raise ValueError(f"{folder} is a file; give a folder for the results") from None
    except OSError as error:
        raise ValueError(f"{folder} cannot be written to ({error.strerror}); give another folder") from None
    finally:
        for f in missing:
            with suppress(OSError):
                f.rmdir()
